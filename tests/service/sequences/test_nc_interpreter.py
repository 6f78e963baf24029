"""LinuxCNC's own interpreter, which nobody here wrote, reads programs of every recipe kind: it goes, rests, stops as the plan says."""

import math
import re
import shutil
import subprocess
from dataclasses import dataclass

import numpy as np
import pytest

from abbe.models.machine import Machine
from abbe.service.sequences.nc.blocks import BAR_DWELL_S, LASER_DWELL_S, PATH_REST_S
from abbe.service.sequences.nc.write import nc_program
from abbe.service.sequences.recipes.recipe import Circle, Diagonal, FaceDiagonal, Helix, HelixPoints, Linear
from abbe.service.sequences.steps import CampaignPlan, FollowPath, MoveTo, ReadBar, ReadLaser, RecordPath

MACHINE = Machine("w-X-Y-b-Z-t", np.array([[0.0, 600.0], [0.0, 500.0], [-50.0, 450.0]]))
CUP = (300.0, 250.0, 100.0)
WITHIN_MM = 1e-3
PLANE_AXES = {"XY": (0, 1, 2), "YZ": (1, 2, 0), "XZ": (2, 0, 1)}  # first and second axis of a canonical arc, and the one across
ZEROS = (5161, 5162, 5163, 5181, 5182, 5183, 5210, 5211, 5212, 5213, 5220, 5221, 5222, 5223, 5241, 5242, 5243, 5261, 5262, 5263)
KINDS = {
    "helix": Helix("h", "cup", "identify", CUP, 100.0, turns=3.0, chord_mm=5.0, feed_in_deg=20.0, feed_out_deg=20.0),
    "helix back": Helix("h", "cup", "identify", CUP, 100.0, turns=3.0, chord_mm=5.0, direction=-1),
    "helix by angle": Helix("h", "cup", "identify", CUP, 100.0, turns=3.0, chord_mm=5.0, law="angle"),
    "helix point by point": HelixPoints("p", "cup", "identify", CUP, 100.0, turns=3.0, points=30),
    "circle XY": Circle("xy", "cup", "identify", CUP, 100.0, "XY"),
    "circle YZ": Circle("yz", "cup", "identify", CUP, 100.0, "YZ", -20.0, 220.0, 2.0, 2.0),
    "circle ZX back": Circle("zx", "cup", "identify", CUP, 80.0, "ZX", -110.0, 220.0, 2.0, 2.0, direction=-1),
    "step diagonal": Diagonal("d", "mirror", "identify", "npp", 5, "ZXY"),
    "straight diagonal": Diagonal("d", "mirror", "identify", "ppn", 6, "", cycles=2, overrun_mm=1.0),
    "face diagonal": FaceDiagonal("f", "face", "identify", "ZX", "np", steps=4, cycles=2, overrun_mm=0.05),
    "line": Linear("l", "line", "identify", 2, positions=5, at_share=(0.2, 0.4), offset_share=0.3, cycles=3, overrun_mm=2.0),
}


@dataclass(frozen=True)
class Canonical:
    """One canonical command. ``kind``: go, arc, rest, halt; ``at``: where it ends; ``value``: seconds, or an arc's axes, centre, sense."""

    kind: str
    at: tuple[float, ...]
    value: object = None


def interpreted(text: str, folder) -> list[Canonical]:
    """What the interpreter makes of a program."""
    (folder / "p.ngc").write_text(text)
    (folder / "none.tbl").write_text("")
    (folder / "none.var").write_text("".join(f"{n}\t0.0\n" for n in ZEROS))
    words = [shutil.which("rs274") or "rs274", "-g", "-v", "none.var", "-t", "none.tbl", "p.ngc"]
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stdout[-800:] + done.stderr[-800:]
    assert "PROGRAM_END()" in done.stdout
    plane, at, out = "XY", (math.nan,) * 3, []
    for line in done.stdout.splitlines():
        found = re.search(r" ([A-Z_]+)\(([^\"]*)\)$", line.rstrip())
        name, words = found.groups() if found else ("", "")
        if name == "SELECT_PLANE":
            plane = words.removeprefix("CANON_PLANE_")
        elif name == "STRAIGHT_TRAVERSE":
            raise AssertionError("a program of Abbe has no rapid moves")
        elif name == "STRAIGHT_FEED":
            at = tuple(float(v) for v in words.split(",")[:3])
            out.append(Canonical("go", at))
        elif name == "ARC_FEED":
            end, centre, turn = arc_of(words, PLANE_AXES[plane])
            at = end
            out.append(Canonical("arc", at, (PLANE_AXES[plane], centre, turn)))
        elif name == "DWELL":
            out.append(Canonical("rest", at, float(words)))
        elif name == "PROGRAM_STOP":
            out.append(Canonical("halt", at))
    return out


def arc_of(words: str, axes: tuple[int, int, int]) -> tuple[tuple[float, ...], tuple[float, float], int]:
    """End point, centre (first and second axis) and turns (sign: counter-clockwise) of an ARC_FEED."""
    numbers = [float(v) for v in words.split(",")]
    end = [0.0] * 3
    end[axes[0]], end[axes[1]], end[axes[2]] = numbers[0], numbers[1], numbers[5]
    return tuple(end), (numbers[2], numbers[3]), int(numbers[4])


def understood(text: str, dialect: str) -> str:
    """A plain ISO program in the words of this interpreter: it calls millimetres G21 and a dwell's seconds P; all else stays."""
    return re.sub(r"\bG04 X", "G04 P", text.replace("G71 ", "G21 ")) if dialect == "iso" else text


def commands(require, folder, recipe, dialect):
    require("rs274", shutil.which("rs274") is not None, "rs274 of LinuxCNC (Debian: linuxcnc-uspace) is not installed")
    plan = recipe.plan(MACHINE)
    made = nc_program("M-1", MACHINE, CampaignPlan("one", (plan,)), dialect)
    return plan, interpreted(understood(made.text, dialect), folder)


@pytest.mark.parametrize("dialect", ["linuxcnc", "iso"])
@pytest.mark.parametrize("kind", KINDS)
def test_it_goes_where_the_plan_goes(kind, dialect, require, tmp_path):
    plan, done = commands(require, tmp_path, KINDS[kind], dialect)
    moves = [c for c in done if c.kind in ("go", "arc")]
    here, k = (math.inf,) * 3, 0
    for step in plan.steps:
        arcs = isinstance(step, RecordPath) and plan.test == "ballbar_circle"
        if arcs:
            points, k0 = np.array(step.points_mm), k
            while k < len(moves) and moves[k].kind == "arc":
                k += 1
            assert k > k0
            on_arcs(points, here, moves[k0:k], plan.bar, [step.points_mm[i] for i in step.measured or ()])
            here = step.points_mm[-1]
            continue
        for point in [step.target_mm] if isinstance(step, MoveTo) else getattr(step, "points_mm", ()):
            if point != here:
                assert moves[k].kind == "go"
                assert math.dist(moves[k].at, point) < WITHIN_MM
                here, k = point, k + 1
    assert k == len(moves) > 0


def on_arcs(points, here, arcs, setup, ends):
    """The arcs join each other, are about the cup, turn as the path does, end where what counts begins and ends, and hold every point of
    the path."""
    left = [tuple(p) for p in points]
    for arc in arcs:
        (a, b, across), centre, turn = arc.value
        assert abs(turn) == 1  # no arc is more than a whole turn
        assert math.dist(centre, (setup.centre_mm[a], setup.centre_mm[b])) < WITHIN_MM
        radii = [math.hypot(p[a] - centre[0], p[b] - centre[1]) for p in (here, arc.at)]
        assert max(abs(r - setup.radius_mm) for r in radii) < WITHIN_MM
        first, last = (math.atan2(p[b] - centre[1], p[a] - centre[0]) for p in (here, arc.at))
        sweep = turn * (last - first) % (2.0 * math.pi)
        while left:
            p = left[0]
            assert abs(math.hypot(p[a] - centre[0], p[b] - centre[1]) - setup.radius_mm) < WITHIN_MM
            assert abs(p[across] - here[across]) < WITHIN_MM
            gone = turn * (math.atan2(p[b] - centre[1], p[a] - centre[0]) - first) % (2.0 * math.pi)
            if gone > sweep + 1e-5 and 2.0 * math.pi - gone > 1e-5:
                break
            left.pop(0)
        here = arc.at
    assert left == []
    assert math.dist(here, tuple(points[-1])) < WITHIN_MM
    for end in ends:
        assert min(math.dist(end, arc.at) for arc in arcs) < WITHIN_MM


@pytest.mark.parametrize("dialect", ["linuxcnc", "iso"])
@pytest.mark.parametrize("kind", KINDS)
def test_it_rests_as_often_and_as_long_as_the_plan_reads(kind, dialect, require, tmp_path):
    plan, done = commands(require, tmp_path, KINDS[kind], dialect)
    wanted, here = [], None
    for step in plan.steps:
        match step:
            case MoveTo(target, _):
                here = target
            case FollowPath(points, _):
                here = points[-1]
            case ReadLaser(_, settle):
                wanted.append((here, settle + LASER_DWELL_S))
            case ReadBar(_, settle, samples, rate_hz):
                wanted.append((here, settle + samples / rate_hz + BAR_DWELL_S))
            case RecordPath(points):
                wanted += [(points[0], PATH_REST_S), (points[-1], PATH_REST_S)]
                here = points[-1]
    rests = [c for c in done if c.kind == "rest"]
    assert len(rests) == len(wanted) > 0
    for (place, seconds), rest in zip(wanted, rests, strict=True):
        assert math.dist(place, rest.at) < WITHIN_MM
        assert rest.value == pytest.approx(seconds, abs=1e-3)
    assert done[-1].kind == "halt"  # what is mounted is taken away before anything else moves
