"""Which of a machine's error motions contributes how much: from a stored solution, with its whole covariance.

The contribution of one motion is the rms length of the deviation that it makes alone, over an even grid of the volume, the best-fit rigid
motion removed (that is where the workpiece lies, not an error of the machine): c = sqrt(theta^T G theta), G the mean square of its terms.
Its uncertainty follows from the covariance of theta (GUM 5.1.2); near zero, where the direction is itself not known, the worst direction
counts, as in `abbe.service.verification.deviations`. The squares of the contributions do not add up to the square of the whole: motions can
make up for each other.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.machine import Machine
from abbe.models.uncertainty.frame import field, volume_frame
from abbe.models.volumetric import volume_grid
from abbe.service.identification.stored_prediction import stored_prediction
from abbe.service.rendering.model import Contribution
from abbe.service.rendering.numbers import with_uncertainty

NODES = 6
HIDDEN = "not observable"


@dataclass(frozen=True, slots=True)
class Ranked:
    """One error motion: contribution and standard uncertainty in µm, whether the runs show it by itself, and if not, why."""

    name: str
    value_um: float
    u_um: float
    status: str
    reason: str

    @property
    def hidden(self) -> bool:
        """Whether these runs do not show it by itself."""
        return self.status == HIDDEN

    @property
    def shown(self) -> tuple[str, str]:
        """Value and U (k = 2), rounded together."""
        return with_uncertainty(self.value_um, self.u_um)

    @property
    def contribution(self) -> Contribution:
        """For the picture."""
        return Contribution(self.name, self.value_um, self.u_um)


def ranking(prediction: Mapping[str, Any], motions: Mapping[str, Mapping[str, Any]], machine: Machine) -> list[Ranked]:
    """Every motion of a stored solution, largest contribution first.

    Parameters
    ----------
    prediction, motions : mapping
        ``prediction`` and ``motions`` of the solution's document.
    machine : Machine
        Nominal geometry of the machine that was measured.
    """
    terms, coefficients, covariance = stored_prediction(dict(prediction))
    points = volume_grid(machine.stroke_mm, NODES)
    design = field(machine, terms, points, None, volume_frame(machine))
    out = []
    for name in dict.fromkeys(t.motion for t in terms):
        at = [k for k, t in enumerate(terms) if t.motion == name]
        part = design[:, :, at]
        mean_square = np.einsum("mik,mil->kl", part, part) / len(points)
        value, u = _size(mean_square, coefficients[at], covariance[np.ix_(at, at)])
        told = motions.get(name, {})
        out.append(Ranked(name, value * 1e3, u * 1e3, str(told.get("status", "")), str(told.get("reason") or "")))
    return sorted(out, key=lambda r: -r.value_um)


def _size(mean_square: F2, coefficients: F1, covariance: F2) -> tuple[float, float]:
    """Root of the mean square of a linear combination, and its standard uncertainty."""
    values, vectors = np.linalg.eigh(mean_square)
    root = (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    vector, spread = root @ coefficients, root @ covariance @ root.T
    size = float(np.linalg.norm(vector))
    worst = float(np.sqrt(max(np.linalg.eigvalsh(spread)[-1], 0.0)))
    if size <= 2.0 * worst:
        return size, worst
    along = vector / size
    return size, float(np.sqrt(max(along @ spread @ along, 0.0)))
