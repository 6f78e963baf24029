"""What counting the body diagonals gives the nine tables, and what it costs the volume, over machines that the solver cannot represent."""

import numpy as np
import pytest

import abbe.models.compensation.additive as additive
from abbe.models.compensation.nine_tables import nine_tables
from abbe.models.geometry.volume import field_statistics, volume_grid
from abbe.models.paths import DIAGONALS, diagonal_ends
from tests.models.solvers.truth import MACHINE


def largest_range_mm(field, tables=None):
    """Largest range of the deviation along a body diagonal (docs/explanation/conventions.md), with tables if given."""
    found = []
    for name in DIAGONALS:
        start, end = diagonal_ends(MACHINE.stroke_mm, name)
        p = np.linspace(start, end, 81)
        off = field(p) + (tables.correction_at(p) if tables else 0.0)
        found.append(np.ptp(off @ (end - start) / np.linalg.norm(end - start)))
    return max(found)


@pytest.fixture(scope="module")
def figures(solved_truth):
    """Per machine: diagonal range and volumetric rms, with the main effects alone and with the diagonals counted, as shares of before."""
    grid, out = volume_grid(MACHINE.stroke_mm, 7), []
    for seed in range(1, 4):
        truth, solution = solved_truth(seed)
        row = []
        for weight in (0.0, additive.DIAGONAL_WEIGHT):
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr(additive, "DIAGONAL_WEIGHT", weight)
                tables = nine_tables(solution, (25, 21, 19))
            before = field_statistics(grid, truth.deviation(grid)).rms_mm
            after = field_statistics(grid, truth.deviation(grid) + tables.correction_at(grid)).rms_mm
            row.append((largest_range_mm(truth.deviation, tables) / largest_range_mm(truth.deviation), after / before))
        out.append(row)
    return np.array(out)


def test_the_diagonals_become_better_by_counting_them(figures):
    gain = figures[:, 0, 0] / figures[:, 1, 0]
    assert np.median(gain) > 1.1
    assert gain.min() > 0.97


def test_the_volume_pays_little_for_it(figures):
    cost = figures[:, 1, 1] / figures[:, 0, 1]
    assert np.median(cost) < 1.04
    assert cost.max() < 1.08


U = np.linspace(0.0, 1.0, 9)
GRIDS = tuple(lo + U * (hi - lo) for lo, hi in MACHINE.stroke_mm)


def unit(p):
    return (p - MACHINE.stroke_mm[:, 0]) / MACHINE.length_mm


def test_a_field_that_is_additive_comes_back_whole():
    def field(p):
        x, y, z = unit(p).T
        return np.stack([x**3 - y, np.sin(y) + z**2, x * x + 2 * y - np.exp(z)], axis=1)[:, :, None]

    found = additive.additive(field, MACHINE.stroke_mm, GRIDS, nodes=9, order=8)
    for a, effect in enumerate(found):
        p = np.tile(MACHINE.centre_mm, (9, 1))
        p[:, a] = GRIDS[a]
        wanted = field(p)
        assert effect - effect[0] == pytest.approx(wanted - wanted[0], abs=1e-8)


def test_products_are_left_to_the_volume_without_weight_and_taken_on_the_diagonals_with_it(monkeypatch):
    def field(p):  # yaw of X seen at Y: no sum of functions of one axis is nearer to it than its main effects, but for the diagonals
        x, y, _ = (2.0 * unit(p) - 1.0).T
        return np.stack([x * x * y, 0 * x, 0 * x], axis=1)[:, :, None]

    def left(points, weight):
        monkeypatch.setattr(additive, "DIAGONAL_WEIGHT", weight)
        found = additive.additive(field, MACHINE.stroke_mm, GRIDS, nodes=9, order=4)
        total = sum(np.interp(points[:, a], GRIDS[a], found[a][:, 0, 0]) for a in range(3))
        off = field(points)[:, 0, 0] - total
        return np.sqrt(np.mean((off - off.mean()) ** 2))

    volume = volume_grid(MACHINE.stroke_mm, 9)
    lines = np.concatenate([np.linspace(*diagonal_ends(MACHINE.stroke_mm, d), 9) for d in DIAGONALS])
    assert left(volume, 0.0) < left(volume, 1.0)
    assert left(lines, 1.0) < 0.9 * left(lines, 0.0)
