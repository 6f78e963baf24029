"""The draws over many seeds: the issue fixes their sizes, and nothing is tuned afterwards."""

import numpy as np
import pytest

from abbe.simulators.scenario import from_dict
from abbe.simulators.truth.draws import Draws, describe, draw_machine

SEEDS = range(200)
STROKES = ([0, 600], [0, 500], [0, 450])


@pytest.fixture(scope="module")
def draws() -> list[Draws]:
    return [draw_machine(from_dict({"seed": seed})) for seed in SEEDS]


def detrended_rms(x: np.ndarray, values: np.ndarray) -> np.ndarray:
    fit = np.polynomial.polynomial.polyfit(x, values, 1)
    return np.sqrt(np.mean((values - np.polynomial.polynomial.polyval(x, fit).T) ** 2, axis=0))


def test_normal_draws(draws: list[Draws]) -> None:
    for values, sd in (
        (np.array([d.scale for d in draws]), 40e-6),
        (np.array([d.squareness for d in draws]), 25e-6),
        (np.array([d.angle_slope for d in draws]), 15e-6),
        (np.array([d.bar_length_error_mm for d in draws]), 1.5e-3),
        (np.array([d.drift_mm for d in draws]), 1e-3),
    ):
        assert values.std() == pytest.approx(sd, rel=4 / np.sqrt(2 * values.size))
        assert abs(values.mean()) < 4 * sd / np.sqrt(values.size)


def test_uniform_draws(draws: list[Draws]) -> None:
    for values, low, high in (
        (np.array([d.backlash_mm for d in draws]), 1e-3, 5e-3),
        (np.array([d.bar_noise_mm for d in draws]), 0.25e-3, 0.6e-3),
        (np.array([d.drift_tau_s for d in draws]), 2400.0, 5400.0),
    ):
        assert low <= values.min() < low + 0.1 * (high - low)
        assert high - 0.1 * (high - low) < values.max() <= high
    assert all(d.laser_noise_mm == pytest.approx(0.6 * d.bar_noise_mm) for d in draws)


def test_functions_have_the_sizes_drawn_for_them(draws: list[Draws]) -> None:
    rms = []
    for d in draws:
        for axis, stroke in enumerate(STROKES):
            x = np.linspace(*stroke, 401)
            values = d.motions[axis](x)
            measured = detrended_rms(x, values)
            np.testing.assert_allclose(measured, d.rms[axis], rtol=1e-6)
            slopes = np.polynomial.polynomial.polyfit(x, values, 1)[1]
            assert slopes[axis] == pytest.approx(d.scale[axis], abs=1e-12)
            straight = [i for i in range(3) if i != axis]
            np.testing.assert_allclose(slopes[straight], 0.0, atol=1e-12)
            np.testing.assert_allclose(slopes[3:] * (stroke[1] - stroke[0]), d.angle_slope[axis], atol=1e-12)
            rms.append((measured[axis], *measured[straight], *measured[3:]))
    table = np.array(rms)
    for columns, low, high in ((table[:, :1], 1.5e-3, 5e-3), (table[:, 1:3], 1e-3, 4e-3), (table[:, 3:], 4e-6, 14e-6)):
        assert columns.min() >= low * (1 - 1e-6)
        assert columns.max() <= high * (1 + 1e-6)
        assert columns.mean() == pytest.approx(0.5 * (low + high), rel=0.06)


def test_functions_are_no_polynomials_of_low_degree(draws: list[Draws]) -> None:
    """What a polynomial of degree 6 leaves is well above the instruments' noise in some functions, and never zero."""
    x = np.linspace(0, 600, 401)
    scaled = np.linspace(-1, 1, 401)
    left = []
    for d in draws[:50]:
        values = d.motions[0](x)
        fit = np.polynomial.legendre.legfit(scaled, values, 6)
        left.append(np.sqrt(np.mean((values - np.polynomial.legendre.legval(scaled, fit).T) ** 2, axis=0)) / d.rms[0])
    ratio = np.array(left)
    assert ratio.min() > 1e-5
    assert np.median(ratio) > 0.01


def test_functions_are_smooth(draws: list[Draws]) -> None:
    x = np.linspace(0, 600, 1201)
    for d in draws[:50]:
        values = d.motions[0](x)
        bend = np.abs(np.diff(values, 2, axis=0)).max(axis=0)
        assert np.all(bend < 0.01 * d.rms[0])


def test_same_seed_same_machine_other_seed_other_machine() -> None:
    one, again, other = (draw_machine(from_dict({"seed": s})) for s in (7, 7, 8))
    assert describe(one) == describe(again)
    x = np.linspace(0, 600, 50)
    assert np.array_equal(one.motions[0](x), again.motions[0](x))
    assert not np.allclose(one.motions[0](x), other.motions[0](x))
