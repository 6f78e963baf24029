"""The present simulation of a campaign as a linear model: smooth error motions, set-up errors that it includes, zeros of laser runs."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.discovery.case import Case
from abbe.models.effects.path import Path
from abbe.models.geometry.bases import Term, smooth_terms
from abbe.models.machine import Machine, with_tool
from abbe.models.solvers.observations import RunData
from abbe.models.solvers.observe import LOST, AxisPlaces, SetupUnknowns, bar_length_name, linearise, predict
from abbe.models.solvers.priors import Priors, smooth_shapes, term_prior_sd

ORDER = 14
"""Highest Legendre order of each error motion. With 7 coefficients, cases without a missing effect gave false discoveries; with 10 to 18
none did."""
LENGTH = 1.35
"""Correlation length of the error motions, strokes, for predictions."""
BAR = "bar_length"
CUP_MM, BAR_MM, TILT_RAD, ZERO_MM = 60e-3, 20e-3, 1e-3, 20e-3
"""Prior standard deviations of set-up unknowns, wide enough for careless mounting."""


@dataclass(frozen=True)
class Baseline:
    """Unknowns of the present simulation.

    Attributes
    ----------
    setup : set-up unknowns in the form of `abbe.models.solvers.observe`.
    parts : array: values of ``setup`` = parts @ the set-up unknowns of ``names``.
    names, prior_sd : names and prior standard deviations of all unknowns, smooth terms first, then set-ups; mm, rad. One ball-bar serves
    all radii, so all radii share one length error ``bar_length``.
    root : array, shape (p, p)
        Factor of the prior covariance root root^T, which includes the smoothness of the error motions.
    """

    machine: Machine
    terms: tuple[Term, ...]
    setup: SetupUnknowns
    parts: F2
    names: tuple[str, ...]
    prior_sd: F1
    root: F2

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return len(self.names)

    def _full(self, theta: F1) -> F1:
        n = len(self.terms)
        return np.concatenate([theta[:n], np.zeros(LOST), self.parts @ theta[n:]])

    def read(self, run: RunData, theta: F1) -> F1:
        """Return the exact reading of a run, mm, shape (n,) (`abbe.models.solvers.observe`)."""
        return predict(self.machine, self.terms, run, self.setup, self._full(theta))

    def linear(self, run: RunData, theta: F1) -> tuple[F1, F2]:
        """Return the reading of a run, mm, shape (n,), and its derivative with respect to the unknowns, shape (n, p)."""
        value, jacobian = linearise(self.machine, self.terms, run, self.setup, self._full(theta))
        n = len(self.terms)
        return value, np.concatenate([jacobian[:, :n], jacobian[:, n + LOST :] @ self.parts], axis=1)

    def along(self, path: Path, run: RunData, theta: F1) -> Path:
        """Return the path with the bar's actual direction in ``look``: the cup's offset and the machine's deviation turn the bar.

        The turn matters if the axes lag: with a bar of 150 mm and an offset of 30 um, a lag of 1 mm along the path changes the reading by
        0.2 um.
        """
        if path.kind != "bar":
            return path
        full, machine = self._full(theta), with_tool(self.machine, run.tool_mm)
        off = []
        for axes in (run.axes_mm, path.centre_mm[None]):
            places = AxisPlaces.of(machine, self.terms, axes, np.zeros_like(axes))
            off.append(places.deviation_mm(places.motions(full)))
        known = dict(zip(self.setup.names, full[len(self.terms) + LOST :], strict=True))
        cup = np.array([known.get(f"cup_{run.setup}_{a}", 0.0) for a in "xyz"])
        bar = run.axes_mm - path.centre_mm + off[0] - off[1] - cup
        return replace(path, look=bar / np.linalg.norm(bar, axis=1, keepdims=True))


def baseline_of(case: Case) -> Baseline:
    """Build the baseline with the unknowns that ``case.includes`` asks for."""
    terms = tuple(t for t in smooth_terms(ORDER) if "rigid21" in case.includes or t.order == 0 or (t.order == 1 and t.component == t.axis))
    sd: dict[str, float] = {}
    for run in case.runs:
        p = run.path
        if p.kind == "bar":
            if "setup_centre_offset" in case.includes:
                sd |= {f"cup_{p.setup}_{a}": CUP_MM for a in "xyz"}
            if "bar_length_error" in case.includes:
                sd[bar_length_name(p.radius_mm)] = BAR_MM
        else:
            if "mirror_tilt" in case.includes:
                sd |= {f"tilt_{p.setup}_{k}": TILT_RAD for k in "12"}
            sd[f"zero_{p.label}"] = ZERO_MM
    setup = SetupUnknowns(tuple(sorted(sd)), np.array([sd[k] for k in sorted(sd)]))
    own = [BAR if name.startswith(f"{BAR}_") else name for name in setup.names]
    ours = tuple(dict.fromkeys(own))
    parts = np.array([[float(name == o) for o in ours] for name in own]).reshape(len(own), len(ours))
    setup_sd = np.array([BAR_MM if o == BAR else sd[o] for o in ours])
    priors = Priors(cup_mm=CUP_MM)
    prior_sd = np.concatenate([term_prior_sd(case.machine, terms, priors), setup_sd])
    names = tuple(t.name for t in terms) + ours
    return Baseline(case.machine, terms, setup, parts, names, prior_sd, _root(terms, prior_sd, priors))


def _root(terms: tuple[Term, ...], prior_sd: F1, priors: Priors) -> F2:
    """Factor of the prior covariance: unknowns are independent, except orders of 2 and more of the same motion (`smooth_shapes`)."""
    root = np.diag(prior_sd)
    motion = np.array([t.motion if t.order >= 2 else "" for t in terms])
    shapes, variance = smooth_shapes(ORDER, LENGTH)
    for name in dict.fromkeys(m for m in motion if m):
        at = np.flatnonzero(motion == name)
        size = priors.angle_rad if terms[at[0]].component >= 3 else priors.straightness_mm
        root[np.ix_(at, at)] = shapes * np.sqrt(variance) * size
    return root
