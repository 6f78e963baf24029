"""Typical sizes of error motions and set-up errors: documented priors, never hidden ones.

They are wide (a first machine is expected well inside them) and only decide what the data leave open: `Estimate.data_share` tells.
Sources: effects.md 2 (typical magnitudes of geometry), published machine data (Yang Table 2: 100 urad scales; Pahk: up to 110 urad).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from models.arrays import F1
from models.geometry.bases import Term
from models.machine import Machine

U_WAVELENGTH = 0.3e-6
"""Relative standard uncertainty of the laser's wavelength after air compensation (about 0.3 K or 1 hPa): no scale is known better."""


SMALLEST_LENGTH_MM = 1e-5
"""A stated length uncertainty of zero is taken as this: no calibration certificate knows 10 nm better."""


@dataclass(frozen=True, slots=True)
class Priors:
    """Standard deviations of the priors.

    Attributes
    ----------
    scale_rad, squareness_rad : linear positioning error per length; squareness.
    positioning_mm, straightness_mm : one Legendre coefficient of order 2 and more.
    angle_rad, angle_slope_rad : one coefficient of order 2 and more; of order 1.
    decay_order : orders above fade as 1 / (1 + (order / decay)^2): machine errors are smooth.
    backlash_mm, cup_mm, tilt_rad, zero_mm, drift_mm_s : lost motion; cup offset; mirror tilt; first laser record; drift of a laser run.
    bar_length_mm, bar_unknown_mm : length of a bar that is called calibrated without a figure; of a bar that is not calibrated (what a
        careful hand sets with a rule block or caliper: on a 150 mm bar it leaves every scale to the scales' own prior).
    """

    scale_rad: float = 100e-6
    squareness_rad: float = 100e-6
    positioning_mm: float = 5e-3
    straightness_mm: float = 5e-3
    angle_rad: float = 15e-6
    angle_slope_rad: float = 20e-6
    decay_order: float = 6.0
    backlash_mm: float = 10e-3
    cup_mm: float = 60e-3
    bar_length_mm: float = 2e-3
    bar_unknown_mm: float = 0.1
    tilt_rad: float = 500e-6
    zero_mm: float = 2e-3
    drift_mm_s: float = 1e-6


def bar_length_sd(u_length_mm: float | None, calibrated: bool | None, priors: Priors) -> float:
    """Prior standard deviation of a bar's length, mm, from what its run states (run-format.md 3).

    The stated ``u_length_mm`` counts, unless the length is said to be uncalibrated or nothing is said at all: then a ball-bar must not
    lend the machine a scale that nobody measured.
    """
    if calibrated is False or (calibrated is None and u_length_mm is None):
        return max(priors.bar_unknown_mm, u_length_mm or 0.0)
    return priors.bar_length_mm if u_length_mm is None else max(u_length_mm, SMALLEST_LENGTH_MM)


def term_prior_sd(machine: Machine, terms: tuple[Term, ...], priors: Priors) -> F1:
    """Prior standard deviation of each smooth term's coefficient, shape (len(terms),), mm or rad."""
    return np.array([_sd(machine, t, priors) for t in terms])


def _sd(machine: Machine, term: Term, p: Priors) -> float:
    if term.order == 0:
        return p.squareness_rad
    fade = 1.0 / (1.0 + (term.order / p.decay_order) ** 2)
    if term.component >= 3:
        return p.angle_slope_rad if term.order == 1 else p.angle_rad * fade
    if term.component == term.axis:
        if term.order == 1:
            return float(p.scale_rad * machine.length_mm[term.axis] / 2)
        return p.positioning_mm * fade
    return p.straightness_mm * fade
