"""Budget of a predicted deviation: what each source adds, at one point or over the volume."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from abbe.models.arrays import F1
from abbe.models.uncertainty.prediction import Prediction
from abbe.models.uncertainty.sources import WORDS


@dataclass(frozen=True, slots=True)
class BudgetLine:
    """One source: the rms length of the error vector it makes, mm, and its share of the total variance (all shares: 1)."""

    name: str
    words: str
    u_mm: float
    share: float


@dataclass(frozen=True)
class Budget:
    """Lines, largest first, and the total: root of the sum of their squares.

    ``u_mm`` is the rms length of the error of the predicted vector: root of the sum of the three variances.
    ``expanded_mm``: largest expanded uncertainty of a component at these points, with its coverage factor.
    """

    lines: tuple[BudgetLine, ...]
    u_mm: float
    expanded_mm: float
    coverage_factor: float
    probability: float

    def line(self, name: str) -> BudgetLine:
        """A line by the name of its source; KeyError where the budget does not have it."""
        for line in self.lines:
            if line.name == name:
                return line
        raise KeyError(name)

    def text(self) -> str:
        """The budget as a table for people, micrometres."""
        rows = [f"{'source':<72}{'u, um':>8}{'share':>8}"]
        rows += [f"{line.words:<72}{1e3 * line.u_mm:8.3f}{line.share:8.1%}" for line in self.lines]
        rows.append(f"{'together':<72}{1e3 * self.u_mm:8.3f}{1.0:8.1%}")
        rows.append(f"largest expanded uncertainty of a component: {1e3 * self.expanded_mm:.3f} um (k = {self.coverage_factor:.2f})")
        return "\n".join(rows)


def budget_at(prediction: Prediction, index: int) -> Budget:
    """Budget at one of the predicted points.

    Raises
    ------
    IndexError
        The prediction has no such point.
    """
    return _budget(prediction, np.array([range(len(prediction.points_mm))[index]]))


def budget_over(prediction: Prediction) -> Budget:
    """Budget over all predicted points: mean variances, so root-mean-square uncertainties. Take a grid over the volume."""
    return _budget(prediction, np.arange(len(prediction.points_mm)))


def worst_point(prediction: Prediction) -> int:
    """Index of the point with the largest uncertainty of the vector."""
    return int(np.argmax(prediction.u_vector_mm))


def _budget(prediction: Prediction, points: np.ndarray[tuple[int, ...], np.dtype[np.int64]]) -> Budget:
    variance: F1 = prediction.variance_mm2[:, points].sum(axis=2).mean(axis=1)
    total = float(variance.sum())
    order = np.argsort(-variance, kind="stable")
    lines = tuple(
        BudgetLine(
            prediction.names[i], WORDS[prediction.names[i]], float(np.sqrt(variance[i])), float(variance[i] / total) if total else 0.0
        )
        for i in order
    )
    expanded, k = prediction.expanded_mm[points], prediction.coverage_factor[points]
    widest = np.unravel_index(int(np.argmax(expanded)), expanded.shape)
    return Budget(lines, float(np.sqrt(total)), float(expanded[widest]), float(k[widest]), prediction.probability)
