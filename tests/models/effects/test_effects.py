"""Every effect of the catalogue: one runner over all, then each one's published number."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares

from abbe.models.arrays import F1, F2
from abbe.models.effects.catalogue import CATALOGUE
from abbe.models.effects.drives import vibration
from abbe.models.effects.effect import Effect
from abbe.models.effects.instruments.bar_thermal import HANDLED_K
from abbe.models.effects.path import Path
from abbe.models.effects.self_test import CENTRE_MM, DEAD_PATH_MM, MACHINE, corners, declaration_faults, probe_paths, signal_faults
from abbe.models.geometry.bases import smooth_terms
from abbe.models.geometry.chain import design
from abbe.models.machine import Machine

PATHS = probe_paths()
BY_NAME = {e.name: e for e in CATALOGUE}
LABELS = [(e, k) for e in CATALOGUE for k in e.keys]
STRENGTH_UNITS = {
    **dict.fromkeys(("servo_mismatch", "contour_lag"), "ms"),
    **dict.fromkeys(("axis_thermal_growth", "bar_thermal", "air_refraction"), "K"),
    **dict.fromkeys(("angular_error", "squareness_thermal", "mirror_tilt"), "urad"),
    "dead_path": "K/h",
    "laser_cosine": "mrad",
}


def of(name: str, key: str, **values: float) -> list[F2]:
    """Columns of one effect on the probe campaign, usual non-linear parameters but for those given."""
    effect = BY_NAME[name]
    return effect.signal(PATHS, key, {p.name: p.typical for p in effect.shape} | values)


def run(label: str) -> int:
    """Place of a run."""
    return [p.label for p in PATHS].index(label)


@pytest.mark.parametrize("effect", CATALOGUE, ids=lambda e: e.name)
def test_an_effect_is_declared_and_behaves(effect: Effect) -> None:
    assert declaration_faults(effect) == ()
    assert signal_faults(effect, PATHS) == ()
    assert effect.unit == STRENGTH_UNITS.get(effect.name, "um")  # run-format.md 5


def test_the_names_are_those_of_the_exchange_format() -> None:
    assert len(BY_NAME) == len(CATALOGUE) == 28
    known = set(BY_NAME) | {e.label(k) for e, k in LABELS}
    assert {r for e in CATALOGUE for r in e.separated_by} <= known


@pytest.mark.parametrize("effect", CATALOGUE, ids=lambda e: e.name)
def test_a_small_change_of_a_parameter_changes_the_columns_smoothly(effect: Effect) -> None:
    for values in corners(effect):
        for p in effect.shape:
            middle = min(max(values[p.name], p.low + 0.01 * (p.high - p.low)), p.high - 0.01 * (p.high - p.low))
            slopes = []
            for step in (1e-5, 5e-6):
                h = step * middle
                up, down = (np.concatenate(effect.signal(PATHS, effect.keys[0], {**values, p.name: v})) for v in (middle + h, middle - h))
                slopes.append((up - down) / (2.0 * h))
            assert np.isfinite(slopes[0]).all()
            assert np.linalg.norm(slopes[0] - slopes[1]) <= 1e-3 * np.linalg.norm(slopes[1]) + 1e-15


@pytest.mark.parametrize("effect", [e for e in CATALOGUE if e.kind == "mean"], ids=lambda e: e.name)
@settings(max_examples=5, deadline=None)
@given(seed=st.integers(0, 2**31))
def test_the_strength_follows_the_coefficients(effect: Effect, seed: int) -> None:
    values = {p.name: p.typical for p in effect.shape}
    k = effect.signal(PATHS[:1], effect.keys[0], values)[0].shape[1]
    c = np.random.default_rng(seed).standard_normal(k)
    degree = 0.5 if effect.name in ("contour_lag", "laser_cosine") else 1.0
    assert effect.strength(np.zeros(k), values) == 0.0
    assert effect.strength(3.0 * c, values) == pytest.approx(3.0**degree * effect.strength(c, values))


@pytest.mark.parametrize(("effect", "key"), [(e, k) for e, k in LABELS if e.family == "drive" and k], ids=lambda v: getattr(v, "name", v))
def test_an_effect_of_an_axis_is_the_same_on_another_axis(effect: Effect, key: str) -> None:
    """Renaming X to Y, Y to Z, Z to X renames the key and changes nothing else."""
    values = {p.name: p.typical for p in effect.shape}
    turned = tuple(renamed(p) for p in PATHS)
    there = effect.signal(turned, "YZX"["XYZ".index(key)], values)
    for a, b in zip(effect.signal(PATHS, key, values), there, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-15)


def renamed(path: Path) -> Path:
    """The same run with the axes renamed in a circle."""

    def roll(a: F2) -> F2:
        return np.roll(a, 1, axis=-1)

    def place(at: object) -> object:
        return replace(at, **{n: roll(getattr(at, n)) for n in ("q_mm", "sign", "since_mm", "v_mm_s", "a_mm_s2")})  # type: ignore[type-var]

    machine = Machine("w-Y-b-Z-X-t", np.roll(MACHINE.stroke_mm, 1, axis=0), np.roll(np.roll(MACHINE.pivots_mm, 1, axis=0), 1, axis=1))
    at, reference = place(path.at), place(path.reference)
    return replace(path, machine=machine, at=at, reference=reference, look=roll(path.look), centre_mm=roll(path.centre_mm))


def test_backlash_is_a_step_of_half_its_width_outward_at_both_ends() -> None:
    k = run("c00")
    column, path = of("backlash", "X")[k][:, 0], PATHS[k]
    u = path.look[:, 0]
    for end in (1.0, -1.0):
        at = int(np.argmax(end * u))
        assert column[at - 4] == pytest.approx(-0.5e-3 * path.at.sign[at - 4, 0] * u[at - 4])
        assert column[at + 4] - column[at - 4] == pytest.approx(1e-3 * abs(u[at]), rel=1e-2)  # outward: +, 1 um in all
    split = of("backlash", "X")[run("l0")][:, 0]
    n_x = PATHS[run("l0")].look[0, 0]
    np.testing.assert_allclose(split[-1] - split[0], 1e-3 * n_x, rtol=1e-12)


def test_unequal_backlash_is_wider_at_one_end() -> None:
    columns, path = of("backlash_position_dependent", "X")[run("c00")], PATHS[run("c00")]
    x = path.at.q_mm[:, 0] / 300.0 - 1.0
    np.testing.assert_allclose(columns[:, 1], columns[:, 0] * x, atol=1e-15)


def test_a_spike_is_an_outward_bump_of_its_height_that_grows_with_the_feed() -> None:
    for label, feed in (("c00", 1000.0), ("c20", 3000.0)):
        column = of("reversal_spike", "X", d0_mm=0.8, p=0.5)[run(label)][:, 0]
        top = int(np.argmax(column))
        assert column.min() > -1e-12
        assert 0.6 < column[top] / (1e-3 * (feed / 1000.0) ** 0.5) <= 1.0
        assert abs(PATHS[run(label)].look[top, 0]) > 0.99


def test_a_cyclic_error_repeats_with_its_pitch() -> None:
    here = of("cyclic_error", "X", pitch_mm=20.0)[run("x0")]
    x = PATHS[run("x0")].at.q_mm[:, 0]
    wave = here @ np.array([np.cos(0.4), np.sin(0.4)])
    np.testing.assert_allclose(wave, 1e-3 * (np.sin(2.0 * np.pi * x / 20.0 + 0.4) - np.sin(2.0 * np.pi * x[0] / 20.0 + 0.4)), atol=1e-15)


def test_servo_mismatch_is_minus_the_velocity_and_turns_with_the_direction() -> None:
    columns = of("servo_mismatch", "X")
    there, back = columns[run("c00")][:, 0], columns[run("c10")][::-1, 0]
    np.testing.assert_allclose(there[5:-5], -back[5:-5], atol=2e-9)
    u, v = PATHS[run("c00")].look, 1000.0 / 60.0
    np.testing.assert_allclose(there[5:-5], (1e-3 * v * u[:, 0] * u[:, 1])[5:-5], rtol=1e-3, atol=1e-9)


def test_contour_lag_is_tau_squared_v_squared_over_two_radii() -> None:
    for label, feed, radius in (("c00", 1000.0, 150.0), ("c21", 3000.0, 100.0)):
        v, tau_s = feed / 60.0, 0.015
        np.testing.assert_allclose(of("contour_lag", "")[run(label)][:, 0] * 15.0**2, -(tau_s**2) * v**2 / (2.0 * radius), rtol=1e-6)
    assert BY_NAME["contour_lag"].strength(np.array([225.0]), {}) == 15.0


def test_lateral_play_steps_sideways() -> None:
    path = PATHS[run("c00")]
    np.testing.assert_allclose(of("lateral_play", "EYX")[run("c00")][:, 0], 0.5e-3 * path.at.sign[:, 0] * path.look[:, 1])


def test_lateral_play_of_an_axis_at_rest_is_a_shift_of_unknown_size() -> None:
    """Its last motion was before the run; only its form knows it, and only in runs that do not move the axis."""
    form = next(f for f in BY_NAME["lateral_play"].forms if f.name == "at rest")
    still = [not p.at.sign[:, 2].any() for p in PATHS]
    assert 0 < sum(still) < len(still)
    for path, columns, plain, rests in zip(PATHS, form.signal(PATHS, "EXZ", {}), of("lateral_play", "EXZ"), still, strict=True):
        np.testing.assert_allclose(columns[:, 0], 0.5e-3 * rests * path.look[:, 0])
        assert not (rests and plain.any())


def test_every_set_up_of_a_bar_held_in_the_hand_may_begin_with_another_excess() -> None:
    """The form has one column for each set-up: the cooling of the bar in its runs, and nothing elsewhere."""
    form = next(f for f in BY_NAME["bar_thermal"].forms if f.name == "per set-up")
    setups = sorted({p.setup for p in PATHS if p.kind == "bar"})
    assert len(setups) > 1
    for path, own, plain in zip(PATHS, form.signal(PATHS, "", {"tau_s": 700.0}), of("bar_thermal", "", tau_s=700.0), strict=True):
        assert own.shape == (path.n, len(setups))
        mine = np.array([path.setup == s for s in setups])
        np.testing.assert_allclose(own[:, mine].sum(axis=1) * (path.kind == "bar"), HANDLED_K * plain[:, 0])
        assert not own[:, ~mine].any()


def test_a_bed_turns_over_across_the_other_axis() -> None:
    path = PATHS[run("l0")]
    x, z = path.at.q_mm[:, 0] / 600.0, path.at.q_mm[:, 2] / 225.0 - 1.0
    wanted = 1e-3 * np.sin(np.pi * x) * z * path.look[0, 1]
    np.testing.assert_allclose(of("nonrigid_bed", "EYX")[run("l0")][:, 0], wanted - wanted[0], atol=1e-15)


def test_a_ram_sags_with_the_square_of_its_reach_and_points_down() -> None:
    """Along the vertical beam of a made-up laser: -(z/L)^2 (1 + beta y), and 260 mm of arm times the slope 2 z / L^2."""
    path = PATHS[run("h0")]
    z, y = path.at.q_mm[:, 2] / 450.0, path.at.q_mm[:, 1] / 250.0 - 1.0
    more, z_c, more_c = 1.0 + 0.7 * y, CENTRE_MM[2] / 450.0, 1.0 + 0.7 * (CENTRE_MM[1] / 250.0 - 1.0)
    arm = 260.0
    here = 1e-3 * more * (-(z**2) + 2.0 * z / 450.0 * arm)
    cup = 1e-3 * more_c * (-(z_c**2) + 2.0 * z_c / 450.0 * arm)
    head = 2e-3 * z / 450.0 * more  # rotation about X, rad; the arm across is -320 mm of the pivot
    cross = head * -320.0 - 2e-3 * z_c / 450.0 * more_c * -320.0
    wanted = path.look[:, 1] * (here - cup) + path.look[:, 2] * cross
    np.testing.assert_allclose(of("ram_sag", "", beta=0.7)[run("h0")][:, 0], wanted, atol=1e-12)


def test_no_ram_no_sag() -> None:
    machine = Machine("w-X-Y-b-Z-t", MACHINE.stroke_mm, MACHINE.pivots_mm)
    columns = BY_NAME["ram_sag"].signal(probe_paths(machine, 2), "", {"beta": 0.7})
    assert all(not c.any() for c in columns)


@pytest.mark.parametrize(
    ("name", "key", "motion", "first"),
    [("straightness", "EYX", "EYX", 2), ("straightness", "EXZ", "EXZ", 2), ("positioning_nonlinear", "Z", "EZZ", 2)]
    + [("angular_error", f"E{t}{a}", f"E{t}{a}", 1) for t in "ABC" for a in "XYZ"],
)
def test_smooth_errors_are_those_of_the_21_error_model(name: str, key: str, motion: str, first: int) -> None:
    """The same arm and sign as rule G on the ball-bar; Legendre terms differ by the factor of unit mean square only."""
    path = PATHS[run("h0")]
    order = 4
    terms = tuple(t for t in smooth_terms(order) if t.motion == motion and t.order == order)
    at, cup = design(MACHINE, terms, path.at.q_mm), design(MACHINE, terms, path.reference.q_mm)
    constant = tuple(t for t in smooth_terms(1) if t.motion == motion and t.order == 1)
    seen = np.einsum("ni,nik->nk", path.look, at - cup)[:, 0]
    mine = of(name, key)[run("h0")][:, order - first] / (np.sqrt(2.0 * order + 1.0) * (1e-6 if name == "angular_error" else 1e-3))
    # The model counts positioning and angles from the stroke's start; P4 is 1 there.
    start = (arm_of(path, key, path.at.q_mm) - arm_of(path, key, path.reference.q_mm)) if name == "angular_error" else 0.0
    shift = np.einsum("ni,ni->n", path.look, start * np.ones((path.n, 3))) if constant and name == "angular_error" else 0.0
    np.testing.assert_allclose(mine, seen + shift, atol=1e-9)


def arm_of(path: Path, key: str, q_mm: F2) -> F2:
    """What a constant angle of 1 rad of a carriage does, shape (n, 3)."""
    from abbe.models.machine import levers_mm

    return np.asarray(np.cross(np.eye(3)["ABC".index(key[1])], levers_mm(path.machine, q_mm)[:, "XYZ".index(key[2])]))


def test_a_turning_mirror_meets_the_beam_elsewhere() -> None:
    """50 mm beside the beam times 20 urad is 1 um (effects.md): the step diagonal sees it at X and Y steps, a straight line does not."""
    path, columns = PATHS[run("l0")], of("angular_error", "ECX")[run("l0")][:, 0]
    arm = arm_of(path, "ECX", path.at.q_mm)
    angle = np.sqrt(3.0) * 1e-6 * (path.at.q_mm[:, 0] / 300.0 - 1.0)
    deviation = (arm * angle[:, None]) @ path.look[0]
    beside = path.at.q_mm - path.at.q_mm[0]
    mirror = (angle - angle[0]) * (beside @ np.cross([0.0, 0.0, 1.0], path.look[0]))
    np.testing.assert_allclose(columns, deviation - deviation[0] + mirror, atol=1e-12)
    assert np.abs(mirror).max() > 1e-6


def test_growth_of_steel_is_11_5_ppm_per_kelvin_from_the_fixed_end() -> None:
    path = PATHS[run("x0")]
    t, x = path.at.t_s, path.at.q_mm[:, 0]
    wanted = 11.5e-6 * (x - 600.0) * (1.0 - np.exp(-t / 3000.0))
    np.testing.assert_allclose(of("axis_thermal_growth", "X", tau_s=3000.0, fixed=1.0)[run("x0")][:, 0], wanted - wanted[0], atol=1e-15)


def test_drift_counts_from_the_moment_the_cup_was_set() -> None:
    path = PATHS[run("h2")]
    wanted = 1e-3 * (np.exp(-path.t_set_s / 3000.0) - np.exp(-path.at.t_s / 3000.0)) * path.look[:, 2]
    np.testing.assert_allclose(of("spindle_thermal_drift", "Z", tau_s=3000.0)[run("h2")][:, 0], wanted, atol=1e-15)


@pytest.mark.parametrize(("key", "motion"), [("XY", "C0Y"), ("ZX", "B0Z"), ("YZ", "A0Z")])
def test_squareness_has_the_sign_of_the_conventions(key: str, motion: str) -> None:
    path = PATHS[run("x0" if key == "YZ" else "l1")]
    terms = tuple(t for t in smooth_terms(1) if t.motion == motion)
    shape = np.einsum("ni,nik->nk", path.look, design(MACHINE, terms, path.at.q_mm))[:, 0]
    warm = 1.0 - np.exp(-path.at.t_s / 3000.0)
    wanted = 1e-6 * shape * warm
    columns = of("squareness_thermal", key, tau_s=3000.0)[run(path.label)][:, 0]
    np.testing.assert_allclose(columns, wanted - wanted[0], atol=1e-15)


def test_a_warm_bar_reads_short_and_recovers() -> None:
    path = PATHS[run("h0")]
    wanted = -11.5e-6 * 150.0 * np.exp(-(path.at.t_s - path.t_set_s) / 600.0)
    np.testing.assert_allclose(of("bar_thermal", "", tau_s=600.0)[run("h0")][:, 0], wanted)


def test_nuisances_of_the_set_up() -> None:
    centre, length, tilt = of("setup_centre_offset", ""), of("bar_length_error", ""), of("mirror_tilt", "")
    names = sorted({p.setup for p in PATHS if p.kind == "bar"})
    k = run("h2")
    at = 3 * names.index(PATHS[k].setup)
    np.testing.assert_allclose(centre[k][:, at : at + 3], -1e-3 * PATHS[k].look)
    np.testing.assert_array_equal(length[k], np.full((PATHS[k].n, 1), 1e-3))
    points = tilt[run("l0")][::3]
    assert np.abs(points[: len(points) // 2]).max() < 1e-9  # back to zero at every point of the diagonal
    assert np.abs(tilt[run("l0")]).max() > 10e-6


def test_one_milliradian_of_beam_makes_half_a_micrometre_per_metre() -> None:
    k = run("l1")
    columns, path = of("laser_cosine", "")[k], PATHS[k]
    np.testing.assert_allclose(columns.sum(axis=1), 0.5e-6 * path.travel_mm)
    assert BY_NAME["laser_cosine"].strength(np.array([9.0, 0.0, 9.0]), {}) == pytest.approx(3.0)


def test_warm_air_reads_0_93_ppm_per_kelvin_short() -> None:
    path = PATHS[run("l0")]
    quarter = 4.0 * path.at.t_s[30]
    columns = of("air_refraction", "", period_s=quarter)[run("l0")]
    assert columns[30, 0] == pytest.approx(-0.93e-6 * path.travel_mm[30])


def test_the_dead_path_drifts_with_the_hours() -> None:
    path = PATHS[run("l0")]
    wanted = -0.93e-6 * DEAD_PATH_MM * (path.at.t_s - path.at.t_s[0]) / 3600.0
    np.testing.assert_allclose(of("dead_path", "")[run("l0")][:, 0], wanted)


def test_what_only_roughens_says_where() -> None:
    creeping = of("stick_slip", "X", v_c=2.0)[run("c00")][:, 0]
    v = np.abs(PATHS[run("c00")].at.v_mm_s[:, 0])
    assert creeping[v < 0.5].min() > 10.0 * creeping[v > 3.0].max()
    swinging = of("vibration", "Y")[run("h0")][:, 0]
    np.testing.assert_allclose(swinging, 0.5e-6 * PATHS[run("h0")].look[:, 1] ** 2)
    waves = vibration.line(PATHS, "Y", 23.0)
    seen = [np.count_nonzero(c.any(axis=0)) for c in waves]
    assert seen == [2 if p.kind == "bar" and p.look[:, 1].any() else 0 for p in PATHS]


def best_cosine(one: F1, columns: F2, nuisance: F2) -> float:
    """Cosine between two signals after the nuisance is taken out of both."""
    q = np.linalg.svd(nuisance, full_matrices=False)[0]
    one, columns = one - q @ (q.T @ one), columns - q @ (q.T @ columns)
    fitted = columns @ np.linalg.lstsq(columns, one, rcond=1e-10)[0]
    return float(np.linalg.norm(fitted) / np.linalg.norm(one))


def test_pairs_are_as_alike_as_the_catalogue_says() -> None:
    """effects.md 6, rows whose number hangs on physics and not on the plan: alike with one feed, different with two."""
    one_feed = [k for k, p in enumerate(PATHS) if p.label.startswith(("c0", "c1"))]
    both = [k for k, p in enumerate(PATHS) if p.label.startswith("c")]
    lag, bar = of("contour_lag", ""), of("bar_length_error", "")
    cups = of("setup_centre_offset", "")

    def alike(runs: list[int]) -> float:
        return best_cosine(*(np.concatenate([c[k] for k in runs]) for c in (lag, bar, cups)))

    assert alike(one_feed) > 0.98  # 0.982 in the column "one_feed"
    assert alike(both) < 0.95
    x, y = of("backlash", "X"), of("backlash", "Y")
    lasers = [k for k, p in enumerate(PATHS) if p.test == "laser_diagonal"]
    zero = np.concatenate([np.eye(len(lasers))[[i]].repeat(PATHS[k].n, axis=0) for i, k in enumerate(lasers)])
    assert best_cosine(np.concatenate([x[k] for k in lasers])[:, 0], np.concatenate([y[k] for k in lasers]), zero) > 0.9


@pytest.mark.parametrize(
    ("name", "bounds"), [("cyclic_error", (5.0, 25.0)), ("reversal_spike", (0.15, 1.0)), ("bar_thermal", (200.0, 3500.0))]
)
def test_a_start_is_near_enough_for_every_truth(name: str, bounds: tuple[float, float]) -> None:
    """The best start of the grid keeps most of a signal whose first parameter lies anywhere, and the way to it from there goes uphill."""
    effect = BY_NAME[name]
    first, others = effect.shape[0], {p.name: p.typical for p in effect.shape[1:]}
    rng = np.random.default_rng(5)
    paths = tuple(p for p in PATHS if p.label in ("c00", "h1", "h2", "x0"))
    nuisance = np.concatenate(BY_NAME["setup_centre_offset"].signal(paths, "", {}))
    for truth in rng.uniform(*bounds, 4):
        columns = np.concatenate(effect.signal(paths, effect.keys[0], {first.name: truth, **others}))
        one = columns @ rng.standard_normal(columns.shape[1])

        def score(value: float, one: F1 = one) -> float:
            return best_cosine(one, np.concatenate(effect.signal(paths, effect.keys[0], {first.name: value, **others})), nuisance)

        start = max(first.starts, key=score)
        way = [score(start + f * (truth - start)) for f in np.linspace(0.0, 1.0, 9)]
        assert way[-1] > 0.999
        assert np.all(np.diff(way) > -2e-3)


@pytest.mark.parametrize("effect", [e for e in CATALOGUE if e.shape and e.kind == "mean" and not e.beside], ids=lambda e: e.name)
def test_refined_from_the_best_start_any_truth_is_met(effect: Effect) -> None:
    """Cosine at least 0.95 with a truth anywhere inside the bounds, after the set-up's unknowns are taken out of both."""
    names = [p.name for p in effect.shape]
    low, high = (np.array([getattr(p, side) for p in effect.shape]) for side in ("low", "high"))
    paths = tuple(p for p in PATHS if p.label in ("c00", "h0", "h1", "h2", "l0", "l1", "l2"))
    zeros = np.concatenate([np.full((p.n, len(paths)), np.arange(len(paths)) == k) * (p.kind == "laser") for k, p in enumerate(paths)])
    nuisance = np.hstack([np.concatenate(BY_NAME["setup_centre_offset"].signal(paths, "", {})), zeros])
    q = np.linalg.svd(nuisance, full_matrices=False)[0]
    q = q[:, np.linalg.svd(nuisance, compute_uv=False) > 1e-9]
    rng = np.random.default_rng(11)

    def columns(x: F1) -> F2:
        c = np.concatenate(effect.signal(paths, effect.keys[0], dict(zip(names, x, strict=True))))
        return np.asarray(c - q @ (q.T @ c))

    starts = [np.array(s) for s in itertools.product(*(p.starts for p in effect.shape))]
    for _ in range(2):
        there = columns(low + (high - low) * rng.uniform(0.03, 0.97, low.size))
        one = there @ rng.standard_normal(there.shape[1])
        one /= np.linalg.norm(one)

        def missed(x: F1, one: F1 = one) -> F1:
            c = columns(np.clip(x, low, high))
            return np.asarray(one - c @ np.linalg.lstsq(c, one, rcond=1e-10)[0])

        start = min(starts, key=lambda s: float(np.linalg.norm(missed(s))))
        inside = np.clip(start, low + 1e-6 * (high - low), high - 1e-6 * (high - low))
        found = least_squares(missed, inside, bounds=(low, high), x_scale=0.1 * (high - low), diff_step=1e-5, max_nfev=40)
        assert 1.0 - 2.0 * found.cost >= 0.95**2
