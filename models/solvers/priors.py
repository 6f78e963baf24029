"""Typical sizes of error motions and set-up errors: documented priors, never hidden ones.

They are wide (a first machine is expected well inside them) and only decide what the data leave open: `Estimate.data_share` tells.
Sources: effects.md 2 (typical magnitudes of geometry), published machine data (Yang Table 2: 100 urad scales; Pahk: up to 110 urad).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from models.arrays import F1, F2
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
    laser_scale : relative error of the wavelength, common to all laser runs of a campaign.
    cosine : relative 1 / (m.l) - 1 of one laser set-up (math.md 5.4), u^2/2 - t.u for a beam aligned to 0.3 mrad in each direction (0.3 mm
        in 1 m) and a mirror tilted by ``tilt_rad``: rms 0.25e-6. On 1 m that is 0.25 um, as much as the noise of the reading.
    bar_drift_mm_s : growth of tool against cup in each direction while a ball-bar set-up stands: 0.18 um/min or 11 um/h, an assumption
        for a machine that is neither cold nor settled, until drifts are measured.
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
    laser_scale: float = U_WAVELENGTH
    cosine: float = 0.25e-6
    bar_drift_mm_s: float = 3e-6


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


SIZE_FACTOR = 3.0
"""Hyperprior of a class of unknowns: its typical size is known within this factor (one standard deviation of the logarithm)."""
SPECTRUM_SD = 1.0
"""Hyperprior of the two numbers that bend how sizes fade with the order."""
LEARNED_SETUP = ("cup", "tilt", "cosine", "drift", "bar_drift")
"""Set-up unknowns that hands and temperatures make, so that their size may be learned. Stated calibrations never are."""


@dataclass(frozen=True)
class SizeModel:
    """How prior variances depend on a few numbers that the data may correct: log variance = log reference + ``design @ psi``.

    Attributes
    ----------
    names : tuple of str
        What each number is: a class of unknowns (its log variance over the documented one), or ``fade`` and ``cut`` of the orders.
    design : array, shape (p, h)
    sd : array, shape (h,)
        Standard deviation of the normal hyperprior of each number, around 0 (the documented size).
    """

    names: tuple[str, ...]
    design: F2
    sd: F1


def size_model(terms: tuple[Term, ...], rest: tuple[str, ...]) -> SizeModel:
    """Classes of the smooth ``terms`` and of the other unknowns ``rest`` (backlash and set-up, by name), in this order.

    All squareness errors share one size, all scales, all positioning errors of order 2 and more, all straightness errors, all angles, all
    slopes of angles, and so on: what the data show of some tells how large the others may be. Sizes fade with the order k as
    exp(-fade ln(k/2) - cut (k^2 - 4)/72) on top of `Priors.decay_order`, the same for all motions.
    """
    kinds = [_class(t) for t in terms] + [_setup_class(n) for n in rest]
    names = tuple(dict.fromkeys(k for k in kinds if k))
    columns = [np.array([float(k == name) for k in kinds]) for name in names]
    sd = [2.0 * np.log(SIZE_FACTOR)] * len(names)
    order = np.array([t.order if t.order >= 2 else 2 for t in terms] + [2] * len(rest), dtype=np.float64)
    if order.max(initial=2.0) > 3.0:
        names += ("fade", "cut")
        columns += [-2.0 * np.log(order / 2.0), -(order**2 - 4.0) / 36.0]
        sd += [SPECTRUM_SD, SPECTRUM_SD]
    design = np.stack(columns, axis=1) if columns else np.zeros((len(kinds), 0))
    return SizeModel(names, design, np.array(sd))


def _class(term: Term) -> str:
    if term.order == 0:
        return "squareness"
    if term.component >= 3:
        return "angle slope" if term.order == 1 else "angle"
    if term.component == term.axis:
        return "scale" if term.order == 1 else "positioning"
    return "straightness"


def _setup_class(name: str) -> str:
    return next((kind for kind in (*LEARNED_SETUP, "backlash") if name.startswith(f"{kind}_")), "")
