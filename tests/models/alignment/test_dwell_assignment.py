"""Which standstill is which place, on a machine that drifts and with a turn of a few hundredths beyond the ends: right, or refused; never
wrong."""

import re

import numpy as np
import pytest

from abbe.models.alignment.dwell import PlannedDwell, detect, match, named, places_reach
from tests.models.alignment.dwell_world import SETTLE_S, ZERO_MM, case, wrong_readings


def judged(seed: int, zero: float | None) -> str:
    """One case: right, less (something that was there is called missing), refused or wrong."""
    one = case(seed)
    try:
        found = detect(one.t_s, one.y_mm, one.planned, settle_s=SETTLE_S, zero=zero)
    except ValueError as error:
        return "refused" if re.fullmatch(r"dwells: [^\n]+", str(error)) else f"wrong: {one.words}: {error}"
    if wrong_readings(one, found):
        return "wrong: " + one.words
    assert set(found.missing) >= set(one.lost), one.words
    return "right" if found.missing == one.lost else "less"


@pytest.mark.parametrize("block", range(4))
def test_every_reading_is_of_its_place_or_the_run_is_refused(block):
    """Drift within 20 um/h, overrun 0.05 to 1 mm, lost motion within 15 um, pitch errors, noise 0.3 um; dwells lost, doubled, both."""
    seeds = range(16 * block, 16 * block + 16)
    found = {seed: judged(seed, ZERO_MM) for seed in seeds}
    assert not [words for words in found.values() if words.startswith("wrong")]
    assert [seed for seed in seeds if seed % 4 in (0, 2) and found[seed] != "right"] == []  # nothing lost: nothing refused
    assert sum(words == "right" for words in found.values()) >= 12


def test_where_nobody_knows_the_zero_it_is_the_same():
    found = [judged(seed, None) for seed in range(8)]
    assert not [words for words in found if words.startswith("wrong")]
    assert sum(words == "right" for words in found) >= 5


def stream(stands, feed_mm_s=10.0, noise_mm=3e-4):
    """Samples of a program that rests at (place, seconds); seconds 0: it turns there."""
    rng = np.random.default_rng(8)
    knots, now, at = [(0.0, stands[0][0])], 0.0, stands[0][0]
    for place, seconds in stands:
        for dt in (abs(place - at) / feed_mm_s, seconds):
            now += dt
            knots.append((now, place))
        at = place
    t = np.arange(0.0, now, 0.05)
    return t, np.interp(t, *zip(*knots, strict=True)) + noise_mm * rng.normal(size=t.size)


WAY = (0.0, 20.0, 40.0, 60.0, 60.05, 60.0, 40.0, 20.0, 0.0)
PLANNED = tuple(PlannedDwell(x, 1.0) for x in WAY)


def test_an_error_as_large_as_the_overrun_does_not_make_the_turn_the_last_position():
    """The dwell at 60 on the way out is lost; the machine is 45 um short there: by absolute places the turning point would be 60."""
    made = [(x - 45e-3 * x / 60.0, 1.0) for k, x in enumerate(WAY) if k != 3]
    t, y = stream(made)
    found = detect(t, y, PLANNED, settle_s=SETTLE_S, zero=0.0)
    assert found.missing == (3,)
    assert found.readings[4].value == pytest.approx(60.05 - 45e-3, abs=1e-3)


def test_a_slow_drift_as_large_as_the_overrun_changes_nothing():
    t, y = stream([(x, 1.0) for x in WAY])
    found = detect(t, y + 60e-3 * t / t[-1], PLANNED, settle_s=SETTLE_S, zero=0.0)
    assert named(found, PLANNED) == ()


def test_counts_that_are_lost_at_standstill_are_no_short_move():
    """A step of 50 um while nothing moves, far from where the plan has so short a move."""
    t, y = stream([(x, 1.0) for x in WAY])
    at = np.flatnonzero(np.abs(y - 20.0) < 5e-3)[10]
    with pytest.raises(ValueError, match=r"jumped by 0\.05.* the plan has no such move"):
        detect(t, y + np.where(np.arange(t.size) >= at, 0.05, 0.0), PLANNED, settle_s=SETTLE_S, zero=0.0)


def test_a_stand_approached_from_the_other_side_is_not_the_planned_one():
    """The program overshoots a position without resting and comes back to it: lost motion makes that another reading."""
    t, y = stream([(0.0, 1.0), (20.0, 1.0), (45.0, 0.0), (40.0, 1.0), *((x, 1.0) for x in WAY[3:])])
    found = detect(t, y, PLANNED, settle_s=SETTLE_S, zero=0.0)
    assert found.missing == (2,)
    assert [after for after, _ in found.extra] == [1]


def test_a_standstill_that_may_be_two_places_is_not_guessed():
    """Two places 40 um apart on the way out and one standstill, 18 um from the one and 22 from the other."""
    targets = np.array([0.0, 20.0, 20.04, 40.0])
    found = match(np.array([0.0, 20.018, 40.0]), np.array([0.0, 1.0, 1.0]), targets, offset=0.0, noise=1e-4, zeroed=True)
    assert found.rival is not None
    stand, ours, other = found.rival
    assert (stand, {ours, other}) == (1, {1, 2})
    planned = tuple(PlannedDwell(float(x), 1.0) for x in targets)
    t, y = stream([(0.0, 1.0), (20.018, 1.0), (40.0, 1.0)])
    with pytest.raises(ValueError, match="may be planned standstill 2 or 3; nothing is guessed"):
        detect(t, y, planned, settle_s=SETTLE_S, zero=0.0)


def test_the_reach_of_a_place_is_half_the_way_to_the_next_one_of_its_side():
    sides = np.array([0.0, 1.0, 1.0, 1.0, 1.0, -1.0, -1.0, -1.0, -1.0])
    reach = places_reach(np.array(WAY), sides)
    assert reach[3] == pytest.approx(0.0375)  # the turning point is approached from its side
    assert reach[5] == pytest.approx(2.0)  # on the way back nothing near is: the limit
