"""Scale errors and squareness as the whole volume sees them: slopes of the main effects, with their uncertainty.

The coefficients of the model are stated at the carriages' pivots, where one tool length often cannot separate them from angles. Their mean
effect over the volume - most of what one-axis tables correct - is known far better, and is what people mean by "the" squareness.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from abbe.models.arrays import F1
from abbe.models.compensation.additive import main_effect
from abbe.models.machine import AXES
from abbe.models.solvers.joint import JointSolution
from abbe.models.solvers.priors import U_WAVELENGTH
from abbe.models.uncertainty.inputs import StatedInputs
from abbe.models.uncertainty.sources import ErrorSources, error_sources, variances

SCALE_NOTE = "at the machine's temperature while it was measured"
"""What every printed scale has to say: no material temperature correction is made."""

SQUARENESS = (("C0Y", 0, 1, -1.0), ("B0Z", 0, 2, 1.0), ("A0Z", 1, 2, -1.0))
"""Name, the two axes, and the sign that turns the sum of both slopes into it (docs/explanation/conventions.md)."""


@dataclass(frozen=True, slots=True)
class MeanParameter:
    """A linear parameter averaged over the volume: mm/mm for scales (EXX...), rad for squareness, with its standard uncertainty."""

    name: str
    value: float
    u: float


def mean_linear(solution: JointSolution, *, positions: int = 41, nodes: int = 9) -> tuple[MeanParameter, ...]:
    """Mean scale error of X, Y, Z (slope of EXX, EYY, EZZ) and mean squareness C0Y, B0Z, A0Z over the volume.

    Scales hold at the temperature the machine had while it was measured: nothing is reduced to 20 degree C, and 1 K of a steel machine is
    about 11 um/m; so the uncertainty of the scales' temperature is not in. All other sources are (`abbe.models.uncertainty.sources`),
    orders above the chosen one included. Least-squares slopes over equidistant positions. The laser's wavelength is an unknown of every
    solution with a laser (`laser_scale`) and so within its sources; without one, scales carry its uncertainty all the same: none is known
    better.
    """
    sources = error_sources(solution, replace(StatedInputs().as_measured(), u_wavelength=0.0))  # the wavelength is in ``common``
    slopes = {}
    for a in range(3):
        first, last = (float(v) for v in solution.machine.stroke_mm[a])
        p = np.linspace(first, last, positions)
        weight = (p - p.mean()) / np.sum((p - p.mean()) ** 2)
        slopes[a] = np.einsum("p,pik->ik", weight, main_effect(solution.machine, sources.terms, a, p, nodes))
    common = 0.0 if "laser_scale" in solution.setup.names else U_WAVELENGTH
    found = [mean_parameter(sources, f"E{AXES[a]}{AXES[a]}", slopes[a][a], common) for a in range(3)]
    found += [mean_parameter(sources, name, sign * (slopes[a][b] + slopes[b][a])) for name, a, b, sign in SQUARENESS]
    return tuple(found)


def mean_parameter(sources: ErrorSources, name: str, gradient: F1, u_common: float = 0.0) -> MeanParameter:
    """Parameter that is ``gradient @ coefficients``, with its uncertainty from all sources and ``u_common`` on top."""
    u = float(np.sqrt(variances(sources, gradient[None])[0]))
    return MeanParameter(name, float(gradient @ sources.coefficients), float(np.hypot(u, u_common)))
