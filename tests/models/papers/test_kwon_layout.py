"""Where points lie decides what a surface may claim: nearly flat, tilted, upright, stacked, jittered and chained heights."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from abbe.models.papers.kwon.errors import ExtrapolationRefused, SurfaceNotDetermined
from abbe.models.papers.kwon.forensics import square_grid
from abbe.models.papers.kwon.kinematics import Geometry, forward, inverse
from abbe.models.papers.kwon.layout import CUBIC, FLATNESS, IN_PLANE, layout, parallel_planes, regressors
from abbe.models.papers.kwon.surface import fit_surface

NOMINAL = Geometry(100.0, 30.0, 101.26, 8.0, 8.0, np.radians(35.0), 20.0)  # type: ignore[arg-type]
RANK = {1: 10, 2: 16, 3: 19}


def stacked(count: int, apart: float = 0.7) -> np.ndarray:
    return np.concatenate([square_grid(z_mm=k * apart) for k in range(count)])


def noise(n: int, seed: int = 1) -> np.ndarray:
    return np.asarray(1e-3 * np.random.default_rng(seed).normal(size=n))


def test_a_stage_of_one_micrometre_leaves_one_plane() -> None:
    """The paper's own grid: commands rounded to 1 um lift the points by 0.5 um, from which no term with Z can be learnt."""
    points = forward(NOMINAL, np.round(inverse(NOMINAL, square_grid(z_mm=113.61357)), 3))
    assert 3e-4 < np.ptp(points[:, 2]) < 6e-4
    surface = fit_surface(points, noise(81))
    assert surface.layout.rank == 10
    assert surface.terms == IN_PLANE
    assert (surface.anova.df_reg, surface.anova.df_res) == (9, 71)
    assert surface.u_coefficients.max() < 2e-3
    assert "all points on the plane Z = 113.614" in surface.layout.plane_text


@pytest.mark.parametrize("size", [1e-3, 1.0, 300.0])
def test_flat_is_relative_to_the_extent(size: float) -> None:
    points = square_grid()
    points[:, 2] = np.random.default_rng(2).uniform(-1.0, 1.0, 81)
    flat, high = points * [1.0, 1.0, 0.9 * FLATNESS], points * [1.0, 1.0, 0.2]
    assert layout(size * flat).terms == IN_PLANE
    assert layout(size * high).terms == CUBIC
    assert layout(size * high, tolerance_mm=0.25 * size).terms == IN_PLANE
    assert layout(size * high).rank == 20


def test_a_tolerance_that_is_too_small_does_not_bring_absurd_coefficients() -> None:
    """Whoever insists that 0.3 um of height are real is told that they do not carry a cubic."""
    points = square_grid()
    points[:, 2] = np.random.default_rng(3).uniform(-3e-4, 3e-4, 81)
    with pytest.raises(SurfaceNotDetermined, match="81 points for 20 terms"):
        fit_surface(points, noise(81), tolerance_mm=1e-6)
    with pytest.raises(ValueError, match="must not be negative"):
        layout(points, -1.0)


def test_three_jittered_columns_do_not_carry_a_cube() -> None:
    """X^3 = X on -1, 0, 1: a jitter of 1 nm would give coefficients a million times worse than a reading."""
    line = (-1.0, 0.0, 1.0)
    points = np.array([[x, y, 5.0] for x in line for y in line] * 3)
    points[:, :2] += 1e-6 * np.random.default_rng(4).normal(size=(27, 2))
    with pytest.raises(SurfaceNotDetermined, match=r"\^3.* cannot be distinguished"):
        fit_surface(points, noise(27))


def test_heights_do_not_chain() -> None:
    """81 heights spread over 0.5 mm have no gap above 0.02 mm, and are not plane."""
    points = square_grid()
    points[:, 2] = np.random.default_rng(5).permutation(np.linspace(5.0, 5.5, 81))
    where = layout(points, 0.01)
    assert where.plane_mm is None
    assert where.heights_mm == ()
    assert where.plane_text == "points between Z = 5 and 5.5 mm"
    assert layout(points, 0.25).heights_mm == (5.25,)


def test_stacked_tilted_planes() -> None:
    points = np.concatenate([square_grid(z_mm=10.0), square_grid(z_mm=11.0)])
    points[:, 2] += 0.1 * points[:, 0]
    beta = np.random.default_rng(6).normal(size=16)
    terms = layout(points).terms
    assert len(terms) == 16
    surface = fit_surface(points, regressors(points, terms) @ beta + 1e-3 * noise(162))
    assert surface.layout.plane_text == "points between Z = 10 and 11 +0.1 X mm, on 2 planes"
    between = np.array([[0.5, -0.3, 10.6]])
    np.testing.assert_allclose(surface.predict(between).value, regressors(between, terms) @ beta, rtol=0, atol=1e-5)
    surface.predict(np.array([[1.0, 0.0, 11.1]]))  # on the upper plane
    with pytest.raises(ExtrapolationRefused, match=r"Z = 11\.1 mm was not measured"):
        surface.predict(np.array([[-1.0, 0.0, 11.1]]))  # inside the range of Z, above both planes


@pytest.mark.parametrize(("order", "letter", "axis"), [([0, 2, 1], "Y", 1), ([2, 0, 1], "X", 0)])
def test_upright_plane(order: list[int], letter: str, axis: int) -> None:
    points = square_grid(z_mm=7.0)[:, order]
    surface = fit_surface(points, points.sum(axis=1) ** 3 + noise(81))
    assert len(surface.terms) == surface.layout.rank == 10
    assert all(t[axis] == 0 for t in surface.terms)
    assert surface.layout.plane_text == f"all points on the plane {letter} = 7 mm: nothing is known about other {letter}"
    assert surface.layout.plane_mm is None
    np.testing.assert_allclose(surface.predict(points).value, points.sum(axis=1) ** 3, rtol=0, atol=3e-3)
    off = points[:1].copy()
    off[0, axis] += 0.01
    with pytest.raises(ExtrapolationRefused, match=rf"{letter} = 7\.01 mm was not measured"):
        surface.predict(off)


@pytest.mark.parametrize("count", [1, 2, 3])
@pytest.mark.parametrize("jitter", [0.0, 3e-4])
def test_planes_in_any_direction(count: int, jitter: float) -> None:
    rng = np.random.default_rng(7)
    for seed in range(15):
        turn = Rotation.random(random_state=seed)
        points = turn.apply(stacked(count)) + rng.uniform(-300.0, 300.0, 3)
        points += jitter * rng.uniform(-1.0, 1.0, points.shape)
        surface = fit_surface(points, noise(len(points), seed))
        assert surface.layout.rank == len(surface.terms) == RANK[count]
        assert np.isfinite(surface.predict(points).value).all()
        found = parallel_planes(points, surface.layout.tolerance_mm)
        assert found is not None
        normal = np.eye(3)[found.axis] - found.slope
        assert abs(normal @ turn.as_matrix()[:, 2]) / np.linalg.norm(normal) == pytest.approx(1.0, abs=1e-6)


def test_points_on_other_surfaces_are_refused() -> None:
    """Crossing planes and a sphere leave a gap in the 20 terms as well; what lies off them is unknown, so no terms are dropped."""
    cross = np.concatenate([square_grid()[:, [0, 2, 1]], square_grid()[:, [2, 0, 1]]])
    ball = np.random.default_rng(8).normal(size=(200, 3))
    ball /= np.linalg.norm(ball, axis=1)[:, None]
    for points in (cross, ball):
        assert layout(points).rank == 16
        with pytest.raises(SurfaceNotDetermined, match=r"for 20 terms, but .*cannot be distinguished|leaves no trace"):
            fit_surface(points, noise(len(points)))


def test_scattered_points_are_not_refused() -> None:
    points = np.random.default_rng(9).uniform(-1.0, 1.0, (60, 3)) * [200.0, 100.0, 3.0]
    surface = fit_surface(points, noise(60))
    assert surface.layout.rank == len(surface.terms) == 20


def test_a_surface_ends_where_the_points_end() -> None:
    surface = fit_surface(square_grid(z_mm=5.0), noise(81))
    surface.predict(np.array([[1.09, -1.09, 5.0]]))
    with pytest.raises(
        ExtrapolationRefused, match=r"point row 1 and 1 more: Y = 1\.2 mm was not measured; measured from -1 to 1 mm, margin"
    ):
        surface.predict(np.array([[0.0, 0.0, 5.0], [0.0, 1.2, 5.0], [3.0, 0.0, 5.0]]))
    wide = surface.predict(np.array([[0.0, 0.0, 5.0], [0.0, 1.2, 5.0]]), margin=0.5)
    assert wide.u_surface[1] > 2.0 * wide.u_surface[0]
    with pytest.raises(ExtrapolationRefused, match=r"Y = 1\.05"):
        surface.predict(np.array([[0.0, 1.05, 5.0]]), margin=0.0)
    with pytest.raises(ValueError, match="margin"):
        surface.predict(np.zeros((1, 3)), margin=-1.0)
