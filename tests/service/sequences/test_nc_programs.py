"""NC programs: every dialect read back goes where the plan goes, rests where it reads, and stops where a person is needed."""

import math
import re
from itertools import pairwise

import numpy as np
import pytest

from abbe.models.machine import Machine
from abbe.service.domain.machine_file import NcSettings
from abbe.service.errors import ConfigError
from abbe.service.sequences.nc.blocks import Arc, Dwell, Go, Smooth
from abbe.service.sequences.nc.write import NAMES, PathDynamics, nc_program, one_move_s, runtime
from abbe.service.sequences.recipes.recipe import Circle, Diagonal, FaceDiagonal, Helix, HelixPoints, Linear
from abbe.service.sequences.recipes.recipe_file import shared_setups
from abbe.service.sequences.steps import (
    CampaignPlan,
    ChangeBar,
    FollowPath,
    MountBar,
    MountLaser,
    MoveTo,
    ReadBar,
    ReadLaser,
    RecordPath,
    TakeBarOut,
    Unmount,
    ZeroLaser,
)  # fmt: skip
from tests.service.sequences.nc_reader import read_gcode, read_heidenhain

MACHINE = Machine("w-X-Y-b-Z-t", np.array([[0.0, 600.0], [0.0, 500.0], [-50.0, 450.0]]))
CUP = (300.0, 250.0, 100.0)
READERS = {"siemens": "F_s", "fanuc": "P_ms", "linuxcnc": "P_s", "iso": "X_s"}


@pytest.fixture(scope="module")
def plan():
    recipes = shared_setups(
        (
            Helix("h", "cup", "identify", CUP, 100.0, turns=3.0, chord_mm=10.0, feed_in_deg=20.0),
            HelixPoints("p", "cup", "identify", CUP, 100.0, turns=3.0, points=20),
            Circle("xy", "cup", "identify", CUP, 100.0, "XY"),
            Circle("yz", "cup", "identify", CUP, 100.0, "YZ", -20.0, 220.0, 2.0, 2.0),
            Circle("zx", "cup", "identify", CUP, 80.0, "ZX", -110.0, 220.0, 2.0, 2.0, direction=-1),
            Diagonal("d", "mirror (µm)", "identify", "npp", 3, "XYZ"),
            FaceDiagonal("f", "face", "identify", "XY", "np", steps=4, cycles=2, overrun_mm=1.0),
            Linear("l", "line", "identify", 2, positions=5, at_share=(0.2, 0.4), offset_share=0.3),
        ),
        "f",
    )
    return CampaignPlan("all (tests) in µm", tuple(r.plan(MACHINE) for r in recipes))


def events(plan, dialect):
    text = nc_program("M-1", MACHINE, plan, dialect, NcSettings(heidenhain_tool=7)).text
    return text, read_heidenhain(text) if dialect == "heidenhain" else read_gcode(text, dwell=READERS[dialect])


def planned_stops(plan, arcs=("XY", "YZ", "ZX")):
    """Where a straight program goes, in order (places twice in a row once), without the inner points of circles."""
    out = []
    for test in plan.tests:
        for step in test.steps:
            if isinstance(step, MoveTo):
                out.append(step.target_mm)
            elif isinstance(step, FollowPath) or (isinstance(step, RecordPath) and test.bar.plane not in arcs):
                out += step.points_mm
            elif isinstance(step, RecordPath):
                out += [("circle", step, test.setup)]
    return out


@pytest.mark.parametrize("dialect", NAMES)
def test_a_program_read_back_goes_where_the_plan_goes(plan, dialect):
    _, found = events(plan, dialect)
    moves = [e for e in found if e.kind in ("go", "arc")]
    k, here = 0, (math.nan,) * 3
    for wanted in planned_stops(plan, ("XY",) if dialect == "heidenhain" else ("XY", "YZ", "ZX")):
        if wanted[0] == "circle":
            _, step, setup = wanted
            points = np.array(step.points_mm)
            ends = [step.points_mm[i] for i in (*(step.measured or ()), len(points) - 1)]
            seen = []
            while k < len(moves) and moves[k].kind == "arc":
                plane, centre, positive = moves[k].value
                assert plane == setup.plane
                axes = ["XYZ".index(c) for c in plane]
                assert np.array(centre)[axes] == pytest.approx(setup.centre_mm[axes], abs=2e-4)
                assert positive == (step.direction > 0)
                seen.append(moves[k].at)
                k += 1
            for end in ends:
                assert min(math.dist(end, s) for s in seen) < 1e-4
            assert all(np.linalg.norm(points - s, axis=1).min() < 1e-4 for s in seen)
            here = step.points_mm[-1]
        elif math.dist(wanted, here) > 0.0 or math.isnan(here[0]):
            assert moves[k].kind == "go"
            assert max(abs(a - b) for a, b in zip(moves[k].at, wanted, strict=True)) < 1e-4
            here = wanted
            k += 1
    assert k == len(moves)


@pytest.mark.parametrize("dialect", NAMES)
def test_it_rests_at_every_reading_and_stops_for_every_hand(plan, dialect):
    text, found = events(plan, dialect)
    readings = [s for t in plan.tests for s in t.steps if isinstance(s, ReadLaser | ReadBar)]
    rests = [e for e in found if e.kind == "rest"]
    paths = sum(isinstance(s, RecordPath) for t in plan.tests for s in t.steps)
    assert len(rests) == len(readings) + 2 * paths
    assert min(e.value for e in rests) >= 0.3 + 20 / 1000  # settling and what is read
    by_hand = [
        s for t in plan.tests for s in t.steps if isinstance(s, MountBar | TakeBarOut | ChangeBar | MountLaser | Unmount | ZeroLaser)
    ]
    bars = sum(isinstance(s, MountBar) for s in by_hand)  # cup and bar: two stops; laser, mirror and zero: one
    assert sum(e.kind == "halt" for e in found) == len(by_hand) + bars - sum(isinstance(s, MountLaser) for s in by_hand)
    first, second = [k for k, e in enumerate(found) if e.kind == "halt"][:2]
    assert found[first].at == pytest.approx(CUP)  # the cup is put where the ball is, the bar is hung in on its sphere
    assert abs(math.dist(found[second].at, CUP) - 100.0) < 0.9
    if dialect != "heidenhain":
        assert all(e.value <= 2000.0 for e in found[first + 1 : second] if e.kind == "go")
    assert text.isascii()
    assert max(len(line) for line in text.splitlines()) < 200
    for word in ("MIRROR", "600"):
        assert word in text.upper()  # what it does, and the machine's limits


def test_each_dialect_speaks_its_controllers_language(plan):
    texts = {name: events(plan, name)[0] for name in NAMES}
    assert 'MSG("put the cup' in texts["siemens"]
    assert "G710" in texts["siemens"]
    assert " D0" in texts["siemens"]
    for text in texts.values():
        assert re.search(r"^(L |\d+ L |N\d+ )?M5$", text, re.MULTILINE)  # nobody hangs a bar into a spindle that turns
    assert max(int(n) for n in re.findall(r"^N(\d+)", texts["fanuc"], re.MULTILINE)) == 9990
    assert len(texts["fanuc"].splitlines()) > 999
    assert "G500" in texts["siemens"]
    assert "G4 F1.000" in texts["siemens"]
    assert texts["siemens"].endswith("M30\n")
    assert texts["fanuc"].startswith("%\nO0001 (ALL TESTS IN UM)\n")
    assert "G04 P1000" in texts["fanuc"]
    assert "M00 (PUT THE CUP" in texts["fanuc"]
    assert texts["fanuc"].endswith("M30\n%\n")
    assert texts["heidenhain"].startswith("0 BEGIN PGM ALLTESTSINUM MM\n")
    assert "CYCL DEF 9.1 DWELL 1.000" in texts["heidenhain"]
    assert "END PGM ALLTESTSINUM MM" in texts["heidenhain"]
    assert "G64 P0.001" in texts["linuxcnc"]
    assert "G4 P1.000" in texts["linuxcnc"]
    with pytest.raises(ConfigError, match="no NC dialect 'okuma'"):
        nc_program("M", MACHINE, plan, "okuma")


def test_the_head_says_how_long_it_runs_and_what_was_taken_for_granted(plan):
    """The blocks by themselves, as the manual's reader has them, with the stated acceleration and stops."""
    text = nc_program("M-1", MACHINE, plan, "linuxcnc").text
    moving, resting, minutes = (float(v) for v in re.search(r"runs (\d+) min: (\d+) s of moves, (\d+) s of dwells", text).group(2, 3, 1))
    assert "with 500 mm/s2 along the path, 0.1 s at each exact stop" in text
    found = read_gcode(text, dwell="P_s")
    assert resting == pytest.approx(sum(e.value for e in found if e.kind == "rest"), abs=1.0)
    at_feed = sum(math.dist(a.at, b.at) / b.value * 60.0 for a, b in pairwise(e for e in found if e.kind == "go") if b.kind == "go")
    assert moving > at_feed  # no controller is faster than its feed
    assert minutes == math.ceil((moving + resting) / 60.0) or abs(moving + resting - 60.0 * minutes) < 2.0
    sluggish = nc_program("M-1", MACHINE, plan, "linuxcnc", NcSettings(acceleration_mm_s2=50.0)).runtime
    assert sluggish.moving_s > moving + 1.0
    assert sluggish.resting_s == pytest.approx(resting, abs=1.0)


def test_a_move_takes_its_way_at_feed_and_its_speeding_up():
    pace = PathDynamics(500.0, 0.1)
    assert one_move_s(600.0, 6000.0, pace) == pytest.approx(6.0 + 0.2 + 0.1)  # 100 mm/s; 0.2 s at either end at half of it
    assert one_move_s(5.0, 6000.0, pace) == pytest.approx(2 * 0.1 + 0.1)  # never gets to 100 mm/s
    assert one_move_s(0.0, 6000.0, pace) == 0.0
    here, there, on = (0.0, 0.0, 0.0), (100.0, 0.0, 0.0), (200.0, 0.0, 0.0)
    stops = (Go(here, 6000.0), Go(there, 6000.0), Dwell(1.5), Go(on, 6000.0))
    assert runtime(stops, pace).total_s == pytest.approx(1.5 + 2 * (1.0 + 0.2 + 0.1))
    through = (Go(here, 6000.0), Smooth(True), Go(there, 6000.0), Go(on, 6000.0), Smooth(False))
    assert runtime(through, pace).moving_s == pytest.approx(2.0 + 0.2 + 0.1)
    half = (Go((100.0, 0.0, 0.0), 6000.0), Arc("XY", (100.0, 0.0, 0.0), (-100.0, 0.0, 0.0), (0.0, 0.0, 0.0), False, 6000.0))
    assert runtime(half, pace).moving_s == pytest.approx(math.pi + 0.2 + 0.1)


def test_a_heidenhain_program_calls_the_operators_tool_or_says_where_it_belongs(plan):
    lines = nc_program("M", MACHINE, plan, "heidenhain", NcSettings(heidenhain_tool=42)).text.splitlines()
    call = next(k for k, line in enumerate(lines) if line.endswith(" TOOL CALL 42 Z"))
    assert call < next(k for k, line in enumerate(lines) if " L X" in line)  # before anything moves
    unsaid = nc_program("M", MACHINE, plan, "heidenhain").text.splitlines()
    note = next(k for k, line in enumerate(unsaid) if "WRITE TOOL CALL N Z" in line)
    assert "NOT TOOL 0, WHICH EMPTIES THE SPINDLE" in unsaid[note + 1]
    assert unsaid[note + 2].endswith(" L M0")  # it does not run past that unread
    assert not any(re.match(r"\d+ TOOL CALL", line) for line in unsaid)
    assert all(int(line.split()[0]) == k for k, line in enumerate(unsaid))


def test_a_program_longer_than_the_controls_memory_is_said(plan):
    made = nc_program("M", MACHINE, plan, "fanuc")
    size = len(made.text.encode())
    assert made.size.startswith(f"{size} bytes, {len(made.text.splitlines())} blocks, about ")
    assert made.warning == ""
    small = nc_program("M", MACHINE, plan, "fanuc", NcSettings(memory_kib={"fanuc": size / 1024.0 - 0.1}))
    assert "a fanuc control is assumed to hold" in small.warning
    assert small.text == made.text
    assert nc_program("M", MACHINE, plan, "fanuc", NcSettings(memory_kib={"fanuc": size / 1024.0 + 0.1})).warning == ""
    assert nc_program("M", MACHINE, plan, "siemens", NcSettings(memory_kib={"fanuc": 0.1})).warning == ""
    assert nc_program("M", MACHINE, plan, "siemens", NcSettings(memory_kib={"siemens": 0.1})).warning != ""
    assert NcSettings().memory_of("iso") == 256.0
    assert NcSettings().memory_of("heidenhain") is None
