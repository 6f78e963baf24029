"""Hidden effects: nothing at zero strength, the published formula to first order in textbook form, memory, what wild forms do."""

from dataclasses import replace

import numpy as np
import pytest

from abbe.simulators.arrays import F
from abbe.simulators.hidden import cases
from abbe.simulators.hidden.draws import CATALOGUE, OUTSIDE, RANDOM, config_of
from abbe.simulators.hidden.effect import Hidden
from abbe.simulators.hidden.plans import Machinery, Run, runs_of
from abbe.simulators.hidden.rig import PerfectMachine, Rig
from abbe.simulators.hidden.thermal import warmth
from abbe.simulators.hidden.track import follow
from abbe.simulators.scenario import Scenario
from abbe.simulators.truth.draws import draw_machine
from abbe.simulators.truth.machine import Geometry, Machine

assert cases.ALL_EFFECTS
CHAIN = "w-X-b-Y-Z-t"
CONFIG = config_of(CHAIN)[0]
GEOMETRY = Geometry(CONFIG)
PERFECT = PerfectMachine(Machine(GEOMETRY, draw_machine(Scenario(machine=CONFIG))))
RUNS = runs_of("full", Machinery(GEOMETRY.low_mm, GEOMETRY.high_mm, 1, np.array([1.0, -1.0, 1.0])))
HELIX, CIRCLE, LASER = RUNS[3], RUNS[5], RUNS[17]
MORE = {
    "backlash_position_dependent": {"k": 0.7}, "reversal_spike": {"d0_mm": 0.5, "p": 0.4}, "stick_slip": {"period_mm": 0.2, "v_c": 3.0},
    "cyclic_error": {"pitch_mm": 12.0, "ph1": 1.0, "r2": 0.3, "ph2": 2.0}, "vibration": {"f_hz": 23.0}, "ram_sag": {"beta": 0.6},
    "straightness": {"seed": 5.0}, "positioning_nonlinear": {"seed": 5.0}, "angular_error": {"seed": 5.0},
    "axis_thermal_growth": {"tau_s": 3000.0, "x_fixed": 0.0}, "spindle_thermal_drift": {"tau_s": 3000.0},
    "squareness_thermal": {"tau_s": 3000.0}, "bar_thermal": {"tau_s": 700.0}, "air_refraction": {"period_s": 6000.0, "phase": 1.0},
    "beam_outliers": {"rate": 0.2}, "clamp_slip": {"t0_s": 5000.0}, "encoder_count_loss": {"t0_s": 1800.0},
    "local_bump": {"cx": 400.0, "cy": 400.0, "cz": 230.0, "w_mm": 25.0}, "ball_form": {"lobes": 3.0, "phase": 1.0},
    "interference_burst": {"t0_s": 1800.0, "width_s": 3.0, "f_hz": 1.0}, "counterbalance_surge": {"period_s": 40.0, "phase": 1.0},
}  # fmt: skip
ALL = CATALOGUE | OUTSIDE
ALPHA = 11.5e-6


def hidden(name: str, key: str | None = None, strength: float | None = None, **more: float) -> Hidden:
    """An effect at its usual strength, textbook form."""
    keys, _, guess, _ = ALL[name]
    own = keys[-1] if key is None else key
    extra = {"other": float(3 - "XYZ".index(own[1]) - "XYZ".index(own[2]))} if name == "nonrigid_bed" else MORE.get(name, {})
    return Hidden(name, own, {"strength": guess if strength is None else strength, **extra, **more}, 0, stream=9)


def trace(e: Hidden, run: Run) -> F:
    """What an effect adds to a reading, mm, (n,)."""
    return np.asarray(Rig(PERFECT, (e,)).reading(run) - Rig(PERFECT, ()).reading(run))


@pytest.mark.parametrize("name", sorted(ALL))
def test_zero_strength_is_exactly_nothing(name: str) -> None:
    for wild in (0, 77):
        e = replace(hidden(name, strength=0.0), wild=wild)
        for run in (HELIX, CIRCLE, LASER):
            assert np.array_equal(Rig(PERFECT, (e,)).reading(run), Rig(PERFECT, ()).reading(run)), (name, wild)


@pytest.mark.parametrize("name", sorted(ALL))
def test_it_shows_somewhere_and_wild_forms_bend_it(name: str) -> None:
    book, wild = hidden(name), replace(hidden(name), wild=77)
    plain = np.concatenate([trace(book, r) for r in RUNS])
    bent = np.concatenate([trace(wild, r) for r in RUNS])
    assert np.abs(plain).max() > 1e-5
    if name in CATALOGUE and name not in {"mirror_tilt", "setup_centre_offset", "beam_outliers", "straightness", "positioning_nonlinear",
                                          "angular_error"}:  # fmt: skip
        assert np.abs(plain - bent).max() > 1e-3 * np.abs(plain).max()
    assert np.abs(bent).max() < 4.0 * np.abs(plain).max()


def along(run: Run, direction: int, moved: F) -> F:
    """First-order reading of a displacement of the tool (n,) along one direction that is zero at the cup: look . moved."""
    reading = run.track.look[:, direction] * moved
    return np.asarray(reading if run.track.kind == "bar" else reading - reading[0])


FAR = 0.1
"""mm after a turn: what happens within lost motion itself is another test's business."""


@pytest.mark.parametrize("run", [HELIX, CIRCLE, LASER], ids=["helix", "circle", "laser"])
def test_drive_effects_are_the_published_formulas(run: Run) -> None:
    t = run.track
    far = (t.since_mm > FAR).all(axis=1)
    x = (2.0 * t.q_mm[:, 0] - t.low_mm[0] - t.high_mm[0]) / (t.high_mm[0] - t.low_mm[0])
    lost = along(run, 0, -0.5 * 3e-3 * t.sign[:, 0])
    assert trace(hidden("backlash", "X"), run)[far] == pytest.approx(lost[far], abs=2e-8)
    uneven = along(run, 0, -0.5 * 3e-3 * (1.0 + 0.7 * x) * t.sign[:, 0])
    assert trace(hidden("backlash_position_dependent", "X"), run)[far] == pytest.approx(uneven[far], abs=2e-8)
    angle = 2.0 * np.pi * t.q_mm[:, 1] / 12.0
    wave = along(run, 1, 2e-3 * (np.sin(angle + 1.0) + 0.3 * np.sin(2.0 * angle + 2.0)))
    cup = 2e-3 * (np.sin(2.0 * np.pi * 250.0 / 12.0 + 1.0) + 0.3 * np.sin(4.0 * np.pi * 250.0 / 12.0 + 2.0)) if t.kind == "bar" else 0.0
    assert trace(hidden("cyclic_error", "Y"), run) == pytest.approx(wave - t.look[:, 1] * cup, abs=5e-8)


def test_servo_effects_follow_velocity_and_acceleration() -> None:
    for run in (HELIX, CIRCLE):
        t = run.track
        mismatch = trace(hidden("servo_mismatch", "X", 0.1), run)
        assert mismatch == pytest.approx(-1e-4 * t.v_mm_s[:, 0] * t.look[:, 0], abs=2e-6)
    inward = trace(hidden("contour_lag", strength=20.0), CIRCLE)
    speed = CIRCLE.feed / 60.0
    assert inward == pytest.approx(np.full(CIRCLE.track.n, -((0.02 * speed) ** 2) / 300.0), rel=2e-3)
    assert np.abs(trace(hidden("contour_lag"), LASER)).max() == 0.0


def test_a_spike_stands_right_after_each_turn_and_nowhere_else() -> None:
    t = HELIX.track
    spike = trace(hidden("reversal_spike", "X", 4.0), HELIX)
    near = t.since_mm[:, 0] < 0.5
    assert near.sum() > 4
    assert np.all(spike[near] * t.look[:, 0][near] * t.sign[:, 0][near] <= 0.0), "held back against the motion"
    assert np.abs(spike[t.since_mm[:, 0] > 4.0]).max() < 1e-6
    assert np.abs(spike[near]).max() > 2e-3


def test_structure_effects_are_the_published_formulas() -> None:
    for run in (HELIX, LASER):
        t = run.track
        step = along(run, 1, 0.5 * 2e-3 * t.sign[:, 0])
        assert trace(hidden("lateral_play", "EYX"), run) == pytest.approx(step, abs=5e-8)
    t = LASER.track
    part = t.q_mm / (t.high_mm - t.low_mm)
    bed = 10e-3 * np.sin(np.pi * part[:, 0]) * (2.0 * part[:, 2] - 1.0)
    assert trace(hidden("nonrigid_bed", "EYX"), LASER) == pytest.approx(along(LASER, 1, bed), abs=5e-7)


def test_thermal_effects_are_the_published_formulas() -> None:
    late = RUNS[27]
    t = late.track
    grown = lambda s: -np.expm1(-np.asarray(s) / 3000.0)  # noqa: E731
    centre = np.array(late.setup["centre_mm"])
    scale = ALPHA * 3.0 * (grown(t.t_s) * t.q_mm[:, 0] - grown(t.set_s) * centre[0])
    assert trace(hidden("axis_thermal_growth", "X"), late) == pytest.approx(along(late, 0, scale), abs=2e-7)
    drift = 20e-3 * (grown(t.t_s) - grown(t.set_s))
    assert trace(hidden("spindle_thermal_drift", "Y"), late) == pytest.approx(along(late, 1, drift), abs=1e-7)
    oval = -20e-6 * (grown(t.t_s) * t.q_mm[:, 1] - grown(t.set_s) * centre[1])
    assert trace(hidden("squareness_thermal", "XY"), late) == pytest.approx(along(late, 0, oval), abs=2e-7)
    warm = -ALPHA * t.radius_mm * 2.0 * np.exp(-(t.t_s - t.set_s) / 700.0)
    assert trace(hidden("bar_thermal"), late) == pytest.approx(warm, abs=1e-12)


def test_instrument_effects_are_the_published_formulas() -> None:
    t = LASER.track
    assert trace(hidden("bar_length_error", strength=4.0), HELIX) == pytest.approx(np.full(HELIX.track.n, 4e-3), abs=1e-12)
    askew = trace(hidden("laser_cosine", strength=2.0), LASER)
    diagonal = np.arange(t.n) % 3 == 0
    outward = diagonal & (np.arange(t.n) <= 36)
    assert askew[outward] == pytest.approx(0.5 * (2e-3) ** 2 * t.reach_mm[outward], abs=2e-8)
    air = -0.93e-6 * 2.0 * np.sin(2.0 * np.pi * t.t_s / 6000.0 + 1.0) * t.reach_mm
    assert trace(hidden("air_refraction"), LASER) == pytest.approx(air, abs=1e-12)
    dead = -0.93e-6 * 900.0 * 3.0 * (t.t_s - t.t_s[0]) / 3600.0
    assert trace(hidden("dead_path"), LASER) == pytest.approx(dead, abs=1e-12)
    saw = trace(hidden("mirror_tilt", strength=500.0), LASER)
    assert np.abs(saw[outward]).max() < 1e-6, "back at zero on the diagonal itself"
    assert np.abs(saw).max() > 5e-3


def test_effects_outside_of_the_catalogue_live_where_the_truth_says() -> None:
    before, after = (trace(hidden("encoder_count_loss", "Y"), r) for r in (RUNS[0], RUNS[9]))
    assert np.abs(before).max() == 0.0
    assert after == pytest.approx(4e-3 * RUNS[9].track.look[:, 1] * (RUNS[9].track.t_s >= 1800.0), abs=1e-7)
    bump = np.abs(trace(hidden("local_bump", "Y"), CIRCLE))
    assert bump.max() > 3e-3
    assert np.linalg.norm(CIRCLE.track.q_mm[int(bump.argmax())] - [400.0, 400.0, 230.0]) < 10.0
    burst = trace(hidden("interference_burst"), RUNS[9])
    assert abs(RUNS[9].track.t_s[int(np.abs(burst).argmax())] - 1800.0) < 10.0 or np.abs(burst).max() < 1e-4


def test_play_has_memory() -> None:
    half = np.full(9, 1.0)
    drive = np.array([0.0, 5.0, 4.0, 3.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    #            pushed up   rests   pushed down  rests      pushed up
    assert follow(drive, half).tolist() == [-1.0, 4.0, 4.0, 4.0, 3.0, 3.0, 3.0, 4.0, 5.0]


def test_a_small_way_back_within_the_play_moves_nothing() -> None:
    half = np.full(4, 1.0)
    assert follow(np.array([0.0, 5.0, 4.2, 5.0]), half).tolist() == [-1.0, 4.0, 4.0, 4.0]


def test_warmth_integrates_from_instant_to_instant() -> None:
    t = np.array([10.0, 600.0, 50.0, 9000.0])
    assert warmth(t, 700.0) == pytest.approx(-np.expm1(-t / 700.0), rel=1e-12)
    two = warmth(t, 700.0, slow_share=0.3, slow_s=3000.0)
    assert two == pytest.approx(-0.7 * np.expm1(-t / 700.0) - 0.3 * np.expm1(-t / 3000.0), rel=1e-12)


def test_random_phases_differ_from_run_to_run_but_not_from_time_to_time() -> None:
    for name in sorted(RANDOM - {"interference_burst", "beam_outliers"}):
        e = hidden(name, "X")
        assert np.array_equal(trace(e, HELIX), trace(e, HELIX))
        assert not np.allclose(trace(e, HELIX), trace(e, RUNS[1]))
