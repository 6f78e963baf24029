"""Wang's step diagonal against simulation with the exact laser: tilt, angular errors, squareness, errata (math.md 5)."""

import numpy as np
import pytest

from abbe.models.functions.monomials import ErrorArrays
from abbe.models.geometry.chain import deviation_mm
from abbe.models.papers.wang.model import (
    ACUTE_FROM_OBTUSE,
    cosine_error,
    diagonal_beam,
    displacement_eq11,
    displacement_eq11_printed,
    iso_motions,
    iso_squareness,
    machine,
    mirror_normal,
    position_error_eq9,
    position_error_eq9_printed,
    projection_factors,
    reading_mm,
    step_readings_mm,
    tilt_axes,
    tilt_bias_eq7,
    tilt_closure_mm,
)
from abbe.models.papers.wang.squareness import (
    AcuteSquareness,
    abbe_and_spurious_eq7,
    bias_eq13,
    closure_of_angles_mm,
    common_scale,
    diagonal_totals_eq12,
    false_straightness_mm,
    squareness_eq13_printed,
    sum_test_mm,
)
from abbe.models.paths import DIAGONALS, diagonal_ends, step_diagonal
from abbe.models.solvers.step_diagonal import (
    closure_mm,
    demeaned,
    increments,
    project_eq6,
    squareness_contrast,
    u_wang_four,
    wang_eq7,
    wang_four,
)

N, INC = 7, np.array([80.0, 50.0, 40.0])
LENGTH = N * INC
BOX = np.stack([np.zeros(3), LENGTH], axis=1)
NONE = np.zeros(3)


def simulated(errors, tilt=None):
    """Normalised step readings of the exact laser on a machine given by a function of position."""
    out = {}
    for name in DIAGONALS:
        path = step_diagonal(*diagonal_ends(BOX, name), N, back=False)
        beam = diagonal_beam(INC, name)
        mirror = mirror_normal(beam, NONE[:2] if tilt is None else tilt[name])
        out[name] = step_readings_mm(path, position_error_eq9(errors(path), path), beam, mirror)
    return increments(out)


def rotating(x_step, y_step):
    """Machine whose X and Y carriage turn by so much per step and do nothing else."""

    def errors(p):
        e = np.zeros((len(p), 3, 3))
        e[:, :, 0] = np.outer(p[:, 0] / INC[0], x_step)
        e[:, :, 1] = np.outer(p[:, 1] / INC[1], y_step)
        return ErrorArrays(np.zeros_like(e), e, NONE)

    return errors


def random_errors(rng, n):
    return ErrorArrays(rng.normal(0, 1e-2, (n, 3, 3)), rng.normal(0, 3e-5, (n, 3, 3)), rng.normal(0, 3e-5, 3))


def test_equation_9_corrected_is_rule_g_and_printed_is_not():
    rng = np.random.default_rng(1)
    p, errors = rng.uniform(0, 800, (30, 3)), random_errors(rng, 30)
    general = deviation_mm(machine(BOX), p, iso_motions(errors.d, errors.e, tuple(errors.s), p))
    assert position_error_eq9(errors, p) == pytest.approx(general, abs=1e-14)
    off = position_error_eq9_printed(errors, p) - general
    assert off[:, :2] == pytest.approx(0.0, abs=1e-14)
    assert off[:, 2] == pytest.approx(-2 * p[:, 1] * errors.e[:, 0, 0], abs=1e-14)


def one_error(kind, i=0, j=0, size=1.0):
    """A machine at one position with one of the 21 errors and no other."""
    d, e, theta = np.zeros((1, 3, 3)), np.zeros((1, 3, 3)), np.zeros(3)
    if kind == "theta":
        theta[i] = size
    else:
        (d if kind == "delta" else e)[0, i, j] = size
    return ErrorArrays(d, e, theta)


AT = {"x": 310.0, "y": 170.0, "z": 230.0}
EQ11 = {
    # (11) as printed, one error at a time: which E_i(J) it enters and with which factor
    ("alpha", "z", "X"): {("x", "X"): "-y"},  # Ex(X) = dx(X) - y*az(X) + z*ay(X)
    ("alpha", "y", "X"): {("x", "X"): "+z"},
    ("alpha", "x", "X"): {("y", "X"): "-z", ("z", "X"): "+y"},  # Ey(X) = dy(X) - z*ax(X); Ez(X) = dz(X) + y*ax(X)
    ("alpha", "y", "Y"): {("x", "Y"): "+z"},  # Ex(Y) = dx(Y) + z*ay(Y) - y*theta_xy
    ("alpha", "x", "Y"): {("y", "Y"): "-z"},  # Ey(Y) = dy(Y) - z*ax(Y)
    ("theta", "xy", ""): {("x", "Y"): "-y"},
    ("theta", "xz", ""): {("x", "Z"): "-z"},  # erratum: Ex(Z) = dx(Z) - z*theta_xz, printed theta_xy (math.md 3)
    ("theta", "yz", ""): {("y", "Z"): "-z"},  # Ey(Z) = dy(Z) - z*theta_yz
}
PRINTED_EQ11 = EQ11 | {("theta", "xy", ""): {("x", "Y"): "-y", ("x", "Z"): "-z"}, ("theta", "xz", ""): {}}


def expected_eq11(table, kind, i, j):
    out = np.zeros((3, 3))
    if kind == "delta":
        out["xyz".index(i), "XYZ".index(j)] = 1.0
    for (direction, axis), factor in table.get((kind, i, j), {}).items():
        out["xyz".index(direction), "XYZ".index(axis)] = (1.0 if factor[0] == "+" else -1.0) * AT[factor[1]]
    return out


EVERY = [(kind, i, j) for kind in ("delta", "alpha") for i in "xyz" for j in "XYZ"] + [("theta", i, "") for i in ("xy", "xz", "yz")]


@pytest.mark.parametrize(("kind", "i", "j"), EVERY)
def test_equation_11_puts_every_error_into_its_own_curve(kind, i, j):
    """One error at a time at a position off all axes, against the printed lines; a term in the column of another axis has the same sum."""
    number = ("xy", "xz", "yz").index(i) if kind == "theta" else "xyz".index(i)
    alone, where = one_error(kind, number, "XYZ".index(j)), np.array([list(AT.values())])
    expected = expected_eq11(EQ11, kind, i, j)
    assert displacement_eq11(alone, where)[0] == pytest.approx(expected, abs=1e-13)
    assert displacement_eq11_printed(alone, where)[0] == pytest.approx(expected_eq11(PRINTED_EQ11, kind, i, j), abs=1e-13)
    assert position_error_eq9(alone, where)[0] == pytest.approx(expected.sum(axis=1), abs=1e-13)  # (10)


def test_obtuse_letters_open_the_angles_between_the_lines():
    theta = (3e-4, -2e-4, 1e-4)
    p = np.concatenate([np.zeros((1, 3)), 100.0 * np.eye(3)])
    zero = np.zeros((4, 3, 3))
    at = p + deviation_mm(machine(BOX), p, iso_motions(zero, zero, theta, p))
    x, y, z = ((q - at[0]) / np.linalg.norm(q - at[0]) for q in at[1:])
    for a, b, angle in ((x, y, theta[0]), (x, z, theta[1]), (y, z, theta[2])):
        assert np.arccos(a @ b) - np.pi / 2 == pytest.approx(angle, abs=2e-7)
    assert iso_squareness(*theta) == {"C0Y": 3e-4, "B0Z": 2e-4, "A0Z": 1e-4}
    with pytest.raises(ValueError, match="Wang errors"):
        iso_motions(zero[:2], zero, theta, p)


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("carriage", ["X", "Y"])
def test_spurious_terms_are_what_a_turning_carriage_does_to_equation_7(carriage, axis):
    step = np.eye(3)[axis] * 5e-6
    x, y = (step, NONE) if carriage == "X" else (NONE, step)
    seen = np.diff(wang_eq7(simulated(rotating(x, y)), INC), axis=2)
    assert abbe_and_spurious_eq7(N, INC, x, y) == pytest.approx(seen, abs=1e-12)


def test_pure_yaw_bends_the_machine_and_the_closure_stays_at_one_step():
    yaw = 50e-6 / N
    q = simulated(rotating(np.array([0.0, 0.0, yaw]), NONE))
    bent = wang_eq7(q, INC)[1, 0]
    chord = bent - np.linspace(bent[0], bent[-1], N + 1)
    assert np.abs(chord).max() == pytest.approx(false_straightness_mm(LENGTH[0], 50e-6), rel=0.05)
    assert np.abs(closure_mm(q)).max() < 0.1 * np.abs(chord).max()


@pytest.mark.parametrize("rate", [(0.0, 0.0, 7e-6), (0.0, 0.0, -7e-6), (0.0, 7e-6, 0.0), (3e-6, -5e-6, 2e-6)])
def test_closure_of_a_turning_x_carriage_has_the_size_and_sign_of_one_step(rate):
    """Yaw, pitch and both: signed, against the simulated laser."""
    closure = closure_mm(simulated(rotating(np.array(rate), NONE)))[0]
    assert closure == pytest.approx(np.full(N, closure_of_angles_mm(INC, np.array(rate))), rel=1e-9)
    assert np.abs(closure).min() > 1e-5


def test_equations_7_and_8_turn_equation_6_round():
    e = np.random.default_rng(12).normal(0, 1e-3, (3, 3, N))
    q = project_eq6(e, INC)
    assert np.diff(wang_eq7(q, INC), axis=2) == pytest.approx(e, abs=1e-16)
    assert np.diff(wang_four(q, INC), axis=2) == pytest.approx(e, abs=1e-16)
    assert closure_mm(q) == pytest.approx(0.0, abs=1e-16)
    direct = (e[:, 1, 3] * np.array([-1, 1, 1]) * INC).sum() / np.linalg.norm(INC)  # eq (6) of npp in its letters
    assert q["npp"][1, 3] == pytest.approx(direct, abs=1e-17)


def test_angular_rates_of_wrong_shape_are_refused():
    with pytest.raises(ValueError, match="x_step_rad"):
        abbe_and_spurious_eq7(N, INC, np.zeros(2), NONE)
    with pytest.raises(ValueError, match="intervals"):
        abbe_and_spurious_eq7(0, INC, NONE, NONE)


def perfect(p):
    return ErrorArrays(np.zeros((len(p), 3, 3)), np.zeros((len(p), 3, 3)), NONE)


def test_tilt_bias_and_its_trace_in_the_closure_are_those_of_the_exact_laser():
    rng = np.random.default_rng(5)
    angles = {name: rng.normal(0, 5e-4, 2) for name in DIAGONALS}
    t = {name: a @ tilt_axes(diagonal_beam(INC, name)) for name, a in angles.items()}
    q = simulated(perfect, angles)
    per_step = np.diff(wang_eq7(q, INC), axis=2)
    largest = np.abs(per_step).max()
    assert largest > 1e-2  # tens of µm per step
    assert tilt_bias_eq7(INC, t)[:, :, None] * np.ones(N) == pytest.approx(per_step, abs=1e-6 * largest)  # second order: 0.5 mrad squared
    assert tilt_closure_mm(INC, t)[:, None] * np.ones(N) == pytest.approx(closure_mm(q), abs=1e-6 * largest)
    assert wang_eq7(demeaned(q), INC) == pytest.approx(0.0, abs=1e-12)


def test_taking_the_mean_out_takes_scale_and_squareness_out_as_well():
    def errors(p):
        d = np.zeros((len(p), 3, 3))
        for i, scale in enumerate((20e-6, -30e-6, 40e-6)):
            d[:, i, i] = scale * p[:, i]
        return ErrorArrays(d, np.zeros_like(d), np.array([30e-6, -20e-6, 40e-6]))

    q = simulated(errors)
    assert np.abs(wang_eq7(q, INC)).max() > 5e-3
    assert wang_eq7(demeaned(q), INC) == pytest.approx(0.0, abs=1e-12)


def test_lateral_step_across_a_tilted_mirror_reads_at_first_order_and_the_diagonal_does_not():
    beam = diagonal_beam(INC, "ppp")
    first, second = tilt_axes(beam)
    assert np.stack([beam, first, second]) @ np.stack([beam, first, second]).T == pytest.approx(np.eye(3), abs=1e-15)
    mirror = mirror_normal(beam, np.array([0.5e-3, 0.0]))
    assert reading_mm(50.0 * first[None], mirror, beam)[0] == pytest.approx(25e-3, rel=1e-6)  # the paper's 25 µm
    assert reading_mm(1000.0 * beam[None], mirror, beam)[0] == pytest.approx(1000.0, abs=1e-9)
    with pytest.raises(ValueError, match="parallel to the beam"):
        reading_mm(np.zeros((1, 3)), first, beam)
    with pytest.raises(ValueError, match="vertical"):
        tilt_axes(np.array([0.0, 0.0, 1.0]))


def test_parts_of_a_reading_add_up_to_the_distance_of_the_mirrors_plane():
    rng = np.random.default_rng(9)
    path, off = rng.uniform(0, 500, (12, 3)), rng.normal(0, 1e-2, (12, 3))
    beam = diagonal_beam(INC, "pnp")
    mirror = mirror_normal(beam, np.array([4e-4, -7e-4]))
    whole = reading_mm(path + off - path[0] - off[0], 3.7 * mirror, beam) - (path - path[0]) @ beam
    assert step_readings_mm(path, off, beam, mirror) == pytest.approx(whole, abs=3e-13)


def test_misaligned_beam_costs_half_a_ppm_at_a_milliradian():
    assert cosine_error(1e-3) == pytest.approx(0.5e-6, rel=1e-5)
    beam = diagonal_beam(INC, "npp")
    l = np.cos(1e-3) * beam + np.sin(1e-3) * tilt_axes(beam)[0]  # noqa: E741 - the letter of math.md
    seen = reading_mm(1024.0 * beam[None], beam, l)[0] - 1024.0
    assert seen == pytest.approx(1024.0 * cosine_error(1e-3), rel=1e-6)
    with pytest.raises(ValueError, match="right angle"):
        cosine_error(1.6)


def test_a_diagonal_shows_less_of_each_axis():
    assert projection_factors(np.ones(3)) == pytest.approx(1 / np.sqrt(3))
    assert (projection_factors(INC) ** 2).sum() == pytest.approx(1.0)


def test_printed_squareness_carries_the_common_scale_and_the_contrasts_do_not():
    length, scale = np.array([800.0, 500.0, 400.0]), np.array([1e-5, -6e-6, 1.25e-5])
    true = AcuteSquareness(2e-5, -4e-5, -3e-5)
    totals = diagonal_totals_eq12(true, length, scale)
    printed, bias = squareness_eq13_printed(totals, length), bias_eq13(scale, length)
    for name in ("theta_yz", "theta_zx", "theta_xy"):
        assert getattr(printed, name) == pytest.approx(getattr(true, name) + getattr(bias, name), abs=1e-17)
    assert max(abs(bias.theta_yz), abs(bias.theta_xy)) > 1e-5
    free = squareness_contrast(totals, length)
    obtuse = ACUTE_FROM_OBTUSE * np.array([free.theta_yz, free.theta_xz, free.theta_xy])
    assert obtuse == pytest.approx([true.theta_yz, true.theta_zx, true.theta_xy], abs=1e-17)
    r2 = float(length @ length)
    assert common_scale(totals, length) == pytest.approx(float(length**2 @ scale) / r2, rel=1e-9)
    without = diagonal_totals_eq12(true, length)
    assert sum_test_mm(without) == pytest.approx(0.0, abs=1e-15)
    assert squareness_eq13_printed(without, length).theta_zx == pytest.approx(true.theta_zx, abs=1e-17)
    with pytest.raises(ValueError, match="positive"):
        bias_eq13(scale, np.zeros(3))


def test_yaw_of_x_is_read_as_half_as_much_squareness_and_no_uncertainty_says_so():
    def errors(p):
        e = np.zeros((len(p), 3, 3))
        e[:, 2, 0] = 50e-6 * p[:, 0] / LENGTH[0]
        return ErrorArrays(np.zeros_like(e), e, NONE)

    totals = {}
    for name in DIAGONALS:
        ends, beam = np.stack(diagonal_ends(BOX, name)), diagonal_beam(INC, name)
        totals[name] = step_readings_mm(ends, position_error_eq9(errors(ends), ends), beam, beam)[1]
    found = squareness_contrast(totals, LENGTH, 1e-4)
    assert found.theta_xy == pytest.approx(25e-6, rel=1e-9)
    assert (found.theta_xz, found.theta_yz) == pytest.approx((0.0, 0.0), abs=1e-15)
    assert found.u_xy < 1e-6


def test_stated_uncertainty_of_each_squareness_contrast_is_the_scatter_of_repeats():
    length, sigma = np.array([800.0, 500.0, 300.0]), 4e-4
    rng = np.random.default_rng(21)
    draws = [squareness_contrast(dict(zip(DIAGONALS, rng.normal(0, sigma, 4), strict=True)), length) for _ in range(8000)]
    stated = squareness_contrast(dict.fromkeys(DIAGONALS, 0.0), length, sigma)
    for letters in ("xy", "xz", "yz"):
        scatter = np.std([getattr(d, f"theta_{letters}") for d in draws])
        assert getattr(stated, f"u_{letters}") == pytest.approx(scatter, rel=0.04)  # standard error 0.8 %; the three differ by 60 %


def test_totals_of_equation_12_are_those_of_the_simulated_machine():
    scale, theta = np.array([1e-5, -6e-6, 1.25e-5]), np.array([3e-5, 4e-5, -2e-5])  # xy, xz, yz obtuse

    def errors(p):
        d = np.zeros((len(p), 3, 3))
        for i in range(3):
            d[:, i, i] = scale[i] * p[:, i]
        return ErrorArrays(d, np.zeros_like(d), theta)

    expected = diagonal_totals_eq12(AcuteSquareness(-theta[2], -theta[1], -theta[0]), LENGTH, scale)
    for name in DIAGONALS:
        ends = np.stack(diagonal_ends(BOX, name))
        beam = diagonal_beam(INC, name)
        assert step_readings_mm(ends, position_error_eq9(errors(ends), ends), beam, beam)[1] == pytest.approx(expected[name], abs=1e-15)


def test_a_machine_with_opposed_scales_has_four_perfect_diagonals():
    length = np.array([800.0, 500.0, 400.0])
    chapman = np.array([10.0 / 800.0**2, -10.0 / 500.0**2, 0.0])
    totals = diagonal_totals_eq12(AcuteSquareness(0.0, 0.0, 0.0), length, chapman)
    assert list(totals.values()) == pytest.approx([0.0] * 4, abs=1e-15)


def test_stated_noise_of_the_nine_curves_is_the_scatter_of_repeats():
    rng = np.random.default_rng(11)
    inc, n, sigma = np.array([80.0, 50.0, 40.0]), 10, 3e-4
    curves = [wang_four(increments({d: rng.normal(0, sigma, 3 * n + 1) for d in DIAGONALS}), inc) for _ in range(1500)]
    stated = u_wang_four(inc, n, sigma)
    assert np.std(curves, axis=0)[:, :, 1:] == pytest.approx(stated[:, :, 1:], rel=0.1)
    assert (stated[:, :, 0] == 0.0).all()
    with_scale = u_wang_four(inc, n, sigma, 1e-6)
    assert with_scale[0, 0, -1] == pytest.approx(np.hypot(stated[0, 0, -1], 8e-4))
    assert with_scale[0, 1, -1] == stated[0, 1, -1]
