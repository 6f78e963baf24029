"""The exact kinematics against rule G of docs/explanation/conventions.md, written here once more and on its own."""

import itertools

import numpy as np
import pytest

from abbe.simulators.scenario import AXES, from_dict
from abbe.simulators.truth.draws import draw_machine
from abbe.simulators.truth.machine import Geometry, Machine, rotate

CHAINS = ["-".join(["w", *order, "t"]) for order in itertools.permutations("XYZb")]
PIVOTS = {"X": [300, 250, -150], "Y": [100, 50, -250], "Z": [30, 320, 260]}


def machine(chain: str, size: float = 1.0, tool=(10.0, -20.0, -120.0)) -> Machine:
    """A machine whose every error is ``size`` times the usual one."""
    magnitudes = {
        "scale_sd_um_per_m": 40 * size,
        "squareness_sd_urad": 25 * size,
        "positioning_rms_um": [3 * size, 3 * size],
        "straightness_rms_um": [2 * size, 2 * size],
        "angle_rms_urad": [9 * size, 9 * size],
        "angle_slope_sd_urad": 15 * size,
    }
    scenario = from_dict({"seed": 5, "machine": {"chain": chain, "pivots_mm": PIVOTS, "tool_mm": list(tool)}, "magnitudes": magnitudes})
    return Machine(Geometry(scenario.machine), draw_machine(scenario))


def points(n: int = 200) -> np.ndarray:
    return np.random.default_rng(2).uniform([0, 0, 0], [600, 500, 450], (n, 3))


def rule_g(m: Machine, chain: str, p: np.ndarray) -> np.ndarray:
    order = chain.split("-")
    bed = order.index("b")
    c0y, b0z, a0z = m.draws.squareness
    total = np.zeros_like(p)
    for name in AXES:
        j = AXES.index(name)
        values = m.draws.motions[j](p[:, j])
        d, e = values[:, :3].copy(), values[:, 3:]
        if name == "Y":
            d[:, 0] += -c0y * p[:, 1]
        if name == "Z":
            d[:, 0] += b0z * p[:, 2]
            d[:, 1] += -a0z * p[:, 2]
        place = order.index(name)
        nearer_tool = order[place + 1 : -1]
        not_nearer_work = [a for a in AXES if a not in order[1:place]]
        counted = nearer_tool if place > bed else not_nearer_work
        r = np.tile(m.geometry.tool_mm, (len(p), 1)) - np.array(PIVOTS[name], dtype=float)
        for axis in counted:
            r[:, AXES.index(axis)] += p[:, AXES.index(axis)]
        total += d + np.cross(e, r)
    return total


@pytest.mark.parametrize("chain", CHAINS)
def test_differs_from_rule_g_by_second_order_only(chain: str) -> None:
    p = points()
    rest = []
    for size in (20.0, 10.0):  # magnified, so that the second order stands clear of rounding
        m = machine(chain, size)
        exact = m.tool_position(p) - (p + m.geometry.tool_mm)
        first = rule_g(m, chain, p)
        rest.append(np.abs(exact - first).max())
        assert rest[-1] < 0.02 * np.abs(first).max()
    assert rest[0] / rest[1] == pytest.approx(4.0, rel=0.05)


@pytest.mark.parametrize("chain", CHAINS)
def test_without_errors_the_tool_is_where_it_was_sent(chain: str) -> None:
    m = machine(chain, 0.0)
    np.testing.assert_allclose(m.tool_position(points()), points() + m.geometry.tool_mm, atol=1e-9)


def test_rotation_is_finite_and_right_handed() -> None:
    quarter = np.array([[0.0, 0.0, np.pi / 2], [np.pi / 2, 0.0, 0.0], [0.0, 0.0, 0.0]])
    turned = rotate(quarter, np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 2.0, 3.0]]))
    np.testing.assert_allclose(turned, [[0, 1, 0], [0, 0, 1], [1, 2, 3]], atol=1e-12)
    rng = np.random.default_rng(0)
    angle, vector = rng.normal(size=(50, 3)), rng.normal(size=(50, 3))
    np.testing.assert_allclose(np.linalg.norm(rotate(angle, vector), axis=1), np.linalg.norm(vector, axis=1), rtol=1e-12)


def test_added_scale_grows_from_the_start_of_the_stroke() -> None:
    m = machine("w-X-Y-b-Z-t", 0.0)
    m.extra_scale[0] = 50e-6
    p = np.array([[0.0, 100.0, 100.0], [600.0, 100.0, 100.0]])
    np.testing.assert_allclose((m.tool_position(p) - p - m.geometry.tool_mm)[:, 0], [0.0, 0.03], atol=1e-9)
