"""How far a path came, where it goes on, and what is compared: without devices."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from math import ceil, dist

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from abbe.drivers.api import BarSample, Condition, ControllerStatus
from abbe.service.domain.measured import RunPiece, arc_of
from abbe.service.errors import RunInterrupted, StretchDiffers
from abbe.service.runs.pieces import ReadProgress
from abbe.service.sequences.recipes.recipe import Circle
from abbe.service.sequences.resume_plan import (
    SAME_MM,
    STEADY_MM,
    PathProgress,
    PathRemainder,
    StretchComparison,
    rest_of,
    rest_of_path,
    way_back,
)
from abbe.service.sequences.steps import MountBar, RecordPath
from tests.faults.sequencer_world import MACHINE
from tests.pretended_status import controller_status

FEED = 1200.0
FEED_MM_S = FEED / 60.0
ANGLES = np.linspace(0.0, 3.0 * np.pi, 600)
POINTS = tuple((float(x), float(y), float(z)) for x, y, z in np.stack([60 * np.cos(ANGLES), 60 * np.sin(ANGLES), 3.0 * ANGLES], axis=1))
ARC = arc_of(POINTS)


def status_at(position_mm: tuple[float, float, float], start_us: int, now_us: int) -> ControllerStatus:
    """A status while a path runs."""
    return controller_status(Condition(0), ctrl_us=now_us, position_mm=position_mm, path_start_us=start_us)


def path(measured: tuple[int, int] | None = None) -> RecordPath:
    return RecordPath(POINTS, FEED, 200, 1, measured)


def seen(until_s: float, *, stops_s: float = np.inf, share: float = 1.0, lag_mm: float = 0.0) -> PathProgress:
    """Statuses every 20 ms of a machine that follows ``lag_mm`` behind, at a share of the feed, and stands from an instant on."""
    way = PathProgress(path())
    for t in np.arange(0.02, until_s, 0.02):
        gone = max(share * FEED_MM_S * min(t, stops_s) - lag_mm, 0.0)
        at = [float(np.interp(gone, ARC, np.array(POINTS)[:, a])) for a in range(3)]
        way.add(status_at((at[0], at[1], at[2]), start_us=7_000_000, now_us=7_000_000 + round(t * 1e6)))
    way.boot_id = 5
    return way


@pytest.mark.parametrize("lag_mm", [0.0, 1.7])
def test_it_is_known_up_to_where_the_axes_stood(lag_mm):
    assert seen(20.0, lag_mm=lag_mm).good_mm == pytest.approx(FEED_MM_S * 20.0, abs=FEED_MM_S * 0.03)
    stood = seen(20.0, stops_s=12.0, lag_mm=lag_mm)
    assert FEED_MM_S * 11.9 <= stood.good_mm <= FEED_MM_S * 12.0 + STEADY_MM
    assert stood.doc() == {"path_start_us": 7_000_000, "good_us": stood.good_us, "box_boot_id": 5}


def test_another_feed_is_not_constant_feed():
    assert seen(20.0, share=0.95).good_mm < 0.2 * FEED_MM_S * 20.0


def test_of_a_path_that_hardly_began_nothing_is_known():
    assert seen(0.4).doc() == {}


def so_far(good_mm: float, counted_from_mm: float = 0.0) -> ReadProgress:
    at = np.arange(counted_from_mm, good_mm, FEED_MM_S / 200.0)
    return ReadProgress(
        pieces=(RunPiece(4, good_mm),), counted_from_mm=counted_from_mm, arc_mm=at, deviation_mm=np.sin(at / 20.0) * 0.01, boot_id=5
    )


@settings(deadline=None)
@example([0.5, 0.5625, 0.375, 0.109375], False)  # the last break is exactly a stretch behind what counts: no piece of no length
@given(st.lists(st.floats(0.1, 0.99), min_size=1, max_size=6), st.booleans())
def test_the_pieces_and_the_rest_are_the_whole_path_once(shares, leads):
    step = path((40, 560) if leads else None)
    begins_mm, pieces, counted_mm = float(ARC[40]) if leads else 0.0, [], float(ARC[40]) if leads else 0.0
    ends_mm = float(ARC[560]) if leads else float(ARC[-1])
    remainder, rest = None, step
    for share in shares:
        good = counted_mm + share * (float(ARC[-1]) - counted_mm)
        pieces_read = (*pieces, RunPiece(len(pieces), good))
        found = rest_of_path(step, replace(so_far(good, counted_mm), pieces=pieces_read))
        if found is None:
            # only where there is no room for lead and stretch, before what counts already or before the end
            assert min(good, ends_mm) < max(counted_mm, 0.5 * FEED_MM_S) + 0.5 * FEED_MM_S + 3.0
            continue
        rest, begin, remainder = found
        pieces = list(remainder.pieces)
        assert rest.points_mm == POINTS[begin:]
        assert rest.measured is not None
        counted_mm = remainder.offset_mm + float(arc_of(rest.points_mm)[rest.measured[0]])
        assert remainder.pieces[-1].to_mm == pytest.approx(counted_mm)
        assert remainder.pieces[-1].to_mm <= good + 1e-6
        assert remainder.arc_mm[0] >= 0.5 * FEED_MM_S - 1e-6  # the lead
        assert (
            remainder.arc_mm[0] >= counted_mm - remainder.offset_mm - 1e-6
        )  # what was read on the stretch before the break is only compared
        assert remainder.offset_mm + remainder.arc_mm[-1] <= good + 1e-6
        assert remainder.arc_mm[-1] - remainder.arc_mm[0] >= 0.5 * FEED_MM_S - 2.0 * FEED_MM_S / 200.0 - 1.0
    if remainder is not None and rest.measured is not None:
        ends = [begins_mm, *(p.to_mm for p in remainder.pieces)]
        assert all(b > a for a, b in pairwise(ends))
        assert remainder.offset_mm + arc_of(rest.points_mm)[rest.measured[1]] == pytest.approx(ends_mm)


def test_too_little_begins_again():
    assert rest_of_path(path(), so_far(15.0)) is None
    assert rest_of_path(path(), so_far(300.0, 295.0)) is None
    assert rest_of_path(path(), so_far(300.0)) is not None


def read(
    remainder: PathRemainder, off_mm: float, *, status: int = 0b1000, noise_mm: float = 3e-4, seed: int = 1, lost: bool = False
) -> StretchComparison:
    compare, rng = StretchComparison(remainder, 200), np.random.default_rng(seed)
    compare.add(BarSample(2**31 if lost else 99, 500, 0, 0))
    for k in range(ceil(remainder.arc_mm[-1] / FEED_MM_S * 200.0) + 3):
        at = remainder.offset_mm + (k + 0.5) / 200.0 * FEED_MM_S
        reading_mm = np.sin(at / 20.0) * 0.01 + off_mm + noise_mm * rng.standard_normal()
        compare.add(BarSample(100 + k, 1000 + 5000 * k, round(reading_mm * 1e6), status))
    return compare


def test_the_same_stretch_is_the_same_and_a_knock_is_one():
    found = rest_of_path(path(), so_far(300.0))
    assert found is not None
    for seed in range(20):
        assert abs(read(found[2], 0.0, seed=seed).off_mm or 1.0) < 2e-4
        with pytest.raises(StretchDiffers, match="off its value before the interruption"):
            read(found[2], 1.4 * SAME_MM, seed=seed)
    with pytest.raises(StretchDiffers, match="too few valid readings"):
        read(found[2], 0.0, status=0b1001)
    with pytest.raises(StretchDiffers, match="the first samples of the path were lost"):
        read(found[2], 0.0, lost=True)


def test_a_steep_stretch_is_no_knock():
    """Either beginning is known to half a period: at 6000 mm/min and 50 Hz that is 2 mm of path."""
    slope = 0.002
    at = np.arange(0.0, 60.0, 0.1)
    remainder = PathRemainder(
        pieces=(RunPiece(1, 100.0),), offset_mm=0.0, whole_mm=500.0, feed_mm_s=100.0, arc_mm=at, deviation_mm=slope * at, boot_id=5
    )
    for shift in (-0.5, 0.0, 0.5):
        compare = StretchComparison(remainder, 50)
        compare.add(BarSample(0, 0, 0, 0))
        for k in range(40):
            compare.add(BarSample(1 + k, 20000 * (1 + k), round(slope * (k + 0.5 + shift) * 2.0 * 1e6), 0b1000))
        assert compare.off_mm == pytest.approx(slope * 2.0 * shift, abs=1e-6)


def test_a_stretch_that_was_never_reached_is_no_proof_and_another_box_neither():
    found = rest_of_path(path(), so_far(300.0))
    assert found is not None
    compare = StretchComparison(found[2], 200)
    with pytest.raises(StretchDiffers, match="too few valid readings"):
        compare.judge()
    compare.from_box(5)
    with pytest.raises(RunInterrupted, match="restarted"):
        compare.from_box(6)


def test_a_machine_that_is_far_behind_from_the_beginning_is_not_known():
    assert seen(20.0, lag_mm=20.0).doc() == {}


@pytest.mark.parametrize("share", [0.3, 0.55, 0.8, 0.95])
def test_on_a_circle_whose_places_are_passed_twice_it_goes_back_a_lead_and_a_stretch(share):
    circle = Circle("c", "S", "identify", (300.0, 250.0, 100.0), 60.0, "XY", chord_mm=0.5, feed_mm_min=FEED, rate_hz=200).plan(MACHINE)
    step = next(s for s in circle.steps if isinstance(s, RecordPath))
    arc = arc_of(step.points_mm)
    good = share * float(arc[-1])
    at = np.arange(0.0, good, FEED_MM_S / 200.0)
    mounted = next(k for k, s in enumerate(circle.steps) if isinstance(s, MountBar))
    known = ReadProgress(pieces=(RunPiece(1, good),), counted_from_mm=0.0, arc_mm=at, deviation_mm=0.0 * at, boot_id=5)
    _, _, resume_trail, remainder = rest_of(circle, mounted, (), None, known)
    assert remainder is not None
    stands = [float(np.interp(good + 7.0, arc, np.array(step.points_mm)[:, a])) for a in range(3)]
    way = [tuple(stands), *way_back(resume_trail, (stands[0], stands[1], stands[2]))]
    assert sum(dist(a, b) for a, b in pairwise(way)) == pytest.approx(good + 7.0 - remainder.offset_mm, abs=0.1)
    assert way[-1] == step.points_mm[int(np.searchsorted(arc, remainder.offset_mm - 1e-6))]
