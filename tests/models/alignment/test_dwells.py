"""Standstills of a program that somebody else runs: found under noise, drift, backlash, vibration; what is missing or too much is named."""

import numpy as np
import pytest

from abbe.models.alignment.dwell import PlannedDwell, detect, merged, named, noise_of

SETTLE_S = 0.3


def world(seed):
    """A plan, its stream at 20 Hz as a program would make it, the true deviation at each reading, and what was done wrong."""
    rng = np.random.default_rng(seed)
    n, step = int(rng.integers(5, 16)), float(rng.choice([2.0, 20.0, 80.0]))
    way = step * np.arange(n)
    targets = np.concatenate([way, way[::-1]])
    planned = merged([PlannedDwell(float(x), 1.0) for x in targets])
    feed = min(float(rng.choice([5.0, 30.0, 100.0])), step / 0.4)  # what lasts less than two samples nobody can see
    wrong = {}
    if seed % 3 == 1:
        wrong["missing"] = int(rng.choice([k for k in range(1, len(planned) - 1) if k != n - 1]))
    if seed % 3 == 2:
        wrong["doubled"] = int(rng.integers(1, len(planned) - 1))
    backlash, drift, noise = rng.uniform(-0.01, 0.01), rng.uniform(-1e-5, 1e-5), float(rng.choice([2e-5, 3e-4, 1e-3]))
    shake = float(rng.choice([0.0, 2e-3])) * (noise > 1e-4)
    knots_s, knots_mm, where, now = [0.0], [planned[0].target], [], 0.0
    for k, one in enumerate(planned):
        back = k > n - 1
        place = one.target + 2e-5 * one.target + (backlash if back else 0.0)
        visits = 0 if wrong.get("missing") == k else 2 if wrong.get("doubled") == k else 1
        for visit in range(visits):
            if visit:  # away by half a step and back: the point was in the program twice
                now += 0.5 * step / feed
                knots_s.append(now)
                knots_mm.append(place + 0.5 * step)
            now += abs(place - knots_mm[-1]) / feed
            knots_s.append(now)
            knots_mm.append(place)
            stay = one.seconds * float(rng.choice([1.0, 1.0, 1.0, 0.8, 1.5]))
            now += stay
            knots_s.append(now)
            knots_mm.append(place)
            where.append((k, place))
    t = np.arange(0.0, now, 0.05) + rng.uniform(0.0, 0.05)
    y = np.interp(t, knots_s, knots_mm) + 17.0 + drift * t + noise * rng.normal(size=t.size) + shake * np.sin(2 * np.pi * 7.3 * t)
    return planned, t, y, where, wrong, (drift, noise, shake)


@pytest.mark.parametrize("block", range(4))
def test_every_reading_is_found_in_its_place_or_named(block):
    worst, covered, count = 0.0, 0, 0
    for seed in range(25 * block, 25 * block + 25):
        planned, t, y, where, wrong, (drift, _, shake) = world(seed)
        found = detect(t, y, planned, settle_s=SETTLE_S, zero=17.0 if seed % 2 else None)
        assert found.missing == ((wrong["missing"],) if "missing" in wrong else ()), seed
        assert len(found.extra) == (1 if "doubled" in wrong else 0), seed
        if "doubled" in wrong:
            assert abs(found.extra[0][0] - wrong["doubled"]) <= 1, seed
        truth = dict(where)
        values = iter(found.readings)
        for k, one in enumerate(planned):
            for reading in [next(values) for _ in range(one.readings)]:
                if k in found.missing:
                    assert reading is None
                    continue
                error = reading.value - 17.0 - truth[k] - drift * 0.5 * (reading.start_s + reading.end_s)
                worst = max(worst, abs(error) / (reading.u + shake))
                covered += abs(error) <= 2.0 * (reading.u + 0.3 * shake)
                count += 1
    assert worst < 6.0
    assert covered / count > 0.9


def test_the_words_say_which_standstill_is_missing_or_too_much():
    planned, t, y, _, wrong, _ = world(1)
    assert named(detect(t, y, planned, settle_s=SETTLE_S), planned)[0].startswith(f"standstill {wrong['missing'] + 1} of {len(planned)}")
    planned, t, y, _, wrong, _ = world(2)
    assert any("unplanned standstill" in line for line in named(detect(t, y, planned, settle_s=SETTLE_S), planned))


def test_a_stand_of_the_wrong_length_is_said():
    planned = merged([PlannedDwell(float(x), 1.0) for x in (0.0, 10.0, 20.0, 30.0)])
    t = np.arange(0.0, 9.0, 0.05)
    y = np.interp(t, [0.0, 1.0, 1.1, 2.1, 2.2, 5.2, 5.3, 6.3], [0.0, 0.0, 10.0, 10.0, 20.0, 20.0, 30.0, 30.0])[: np.searchsorted(t, 6.3)]
    found = detect(t[: y.size], y, planned, settle_s=SETTLE_S)
    assert found.odd == (2,)
    assert found.missing == found.extra == ()


def test_where_the_turn_is_missing_nobody_guesses_which_way_the_plan_lies():
    """Out and back without the turning point: the same as a plan that is one step shorter, unless it is known where the zero is."""
    planned = merged([PlannedDwell(float(x), 1.0) for x in (0.0, 10.0, 20.0, 30.0, 20.0, 10.0, 0.0)])
    knots = [0.0, 1.0, 1.2, 2.2, 2.4, 4.4, 4.6, 5.6, 5.8, 6.8]
    t = np.arange(0.0, 6.8, 0.05)
    y = 5.0 + np.interp(t, knots, [0.0, 0.0, 10.0, 10.0, 20.0, 20.0, 10.0, 10.0, 0.0, 0.0])
    with pytest.raises(ValueError, match="two ways"):
        detect(t, y, planned, settle_s=SETTLE_S)
    found = detect(t, y, planned, settle_s=SETTLE_S, zero=5.0)
    assert 3 in found.missing
    assert len(found.missing) == 2  # and one of its neighbours: their place was held once, not twice
    assert len(found.odd) == 1


def test_a_stream_of_another_program_is_refused_and_noise_alone_is_no_program():
    planned, t, y, *_ = world(3)
    other = merged([PlannedDwell(float(x), 1.0) for x in np.cumsum(np.random.default_rng(1).uniform(3.0, 50.0, 20))])
    with pytest.raises(ValueError, match="another program"):
        detect(t, y, other, settle_s=SETTLE_S)
    with pytest.raises(ValueError, match="another program"):
        detect(t, np.random.default_rng(2).normal(size=t.size), planned, settle_s=SETTLE_S)
    with pytest.raises(ValueError, match="have the same target"):
        detect(t, y, (PlannedDwell(0.0, 1.0), PlannedDwell(0.0, 1.0)), settle_s=SETTLE_S)


def test_noise_is_told_from_motion():
    rng = np.random.default_rng(4)
    moving = 50.0 * np.arange(0.0, 10.0, 0.05) + 1e-3 * rng.normal(size=200)
    assert noise_of(moving) == pytest.approx(1e-3, rel=0.25)


def stream(seed=0):
    """A short line out and back and its stream, nothing wrong."""
    planned = merged([PlannedDwell(float(x), 1.0) for x in (0, 50, 100, 150, 200, 200, 150, 100, 50, 0)])
    knots_s, knots_mm, now = [0.0], [0.0], 0.0
    for one in planned:
        for seconds in (abs(one.target - knots_mm[-1]) / 100.0, one.seconds):
            now += seconds
            knots_s.append(now)
            knots_mm.append(one.target)
    t = np.arange(0.0, now, 0.05)
    return planned, t, np.interp(t, knots_s, knots_mm) + 1e-5 * np.random.default_rng(seed).normal(size=t.size)


@pytest.mark.parametrize("by_mm", [1.5, -0.02])
def test_a_reading_that_jumps_while_the_machine_stands_is_refused(by_mm):
    planned, t, y = stream()
    detect(t, y, planned, settle_s=SETTLE_S, zero=0.0)
    at = np.flatnonzero(np.abs(y - 100.0) < 1e-3)[10]  # in the middle of the third standstill
    with pytest.raises(ValueError, match=f"jumped by {by_mm:.2f}"):
        detect(t, y + np.where(np.arange(t.size) >= at, by_mm, 0.0), planned, settle_s=SETTLE_S, zero=0.0)


def test_the_machine_may_stand_long_before_the_first_and_after_the_last():
    planned, t, y = stream()
    rng = np.random.default_rng(1)
    warming = np.linspace(-0.01, 0.0, 400)  # the laser drifts while somebody walks to the panel
    long = np.concatenate([warming + 1e-5 * rng.normal(size=400), y, 1e-5 * rng.normal(size=400)])
    found = detect(0.05 * np.arange(long.size), long, planned, settle_s=SETTLE_S, zero=0.0)
    assert named(found, planned) == ()
    assert abs(found.readings[0].value) < 1e-3  # of the last planned second, not of twenty
    assert found.readings[0].samples < 25
    assert found.readings[-1].samples < 25
    late = detect(t[14:], y[14:], planned, settle_s=SETTLE_S, zero=0.0)
    assert "standstill 1 was much longer or shorter than the planned 1.0 s" in named(late, planned)


def test_a_coarse_instrument_at_rest_flickers_and_its_uncertainty_holds_the_rounding():
    """A dial gauge of 1 um beside 0.2 um of noise: nearly all samples of a standstill are the same, some are one step off."""
    step, rng = 1e-3, np.random.default_rng(7)
    targets = [0.0, 2.0, 4.0, 6.0, 4.0, 2.0, 0.0]
    planned = merged([PlannedDwell(x, 1.0) for x in targets])
    knots_s, knots_mm = [0.0], [0.0]
    for target in targets:
        knots_s += [
            knots_s[-1] + max(abs(target - knots_mm[-1]) / 5.0, 0.05),
            knots_s[-1] + max(abs(target - knots_mm[-1]) / 5.0, 0.05) + 1.0,
        ]
        knots_mm += [target * 1.0002, target * 1.0002]
    t = np.arange(0.0, knots_s[-1], 0.05)
    y = np.round((np.interp(t, knots_s, knots_mm) + 2e-4 * rng.normal(size=t.size)) / step) * step
    assert noise_of(y) == 0.0
    found = detect(t, y, planned, settle_s=SETTLE_S, zero=0.0, step=step)
    assert found.missing == ()
    for reading, target in zip((one for one in found.readings if one is not None), targets, strict=True):
        assert abs(reading.value - 1.0002 * target) < 2.0 * reading.u
        assert step / np.sqrt(12.0) <= reading.u < step
