"""Frames of three points and of all points: what each datum shows and hides."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from abbe.models.papers.kwon.errors import CollinearPoints
from abbe.models.papers.kwon.frames import (
    best_fit_errors,
    best_fit_frame,
    from_frame,
    into_frame,
    nearest_rotation,
    position_errors,
    rms,
    three_point_errors,
    three_point_frame,
)

DATUM3 = np.array([[-1.0, -1.0, 113.6], [1.0, -1.0, 113.6], [-1.0, 1.0, 113.6]])


def grid() -> np.ndarray:
    line = np.linspace(-1.0, 1.0, 5)
    return np.array([[x, y, 113.6] for x in line for y in line])


def placed(points: np.ndarray, seed: int = 3) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return Rotation.from_rotvec(rng.normal(0, 0.5, 3)).apply(points) + rng.uniform(-300, 300, 3)


def bent(points: np.ndarray) -> np.ndarray:
    x, y = points[:, 0], points[:, 1]
    return points + np.column_stack([0.02 * x - 0.03 * y + 0.005 * x**2, 0.018 * y - 0.025 * x, 0.03 - 0.01 * x * y])


@pytest.mark.parametrize("seed", range(5))
def test_cosine_law_is_gram_schmidt(seed: int) -> None:
    p = np.random.default_rng(seed).uniform(-2, 2, (3, 3)) + np.array([300.0, 100.0, 50.0])
    q, r = np.linalg.qr(np.stack([p[1] - p[0], p[2] - p[0]], axis=1))
    x, y = (q * np.sign(np.diag(r))).T
    frame = three_point_frame(p)
    np.testing.assert_allclose(frame[:3, :3], np.stack([x, y, np.cross(x, y)], axis=1), atol=1e-12)
    np.testing.assert_array_equal(frame[:3, 3], p[0])
    np.testing.assert_allclose(from_frame(frame, into_frame(frame, p)), p, atol=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_three_points_make_six_errors_zero(seed: int) -> None:
    rng = np.random.default_rng(seed)
    measured = placed(DATUM3 + rng.normal(0, 0.05, (3, 3)), seed)
    e = three_point_errors(DATUM3, measured, DATUM3, measured)
    zero = np.array([[True, True, True], [False, True, True], [False, False, True]])
    np.testing.assert_allclose(e[zero], 0.0, atol=1e-12)
    assert (np.abs(e[~zero]) > 1e-6).all()
    # what is left are the lengths of the triangle: along x exactly, the third point in the plane
    assert e[1, 0] == pytest.approx(np.linalg.norm(measured[1] - measured[0]) - 2.0, abs=1e-12)


def test_errors_depend_on_the_datum() -> None:
    """The same machine: rms 61 um by three points, 34 um by best fit (math.md 6); other three points give yet another figure."""
    nominal, measured = grid(), placed(bent(grid()))
    both = position_errors(DATUM3, placed(bent(DATUM3)), nominal, measured)
    assert both.three_point_rms_mm == pytest.approx(0.061, abs=5e-4)
    assert both.best_fit_rms_mm == pytest.approx(0.034, abs=5e-4)
    assert "six errors are zero" in both.datum
    other3 = DATUM3 * [-1.0, -1.0, 1.0]
    other = three_point_errors(other3, placed(bent(other3)), nominal, measured)
    assert abs(rms(other) - both.three_point_rms_mm) > 1e-3


def test_best_fit_does_not_depend_on_the_placement() -> None:
    nominal = grid()
    here, there = (best_fit_errors(nominal, placed(bent(nominal), seed)) for seed in (1, 2))
    np.testing.assert_allclose(here, there, atol=1e-12)


def test_best_fit_is_the_smallest() -> None:
    rng = np.random.default_rng(5)
    nominal, measured = grid(), placed(bent(grid()))
    best = rms(best_fit_errors(nominal, measured))
    frame = best_fit_frame(nominal, measured)
    for _ in range(20):
        turned = frame.copy()
        turned[:3, :3] = frame[:3, :3] @ Rotation.from_rotvec(rng.normal(0, 1e-3, 3)).as_matrix()
        turned[:3, 3] += measured.mean(axis=0) - from_frame(turned, nominal).mean(axis=0) + rng.normal(0, 1e-3, 3)
        assert rms(into_frame(turned, measured) - nominal) > best


def test_best_fit_against_an_independent_solver() -> None:
    nominal, measured = grid(), placed(bent(grid()))
    rotation, _ = Rotation.align_vectors(measured - measured.mean(axis=0), nominal - nominal.mean(axis=0))
    np.testing.assert_allclose(best_fit_frame(nominal, measured)[:3, :3], rotation.as_matrix(), atol=1e-9)


def test_mirrored_points_are_not_mirrored_back() -> None:
    points = np.random.default_rng(6).normal(size=(12, 3))
    frame = best_fit_frame(points, points * [1.0, 1.0, -1.0])
    assert np.linalg.det(frame[:3, :3]) == pytest.approx(1.0)
    assert np.linalg.det(nearest_rotation(np.diag([1.0, 1.0, -1.0]))) == pytest.approx(1.0)


@pytest.mark.parametrize(
    "points",
    [
        [[0, 0, 0], [1, 1, 1], [2, 2, 2]],
        [[0, 0, 0], [0, 0, 0], [1, 0, 0]],
        [[5, 0, 0], [1, 0, 0], [5, 0, 0]],
        [[300, 100, 50], [302, 100, 50], [301, 100 + 1e-7, 50]],
    ],
)
def test_points_on_a_line_are_refused(points: list[list[float]]) -> None:
    with pytest.raises(CollinearPoints, match="lie on a line or coincide"):
        three_point_frame(np.array(points, dtype=float))


def test_best_fit_on_a_line_is_refused() -> None:
    line = np.outer(np.arange(5.0), [1.0, 2.0, 3.0])
    with pytest.raises(CollinearPoints, match="nominal points"):
        best_fit_frame(line, line)
    with pytest.raises(CollinearPoints):
        best_fit_frame(line[:2], line[:2])


def test_shapes_are_checked() -> None:
    with pytest.raises(ValueError, match="3 points"):
        three_point_frame(np.eye(4)[:, :3])
    with pytest.raises(ValueError, match="do not fit"):
        best_fit_errors(grid(), grid()[:4])
