"""Effects of the scatter: found when they are there, silent on noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy

from abbe.models.arrays import F1
from abbe.models.discovery.baseline import baseline_of
from abbe.models.discovery.instrument_noise import Colour, comes_back, lone, remembered, unscaled
from abbe.models.discovery.localization import Localization
from abbe.models.discovery.variance.rounds import without
from abbe.models.discovery.variance.scatter_effects import (
    VarianceFinding,
    candidates,
    contaminated,
    creeping,
    extra_variance,
    teeth_mm2,
)
from abbe.models.discovery.variance.spectrum import gated_roughness, tooth_variance
from abbe.models.discovery.whitened_problem import whiten
from abbe.models.effects.path import Path
from tests.models.discovery.discovery_paths import bar, campaign, case_of_paths, circle, noise

PATHS = campaign()
SIGMA = tuple(4e-4 if p.kind == "bar" else 3e-4 for p in PATHS)


def found(add: list[F1], seed: int = 3) -> tuple[VarianceFinding, ...]:
    rest = tuple(e + a / s for e, a, s in zip(noise(PATHS, seed), add, SIGMA, strict=True))
    return extra_variance(PATHS, rest, SIGMA)


def only_bars(make: object) -> list[F1]:
    return [make(p) if p.kind == "bar" else np.zeros(p.n) for p in PATHS]  # type: ignore[operator]


def test_vibration_by_axis_frequency_and_amplitude() -> None:
    rng = np.random.default_rng(1)

    def wave(p: Path) -> F1:
        return np.asarray(0.6e-3 * np.sin(2 * np.pi * 37.3 * p.at.t_s + rng.uniform(0, 6.28)) * p.look[:, 1])

    first = found(only_bars(wave))[0]
    assert first.label == "vibration:Y"
    assert abs(first.parameters["frequency_hz"] - 37.3) < 0.1
    assert abs(first.strength - 0.6) < 3 * first.u_strength < 0.2


def test_stick_slip_by_axis_and_size() -> None:
    rng = np.random.default_rng(2)

    def saw(p: Path) -> F1:
        tooth = 2.0 * rng.uniform(size=p.n) - 1.0
        gate = np.exp(-np.square(p.at.v_mm_s[:, 0] / 2.0)) * (np.ptp(p.at.q_mm[:, 0]) > 0)
        return np.asarray(3e-3 * tooth * gate * p.look[:, 0])

    first = found(only_bars(saw))[0]
    assert first.label == "stick_slip:X"
    assert first.location.axes == ("X",)
    assert abs(first.strength - 3.0) < 0.5
    assert 1.2 < first.parameters["v_c"] < 3.2


def test_an_axis_that_creeps_at_one_speed_tells_the_scatter_there_and_no_height() -> None:
    """Height and speed of decay have only their product in common: an average of each would be a hundred times too much."""
    rng = np.random.default_rng(2)
    bars = [replace(p, at=replace(p.at, v_mm_s=p.at.v_mm_s.copy())) for p in PATHS if p.kind == "bar"]
    for k, p in enumerate(bars):
        p.at.v_mm_s[:, 0] = 2.0 if k % 2 else 50.0
    paths = tuple(bars)
    creeps = [float(k % 2 and np.ptp(p.at.q_mm[:, 0]) > 0) for k, p in enumerate(paths)]
    true = [2e-3 * p.look[:, 0] * c for p, c in zip(paths, creeps, strict=True)]  # half height of the teeth at this speed
    rest = tuple(e + t * rng.uniform(-1.0, 1.0, p.n) / 4e-4 for p, e, t in zip(paths, noise(paths, 3), true, strict=True))
    rough = gated_roughness(paths, rest, (4e-4,) * len(paths))[0]
    teeth = tooth_variance(paths, 0, rough.v_c) * rough.size_mm**2 / 3.0
    assert teeth.sum() == pytest.approx(sum(float(t @ t) / 3.0 for t in true), rel=0.3)
    assert rough.u_mm > rough.size_mm / 2.0


def test_few_laser_readings_that_are_off() -> None:
    rng = np.random.default_rng(4)
    add = [np.where(rng.uniform(size=p.n) < 0.03, 2e-3 * rng.choice([-1, 1], p.n), 0.0) * (p.kind == "laser") for p in PATHS]
    first = found(add)[0]
    assert first.label == "beam_outliers"
    assert first.location.tests == ("laser_diagonal",)
    assert abs(first.strength - 2.0) < 0.6
    assert 0.005 < first.parameters["rate"] < 0.08


def test_a_burst_of_one_run_is_located_and_has_no_name() -> None:
    rng = np.random.default_rng(5)
    run = PATHS[1]
    middle = float(run.at.t_s[len(run.at.t_s) // 2])
    add = [6e-3 * rng.standard_normal(p.n) * (np.abs(p.at.t_s - middle) < 1.5) * (p is run) for p in PATHS]
    bursts = [f for f in found(add) if f.name == "unnamed_burst"]
    assert bursts
    assert bursts[0].location.runs == (run.label,)
    assert bursts[0].location.time_s is not None
    assert bursts[0].location.time_s[0] - 1 < middle < bursts[0].location.time_s[1] + 1


def test_single_wrong_readings_of_a_bar_have_a_name_and_nothing_else_is_blamed() -> None:
    rng = np.random.default_rng(6)
    wrong = [(rng.uniform(size=p.n) < 0.05) * float(p.kind == "bar") for p in PATHS]
    rest = tuple(e + w * 8e-3 * rng.choice([-1, 1], p.n) / s for e, w, p, s in zip(noise(PATHS, 3), wrong, PATHS, SIGMA, strict=True))
    kept = lone(
        np.concatenate(rest), [p.n for p in PATHS], [p.kind for p in PATHS], np.zeros(sum(p.n for p in PATHS)), {"bar": 0.0, "laser": 0.0}
    )
    assert np.mean((kept == 0.0) == (np.concatenate(wrong) > 0.0)) > 0.995
    alone = tuple(np.split(1.0 - kept, np.cumsum([p.n for p in PATHS])[:-1]))
    only, *others = extra_variance(PATHS, rest, SIGMA, alone=alone)
    assert others == []
    assert only.label == "bar_outliers"
    assert only.strength == pytest.approx(8.0, rel=0.1)
    assert only.parameters["rate"] == pytest.approx(0.05, abs=0.01)


@pytest.mark.parametrize(("outliers", "names"), [(0.0, ["stick_slip"]), (0.05, ["bar_outliers", "stick_slip"])])
def test_teeth_as_long_as_one_reading_are_no_outliers_of_the_bar(outliers: float, names: list[str]) -> None:
    """Wrong readings are named where no axis sticks."""
    rng = np.random.default_rng(2)
    far = [(rng.uniform(size=p.n) < outliers) * (np.abs(p.at.v_mm_s[:, 0]) > 5.0) * float(p.kind == "bar") for p in PATHS]
    gates = [(np.abs(p.at.v_mm_s[:, 0]) < 2.0) * float(np.ptp(p.at.q_mm[:, 0]) > 0 and p.kind == "bar") for p in PATHS]
    teeth = [3e-3 * g * rng.uniform(-1.0, 1.0, g.size) * p.look[:, 0] for g, p in zip(gates, PATHS, strict=True)]
    add = zip(noise(PATHS, 3), teeth, far, SIGMA, PATHS, strict=True)
    rest = tuple(e + (a + 8e-3 * w * rng.choice([-1, 1], p.n)) / s for e, a, w, s, p in add)
    alone = tuple(np.clip(w + (np.abs(a) > 2e-3), 0.0, 1.0) for a, w in zip(teeth, far, strict=True))
    assert sum(a[g > 0].sum() for a, g in zip(alone, gates, strict=True)) > 20
    assert sorted(f.name for f in extra_variance(PATHS, rest, SIGMA, alone=alone)) == names


def test_an_axis_that_rests_does_not_stick() -> None:
    stick = VarianceFinding("stick_slip", "Z", 3.0, 0.1, {"v_c": 2.0}, 50.0, Localization())
    teeth, slow = teeth_mm2(PATHS, stick), creeping(PATHS, stick)
    moves = np.concatenate([np.full(p.n, p.kind == "bar" and np.ptp(p.at.q_mm[:, 2]) > 0) for p in PATHS])
    assert not teeth[~moves].any()
    assert not slow[~moves].any()
    assert slow[moves].any()
    assert teeth.max() == pytest.approx(3e-3**2 / 3.0, rel=0.05)  # a tooth of half height h: h^2/3, where Z creeps along the bar


def test_readings_that_an_axis_makes_scatter_have_less_weight_in_the_search() -> None:
    case = case_of_paths(PATHS)
    problem = whiten(case, baseline_of(case))
    stick = VarianceFinding("stick_slip", "Z", 3.0, 0.1, {"v_c": 2.0}, 50.0, Localization())
    teeth = teeth_mm2(problem.paths, stick)
    use = without(problem, [stick]).use
    assert np.allclose(np.square(problem.sd_mm() / use), np.square(problem.sd_mm()) + teeth, rtol=1e-9)
    assert use.max() == 1.0
    assert use.min() < 0.3


def test_readings_off_in_a_row_or_at_every_reversal_are_no_accident() -> None:
    rest = np.random.default_rng(7).normal(size=400)
    rest[100:108] += 20.0 * np.array([1, -1, 1, -1, 1, -1, 1, -1])
    turns = np.zeros(400)
    turns[[20, 120, 220, 320]] = 1.0
    rest[turns > 0] += 25.0
    resolution = {"bar": 0.0}
    assert lone(rest, [400], ["bar"], turns, resolution).all()
    rest[[50, 250]] = 30.0
    assert np.flatnonzero(lone(rest, [400], ["bar"], turns, resolution) == 0.0).tolist() == [50, 250]


def test_a_quarter_where_the_bar_scatters_more_is_a_place_without_run_or_time() -> None:
    rng = np.random.default_rng(9)
    more = only_bars(lambda p: 1e-3 * rng.standard_normal(p.n) * ((p.look[:, 0] > 0) & (p.look[:, 1] > 0)))
    first = found(more)[0]
    assert first.label == "unnamed_rough:+X+Y"
    assert "to +X +Y, in most runs" in first.location.shape
    assert (first.location.runs, first.location.time_s) == ((), None)


@pytest.mark.parametrize(("runs", "remembers"), [(8, True), (2, False)])
def test_noise_that_wanders_in_all_runs_is_noise_and_in_few_it_is_not(runs: int, remembers: bool) -> None:
    rng = np.random.default_rng(10)
    lengths, kinds, usual = [300] * 8, ["bar"] * 8, {"bar": Colour(1.0)}
    slow = scipy.signal.lfilter([1.0], [1.0, -0.95], rng.normal(size=(8, 300)) * 0.5, axis=1) * (np.arange(8) < runs)[:, None]
    white = unscaled((rng.normal(size=2400) + slow.ravel())[:, None], lengths, kinds, usual)[:, 0]
    colour = remembered(white, lengths, kinds, usual)["bar"]
    assert (colour.gain > 0.0) == remembers
    assert (colour.memory > 0.85) == remembers


def test_noise_alone_names_nothing() -> None:
    """15 campaigns of noise, four kinds of effect each: none above zero; a rate of 3 in 1000 each gives none of 60 with 84 %."""
    best = [max(f.evidence for f in candidates(PATHS, noise(PATHS, 100 + seed), SIGMA)) for seed in range(15)]
    assert max(best) < 0.0


def test_mean_that_is_left_is_no_vibration() -> None:
    def smooth(p: Path) -> F1:
        return np.asarray(1e-3 * np.sin(3.0 * np.linspace(0.0, 2 * np.pi, p.n)) * p.look[:, 0])

    assert not [f for f in found(only_bars(smooth)) if f.name == "vibration"]


@pytest.mark.parametrize("feeds", [(1500.0,), (1500.0, 2600.0)])
def test_what_comes_back_at_every_turn_of_the_bar_is_no_vibration(feeds: tuple[float, ...]) -> None:
    """Nine lobes of a ball: a frequency in time as well, where all runs have one feed; only a run that meets them otherwise could tell."""
    paths = tuple(bar(f"{f:.0f}{k}", circle((0, 1)), 620.0 + 90.0 * k, feed=f) for f in feeds for k in range(4))
    sigma = (4e-4,) * len(paths)
    angles = [np.arctan2(p.look[:, 1], p.look[:, 0]) for p in paths]
    rest = tuple(e + 1e-3 * np.sin(9.0 * a) * p.look[:, 0] / s for e, a, p, s in zip(noise(paths, 5), angles, paths, sigma, strict=True))
    assert "vibration" not in [f.name for f in extra_variance(paths, rest, sigma)]


def test_mixture_needs_more_than_one_reading() -> None:
    rest = np.random.default_rng(8).standard_normal(300)
    rest[17] = 4.5
    assert contaminated(rest).gain < 7.0


def test_every_run_is_whitened_anew_by_the_filter_of_its_instrument() -> None:
    colours, lengths, kinds = {"bar": Colour(4e-4), "laser": Colour(3e-4, 0.5, 0.96)}, [50, 1, 30], ["bar", "laser", "laser"]
    columns = np.random.default_rng(7).normal(size=(81, 3))
    white, start = unscaled(columns, lengths, kinds, colours), 0
    for n, kind in zip(lengths, kinds, strict=True):
        m, c, v = colours[kind].filter()
        alone = scipy.signal.lfilter([1.0, -m], [1.0, c], columns[start : start + n], axis=0) / np.sqrt(v)
        alone[0] *= np.sqrt(v)
        assert white[start : start + n] == pytest.approx(alone, rel=1e-12, abs=1e-12)
        start += n
    assert unscaled(columns[:, :0], lengths, kinds, colours).shape == (81, 0)


def test_leverage_is_taken_back() -> None:
    rest = noise(PATHS, 9)
    squeezed = tuple(0.7 * r for r in rest)
    leverage = tuple(np.full(p.n, 1.0 - 0.49) for p in PATHS)
    a = [f.evidence for f in candidates(PATHS, rest, SIGMA)]
    b = [f.evidence for f in candidates(PATHS, squeezed, SIGMA, leverage=leverage)]
    assert np.allclose(a, b, rtol=1e-6, atol=1e-6)


def test_a_place_where_the_machine_is_off_is_no_lost_beam() -> None:
    """Two runs of each diagonal pass the same corner; a lost beam is not lost again there."""
    laser = [p for p in PATHS if p.kind == "laser"]
    corner = laser[0].at.q_mm[12]

    def bump(p: Path) -> F1:
        return np.asarray(4e-3 * np.exp(-0.5 * np.sum((p.at.q_mm - corner) ** 2, axis=1) / 15.0**2) * (p.kind == "laser"))

    first = found([bump(p) for p in PATHS])[0]
    assert first.label == "unnamed_place"
    assert first.location.position_mm is not None
    assert np.linalg.norm(np.array(first.location.position_mm) - corner) < 30.0


def test_what_comes_back_in_runs_along_the_same_path_is_no_noise() -> None:
    rng = np.random.default_rng(12)
    paths = (PATHS[0], replace(PATHS[0], label="again"))
    wander = [scipy.signal.lfilter([1.0], [1.0, -0.9], rng.normal(size=PATHS[0].n)) for _ in paths]
    assert not comes_back(paths, wander, "bar")
    assert comes_back(paths, [w + 5.0 * wander[0] for w in wander], "bar")
    assert comes_back(paths[:1], wander[:1], "bar")  # one run cannot tell
