"""The cubic response surface: what points carry, what is refused, whether its uncertainties are true, and what Kwon's tables betray."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from abbe.models.papers.kwon.errors import ExtrapolationRefused, SurfaceNotDetermined
from abbe.models.papers.kwon.forensics import (
    LADDER,
    coefficients_from_planes,
    grid_sums,
    implied_plane,
    in_plane_coefficients,
    ladder_name,
    minimum_norm,
    square_grid,
)
from abbe.models.papers.kwon.frames import repeatability, residual_statistics
from abbe.models.papers.kwon.layout import CUBIC, IN_PLANE, layout, rank_of, regressors, term_name
from abbe.models.papers.kwon.surface import anova, anova_from_sums, critical_f, fit_surface
from abbe.service.reference.papers.kwon_printed import RESTORED, TABLE1
from abbe.service.reference.printed import values

Z = 113.61


def planes(*heights: float) -> np.ndarray:
    return np.concatenate([square_grid(z_mm=z) for z in heights])


def polynomial(points: np.ndarray, beta: np.ndarray) -> np.ndarray:
    """The 20 terms written out in the order of (27)."""
    x, y, z = points.T
    one = np.ones_like(x)
    terms = [one, x, y, z, x * y, x * z, y * z, x * x, y * y, z * z, x * y * z, x * x * y, x * x * z, x * y * y, x * z * z, y * y * z]
    terms += [y * z * z, x**3, y**3, z**3]
    return np.stack(terms, axis=1) @ beta


def test_regressors_are_the_twenty_terms_in_print_order() -> None:
    points = np.random.default_rng(1).normal(size=(7, 3))
    np.testing.assert_allclose(regressors(points, CUBIC), np.stack([polynomial(points, e) for e in np.eye(20)], axis=1), rtol=1e-14)
    assert [term_name(CUBIC[k]) for k in (0, 10, 15, 16)] == ["1", "X Y Z", "Y^2 Z", "Y Z^2"]


@pytest.mark.parametrize(("heights", "rank"), [((Z,), 10), ((0.0,), 10), ((1.0, 2.0), 16), ((110.0, 111.0, 113.0), 19), ((0, 1, 2, 3), 20)])
def test_rank_of_planes(heights: tuple[float, ...], rank: int) -> None:
    where = layout(planes(*heights))
    assert where.rank == rank
    assert len(where.terms) == rank
    assert rank_of(planes(*heights), where.terms) == rank


def test_one_plane_is_reported_and_heights_are_refused() -> None:
    points = planes(Z)
    s = fit_surface(points, polynomial(points, np.random.default_rng(2).normal(size=20)) + 1e-3 * np.random.default_rng(3).normal(size=81))
    assert s.terms == IN_PLANE
    assert "Z = 113.61" in s.layout.plane_text
    inside = np.array([[0.1, 0.2, Z]])
    assert np.isfinite(s.predict(inside).value).all()
    with pytest.raises(ExtrapolationRefused, match=r"point row 1: Z = 113\.62 mm was not measured.*Z = 113\.61"):
        s.predict(np.concatenate([inside, [[0.1, 0.2, 113.62]]]))


def test_surface_recovers_a_cubic_on_one_plane() -> None:
    beta = np.random.default_rng(4).normal(size=20)
    beta[[3, 5, 6, 9, 10, 12, 14, 15, 16, 19]] *= [1e-2, 1e-2, 1e-2, 1e-4, 1e-2, 1e-2, 1e-4, 1e-2, 1e-4, 1e-6]
    points = planes(Z)
    noise = 1e-6 * np.random.default_rng(5).normal(size=81)
    s = fit_surface(points, polynomial(points, beta) + noise)
    np.testing.assert_allclose(s.coefficients, in_plane_coefficients(beta, Z), atol=1e-5)
    assert (np.abs(s.coefficients - in_plane_coefficients(beta, Z)) < 5 * s.u_coefficients).all()


@pytest.mark.parametrize("heights", [(Z, Z + 1), (Z, Z + 1, Z + 3), (0.0, 1.0, 2.0, 4.0)])
def test_several_planes_interpolate_between_and_refuse_beyond(heights: tuple[float, ...]) -> None:
    points = planes(*heights)
    terms = layout(points).terms
    beta = np.array([1.0 if t in terms else 0.0 for t in CUBIC]) * np.random.default_rng(6).normal(size=20)
    noise = 1e-6 * np.random.default_rng(7).normal(size=len(points))
    s = fit_surface(points, polynomial(points, beta) + noise)
    between = np.array([[0.3, -0.2, 0.5 * (heights[0] + heights[-1])]])
    np.testing.assert_allclose(s.predict(between).value, polynomial(between, beta), atol=5e-6)
    for z in (heights[0] - 0.1, heights[-1] + 0.1):
        with pytest.raises(ExtrapolationRefused, match="points between Z"):
            s.predict(np.array([[0.0, 0.0, z]]))


def test_tilted_plane() -> None:
    points = planes(0.0)
    points[:, 2] = 5.0 + 0.1 * points[:, 0] - 0.2 * points[:, 1]
    s = fit_surface(points, polynomial(points, np.random.default_rng(8).normal(size=20)) + 1e-3 * np.random.default_rng(9).normal(size=81))
    np.testing.assert_allclose(s.layout.plane_mm, [5.0, 0.1, -0.2], atol=1e-12)
    assert s.terms == IN_PLANE
    assert s.layout.rank == 10
    s.predict(np.array([[1.0, 1.0, 4.9]]))
    with pytest.raises(ExtrapolationRefused):
        s.predict(np.array([[1.0, 1.0, 5.0]]))


def test_points_that_do_not_carry_a_cubic() -> None:
    three = np.array([[x, y, Z] for x in (-1.0, 0.0, 1.0) for y in np.linspace(-1, 1, 9)])
    with pytest.raises(SurfaceNotDetermined, match=r"27 points for 10 terms.*X\^3.*cannot be distinguished"):
        fit_surface(three, np.ones(27))
    with pytest.raises(SurfaceNotDetermined, match="more points than terms"):
        fit_surface(planes(Z)[::9][:9], np.ones(9))


def test_minimum_norm_is_the_pseudo_inverse() -> None:
    points = planes(97.6)
    y = polynomial(points, np.random.default_rng(10).normal(size=20) * 1e-2)
    pseudo = np.linalg.pinv(regressors(points, CUBIC), rcond=1e-10) @ y
    in_plane = np.linalg.lstsq(regressors(points, IN_PLANE), y, rcond=None)[0]
    beta = minimum_norm(in_plane, 97.6)
    np.testing.assert_allclose(regressors(points, CUBIC) @ beta, regressors(points, CUBIC) @ pseudo, atol=1e-8)
    np.testing.assert_allclose(beta, pseudo, atol=1e-9 * np.abs(beta).max())
    np.testing.assert_allclose(in_plane_coefficients(beta, 97.6), in_plane, rtol=1e-12)
    found = implied_plane(beta)
    assert found.z_mm == pytest.approx(97.6, rel=1e-12)
    assert len(found.ratios_mm) == 10


def test_ladder_is_the_list_of_the_specification() -> None:
    assert set(LADDER) == {(3, 0), (9, 3), (19, 9), (5, 1), (14, 5), (6, 2), (16, 6), (10, 4), (12, 7), (15, 8)}
    assert ladder_name((14, 5)) == "X Z^2 / X Z"


def table_1(restored: bool = True) -> np.ndarray:
    beta = np.array([values(TABLE1[name]) for name in ("e_x", "e_y", "e_z")])
    if restored:
        beta[0, 10] = RESTORED.value
    return beta


def test_table_1_betrays_its_plane() -> None:
    plane = implied_plane(table_1())
    assert len(plane.ratios_mm) == 30
    assert plane.mean_mm == pytest.approx(97.616, abs=1e-3)
    assert plane.sd_mm == pytest.approx(0.018, abs=1e-3)
    misprint = implied_plane(table_1(restored=False))
    worst = max(misprint.ratios_mm, key=lambda r: abs(r[1] - misprint.z_mm))
    assert worst[0] == (0, 10, 4)  # beta_10 of e_x: a hundred times too large
    assert worst[1] / misprint.z_mm == pytest.approx(100.0, rel=1e-3)


def test_implied_plane_of_the_vectors(shared: Path) -> None:
    """It is the median of the 29 quotients without the damaged coefficient."""
    stored = json.loads((shared / "vectors" / "kwon_rsm.json").read_text())["implied_plane_Z"]
    plane = implied_plane(table_1(restored=False), leave_out=((0, 10),))
    assert len(plane.ratios_mm) == 29
    assert plane.z_mm == pytest.approx(stored, abs=1e-12)


@pytest.mark.parametrize(
    ("row", "ss", "printed_ss", "largest", "at_printed_plane"),
    [(0, 4.2385e-2, 4.240e-2, 50.1, 7.8e-2), (1, 4.5149e-2, 4.520e-2, 79.7, 6.8e-2), (2, 1.2110e-2, 1.230e-2, 74.5, 1.9e-2)],
)
def test_sums_on_the_grid_fit_table_2_only_on_the_implied_plane(
    row: int, ss: float, printed_ss: float, largest: float, at_printed_plane: float
) -> None:
    beta = table_1()[row]
    there, printed = in_plane_coefficients(beta, 97.61646804), in_plane_coefficients(beta, 113.61)
    sums = grid_sums(there)
    assert sums.n == 81
    assert sums.ss_mean == pytest.approx(ss, abs=6e-7)
    assert sums.ss_mean == pytest.approx(printed_ss, rel=0.016)
    assert sums.largest * 1e3 == pytest.approx(largest, abs=0.05)
    assert grid_sums(printed).ss_mean == pytest.approx(at_printed_plane, abs=6e-4)


@pytest.mark.parametrize("row", range(3))
def test_table_1_comes_back_from_two_planes(row: int) -> None:
    beta = table_1()[row]
    there, printed = in_plane_coefficients(beta, 97.61646804), in_plane_coefficients(beta, 113.61)
    back = coefficients_from_planes(there, 97.61646804, printed, 113.61, digits=4)
    np.testing.assert_allclose(back[1:], beta[1:], rtol=1e-12)  # beta_0, 1e-14 of 3e-2, is below the rounding


@pytest.mark.parametrize(
    ("ss_reg", "ss_res", "f", "printed"),
    [(4.240e-2, 1.317e-4, 2540, 971.8), (4.520e-2, 3.155e-4, 1130, 437.6), (1.230e-2, 1.020e-4, 951, 361.6)],
)
def test_table_2_with_the_right_degrees_of_freedom(ss_reg: float, ss_res: float, f: float, printed: float) -> None:
    table = anova_from_sums(ss_reg, ss_res, 9, 71)
    assert table.f == pytest.approx(f, abs=0.5)
    assert table.f / printed > 2.5
    assert table.significant()
    assert table.critical() == pytest.approx(2.668, abs=5e-4)
    assert table.ms_reg / table.ms_res == pytest.approx(table.f)
    assert critical_f(20, 60) == pytest.approx(2.198, abs=5e-4)


def test_anova_against_scipy() -> None:
    rng = np.random.default_rng(11)
    x, y = np.linspace(0, 1, 30), rng.normal(size=30)
    line = stats.linregress(x, y)
    table = anova(y, line.intercept + line.slope * x, 2)
    assert table.p == pytest.approx(line.pvalue, rel=1e-9)
    assert table.r2 == pytest.approx(line.rvalue**2, rel=1e-9)
    assert table.ss_reg + table.ss_res == pytest.approx(table.ss_tot, rel=1e-12)
    assert (table.df_reg, table.df_res) == (1, 28)


def test_anova_refusals() -> None:
    with pytest.raises(SurfaceNotDetermined, match="degrees of freedom"):
        anova(np.arange(3.0), np.arange(3.0), 3)
    with pytest.raises(ValueError, match="fit together"):
        anova(np.arange(3.0), np.arange(4.0), 2)
    with pytest.raises(ValueError, match="not negative"):
        anova_from_sums(-1.0, 1.0, 9, 71)
    with pytest.raises(ValueError, match="alpha"):
        critical_f(9, 71, 1.0)
    perfect = anova(np.arange(5.0), np.arange(5.0), 2)
    assert perfect.f == np.inf
    assert perfect.p == 0.0


@pytest.mark.parametrize("value", [0.1, -3e-17, 1e6, 0.0])
def test_rounding_is_never_significant(value: float) -> None:
    """A constant comes back with residuals of 1e-17: both sums are rounding, their quotient means nothing."""
    table = fit_surface(planes(Z), np.full(81, value)).anova
    assert (table.ss_reg, table.ss_res, table.ss_tot) == (0.0, 0.0, 0.0)
    assert np.isnan(table.f)
    assert np.isnan(table.p)
    assert not table.significant()
    assert "do not vary" in table.undefined


def test_small_but_real_scatter_is_kept() -> None:
    """1 nm on 100 mm is far above rounding; a surface that fits to rounding has an infinite F."""
    points, rng = planes(Z), np.random.default_rng(19)
    slope = 100.0 + 1e-6 * points[:, 0]
    table = fit_surface(points, slope + 1e-8 * rng.normal(size=81)).anova
    assert table.significant()
    assert table.residual_sd == pytest.approx(1e-8, rel=0.3)
    assert not table.undefined
    perfect = fit_surface(points, 0.1 + 0.2 * points[:, 0]).anova
    assert perfect.f == np.inf
    assert perfect.significant()
    with pytest.raises(ValueError, match="must be finite"):
        anova(np.array([1.0, np.nan, 2.0]), np.ones(3), 2)


def test_false_alarms_come_at_the_stated_rate() -> None:
    """Pure noise: F exceeds its critical value in 10 % of the cases."""
    rng = np.random.default_rng(12)
    points = planes(Z)[::2]
    alarms = sum(fit_surface(points, rng.normal(size=len(points))).anova.significant(0.1) for _ in range(400))
    assert 22 <= alarms <= 62  # binomial(400, 0.1), 3.7 sigma


def test_prediction_uncertainty_covers_the_truth() -> None:
    rng = np.random.default_rng(13)
    points, beta = planes(Z), np.random.default_rng(14).normal(size=20) * 1e-2
    truth = polynomial(points, beta)
    at = np.column_stack([rng.uniform(-1, 1, (20, 2)), np.full(20, Z)])
    score, fresh = [], []
    for _ in range(150):
        p = fit_surface(points, truth + 2e-3 * rng.normal(size=81)).predict(at)
        score.append((p.value - polynomial(at, beta)) / p.u_surface)
        fresh.append((polynomial(at, beta) + 2e-3 * rng.normal(size=20) - p.value) / p.u_reading)
    for z in (np.array(score), np.array(fresh)):
        assert np.std(z) == pytest.approx(1.0, abs=0.08)
        assert np.mean(np.abs(z) < 2.0) == pytest.approx(0.95, abs=0.02)


def test_repeatability_of_six_cycles() -> None:
    rng = np.random.default_rng(15)
    sd = np.array([0.9e-3, 1.0e-3, 1.1e-3])
    cycles = planes(Z)[None, :40] + sd * rng.normal(size=(6, 40, 3))
    r = repeatability(cycles)
    np.testing.assert_allclose(r.pooled_sd_mm, sd, rtol=0.15)
    assert r.dof == 200
    np.testing.assert_allclose(r.largest_2sd_mm, 2 * np.std(cycles, axis=0, ddof=1).max(axis=0))
    assert (r.largest_2sd_mm > 2 * r.pooled_sd_mm).all()
    with pytest.raises(ValueError, match="2 or more cycles"):
        repeatability(cycles[:1])


def test_residuals_beyond_repeatability_are_seen() -> None:
    rng = np.random.default_rng(16)
    points = planes(Z)
    fine = fit_surface(points, 1e-3 * rng.normal(size=81))
    assert residual_statistics(fine.residual, fine.anova.df_res, 1e-3, 200).p > 0.01
    wavy = fit_surface(points, 1e-3 * rng.normal(size=81) + 3e-3 * np.cos(6 * points[:, 0]))
    bad = residual_statistics(wavy.residual, wavy.anova.df_res, 1e-3, 200)
    assert bad.p < 1e-6
    assert bad.sd_mm == pytest.approx(wavy.anova.residual_sd)
    assert bad.ratio == pytest.approx((bad.sd_mm / 1e-3) ** 2)
    for wrong in (0.0, np.nan, np.inf):
        with pytest.raises(ValueError, match="repeatability positive"):
            residual_statistics(fine.residual, 71, wrong, 200)
    for residual in (np.full(3, np.nan), np.empty(0), np.ones((2, 3))):
        with pytest.raises(ValueError, match="finite residuals"):
            residual_statistics(residual, 71, 1e-3, 200)


def test_bad_input() -> None:
    with pytest.raises(ValueError, match="81 points"):
        fit_surface(planes(Z), np.ones(80))
    with pytest.raises(ValueError, match="no point"):
        layout(np.empty((0, 3)))
    with pytest.raises(ValueError, match="divide"):
        square_grid(1.0, 0.3)
    with pytest.raises(ValueError, match="20 finite"):
        in_plane_coefficients(np.ones(10), 1.0)
    with pytest.raises(ValueError, match="differ"):
        coefficients_from_planes(np.ones(10), 5.0, np.ones(10), 5.0, 4)
    with pytest.raises(ValueError, match="no coefficient"):
        implied_plane(np.zeros(20))
