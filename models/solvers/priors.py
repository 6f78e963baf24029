"""Typical sizes of error motions and set-up errors: the documented priors.

They are wide (a usual machine lies well inside them) and matter only where the data leave something open
(`abbe.models.solvers.least_squares.ParameterEstimate.data_share`). Sources: published machine data (Yang and Kim, Table 2: scales of
100 urad; Pahk: up to 110 urad).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

from abbe.models.arrays import F1, F2
from abbe.models.geometry.bases import SMOOTH_ORDER, Term
from abbe.models.machine import Machine
from abbe.models.solvers.artefact import LEARNED

U_WAVELENGTH = 0.3e-6
"""Relative standard uncertainty of the laser's wavelength after air compensation (about 0.3 K or 1 hPa)."""


SMALLEST_LENGTH_MM = 1e-5
"""Least standard uncertainty of a bar's length, also where the run states less: no calibration is better than 10 nm."""


@dataclass(frozen=True, slots=True)
class Priors:
    """Standard deviations of the priors.

    Attributes
    ----------
    scale_rad, squareness_rad : linear positioning error per length; squareness.
    positioning_mm, straightness_mm : one Legendre coefficient of order 2 and more.
    angle_rad, angle_slope_rad : one coefficient of an angle: of order 2 and more; of order 1.
    decay_order : coefficients fall with the order as 1 / (1 + (order / decay_order)^2), because machine errors are smooth.
    rough_mm, rough_rad : rough part of a translation; rough part of a rotation (orders above `SMOOTH_ORDER`): joints of rails, wear.
    detail_mm : deviation at a place of a step test that no order follows, e.g. from the lead of a screw (`abbe.models.solvers.engine`).
    backlash_mm, cup_mm, tilt_rad, zero_mm, drift_mm_s : lost motion; cup offset; mirror tilt; error of a laser run's first record; drift of
        a laser run.
    bar_length_mm, bar_unknown_mm : length of a bar that is stated as calibrated without a figure; length of an uncalibrated bar (set with a
    gauge block or caliper; for a 150 mm bar too uncertain to determine a scale).
    laser_scale : relative error of the wavelength, common to all laser runs of a campaign.
    cosine : 1 / (m.l) - 1 of one laser set-up with mirror normal m and beam l, about u^2/2 - t.u for a beam off by u (0.3 mrad in each
        direction, 0.3 mm in 1 m) and a mirror tilted by t (``tilt_rad``): rms 0.25e-6, on 1 m as much as the noise of the reading.
    bar_drift_mm_s : drift of the tool against the cup in each direction during a ball-bar set-up: 0.18 um/min or 11 um/h, an assumption
        for a machine that is neither cold nor settled.
    pooled : whether the size of the whole machine, scales and squareness included, is estimated too (artefacts: few readings).
    """

    scale_rad: float = 100e-6
    squareness_rad: float = 100e-6
    positioning_mm: float = 5e-3
    straightness_mm: float = 5e-3
    angle_rad: float = 15e-6
    angle_slope_rad: float = 20e-6
    decay_order: float = 6.0
    rough_mm: float = 1e-3
    rough_rad: float = 3e-6
    detail_mm: float = 1e-3
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
    pooled: bool = False


def bar_length_sd(u_length_mm: float | None, calibrated: bool | None, priors: Priors) -> float:
    """Prior standard deviation of a bar's length, mm, from what its run states (docs/schemas/run.schema.json).

    The stated ``u_length_mm`` is used, except for a bar that is stated as uncalibrated. Such a bar, or one about which the run states
    nothing, gets at least ``bar_unknown_mm``, so that its length does not fix the machine's scales.
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
LARGEST_SIZE, SMALLEST_SIZE = 5.0, 0.07
"""Bounds of the estimated size of a class relative to the documented size; set-ups and lost motion have no lower bound."""
MOTION_FACTOR = 2.5
"""Hyperprior of the size of one error motion relative to its class: known within this factor."""
LARGEST_MOTION = 5.0
"""One error motion is never estimated more than this many times as large as its class, nor less than 1 / `LARGEST_SIZE` as large."""
SMOOTHNESS_SD = 0.7
"""Hyperprior: how much faster than documented the sizes of one motion may fall with the order; never slower (`SizeModel.low`)."""
ORDER_SD, LEAST_ORDER, LARGEST_ORDER = 1.0, -6.0, 1.0
"""Hyperprior and bounds of the log variance of one order, common to all motions: a little larger than documented, or almost nothing."""
LEARNED_SETUP = ("cup", "tilt", "cosine", "drift", "bar_drift", "detail", *LEARNED)
"""Set-up unknowns whose typical size is estimated from the data: those from mounting and temperature, not those from calibrations."""
LENGTHS = tuple(float(v) for v in np.round(0.1 * 2.0 ** (np.arange(16) / 4.0), 4))
"""Correlation lengths of the error motions that are tried, in strokes: 0.1 to 1.35."""
FIRST_LENGTH = LENGTHS[7]
LENGTH_SPREAD = 0.4
"""Spread of the correlation lengths of one machine's motions: standard deviation of the logarithm, a factor of 1.5."""
ENDS_SHARES = (0.1, 0.03)
"""Usual and least share of the part of a motion's variance that is largest at the ends of the stroke, where guideways sag most."""
ROUGH_LENGTH_MM = 30.0
"""Correlation length of the rough part of a translational motion: between the pitch of a screw and the carriage's length."""
SMALLEST_BEND = 0.003
"""Least prior standard deviation of a shape of an error motion, as a fraction of the documented size: 15 nm or 0.045 urad."""
SMALLEST_SHARE = 1e-7
"""Least variance of a shape as a fraction of the largest, so that no shape is ruled out."""
NODES = 160
"""Nodes of the quadrature that projects a correlation on Legendre polynomials."""


@cache
def smooth_shapes(order: int, length: float, ends: float = ENDS_SHARES[0]) -> tuple[F2, F1]:
    """Shapes of an error motion and their variances: the prior covariance of its Legendre coefficients of order 2 to ``order``.

    The coefficients are those of a stationary process with Matern 3/2 correlation. Its correlation length is log-normal: about ``length``
    strokes, with the spread `LENGTH_SPREAD`. The share ``ends`` of the variance is in independent coefficients, which are largest at the
    ends. A smoother correlation (squared exponential) makes motions analytic: readings in the middle of a stroke would determine its ends.
    The shapes are the eigenvectors of the coefficients' covariance.

    Returns
    -------
    shapes : array, shape (order - 1, order - 1)
        Coefficients of every shape (columns), smoothest first, orthonormal.
    variance : array, shape (order - 1,)
        Variance of every shape, for a process of variance 1 (before its straight line is removed).
    """
    spread = np.linspace(-2.0, 2.0, 9)
    share = np.exp(-0.5 * spread**2) / np.exp(-0.5 * spread**2).sum()
    scaled = np.sqrt(3.0) * _gaps()[None] / (length * np.exp(LENGTH_SPREAD * spread))[:, None, None]
    process = _projected(np.einsum("s,sij->ij", share, (1.0 + scaled) * np.exp(-scaled)), 2, order)
    k = np.arange(2, order + 1)
    fade = (1.0 + (k / Priors().decay_order) ** 2) ** -2.0
    at_ends = np.diag(fade / (fade / (2.0 * k + 1.0)).sum())
    values, vectors = np.linalg.eigh((1.0 - ends) * process + ends * at_ends)
    values, vectors = values[::-1], vectors[:, ::-1]
    vectors = vectors * np.sign(vectors[np.argmax(np.abs(vectors), axis=0), np.arange(k.size)])
    return np.asarray(vectors), np.maximum(values, SMALLEST_SHARE * values[0])


@cache
def rough_root(first: int, last: int, length: float) -> F2:
    """Root of the prior covariance of a rough motion's Legendre coefficients of order ``first`` to ``last``, for a process of variance 1.

    The process has an exponential correlation of ``length`` strokes: kinks, as of a screw's pitch, a joint of rails, a worn place.
    """
    return np.asarray(np.linalg.cholesky(_projected(np.exp(-_gaps() / length), first, last)), dtype=np.float64)


def _gaps() -> F2:
    u, _ = legendre.leggauss(NODES)
    return np.asarray(np.abs(u[:, None] - u) / 2.0)


def _projected(kernel: F2, first: int, last: int) -> F2:
    """Covariance of the Legendre coefficients of a process. ``kernel``: that of the process at the nodes of the quadrature."""
    u, weight = legendre.leggauss(NODES)
    project = (np.arange(first, last + 1) + 0.5)[:, None] * legendre.legvander(u, last)[:, first:].T * weight
    return np.asarray(project @ kernel @ project.T)


@dataclass(frozen=True)
class SizeModel:
    """Prior variances as a function of a few numbers psi that the data determine: log variance = log reference + ``design @ psi``.

    Attributes
    ----------
    typical : array, shape (p,)
        Documented size of every unknown, mm or rad; the unit of this unknown in all other arrays.
    root : array, shape (p, p)
        Unknowns (in units of ``typical``) = ``root`` @ independent unknowns of reference variance 1; a block per error motion
        (`smooth_shapes`) and per rough part (`rough_root`), elsewhere the unit matrix.
    blocks, rough : tuple of arrays of int
        Unknowns of each error motion of order 2 to `SMOOTH_ORDER`; unknowns of each rough part (higher orders).
    length, ends : float
        Correlation length of the error motions, strokes; share of their variance at the ends of the strokes.
    names : tuple of str
        Meaning of each number of psi: log variance of a class of unknowns relative to the documented one, of one error motion relative to
        its class, smoothness of one motion, size of one order in all motions.
    design : array, shape (p, h)
    sd, low, high : array, shape (h,)
        Standard deviation of the normal hyperprior of each number, around 0 (the documented size), and its bounds.
    """

    typical: F1
    root: F2
    blocks: tuple[NDArray[np.intp], ...]
    rough: tuple[NDArray[np.intp], ...]
    length: float
    ends: float
    names: tuple[str, ...]
    design: F2
    sd: F1
    low: F1
    high: F1

    @property
    def turned(self) -> tuple[NDArray[np.intp], ...]:
        """All blocks in which ``root`` differs from the unit matrix."""
        return self.blocks + self.rough


def size_model(machine: Machine, terms: tuple[Term, ...], rest: tuple[str, ...], rest_sd: F1, priors: Priors) -> SizeModel:
    """Build the size model of the machine's ``terms`` and of the other unknowns ``rest`` (backlash and set-up, by name), in this order.

    Each class shares one size: positioning errors of order 2 and more, straightness errors, angles, slopes of angles, rough parts, lost
    motions, cups and so on. Data on some members thus limit the size of the others, and each error motion may differ from its
    class. How sizes fall with the order is learned for all motions together and for each. Scales and squareness errors keep their
    documented size: an error common to all scales (temperature) does not show in their differences. All numbers are bounded, so that no
    data make a size grow with the order, or beyond what machines have.
    """
    kinds = [_class(t) for t in terms] + [_setup_class(n) for n in rest]
    motion = np.array([t.motion if 2 <= t.order <= SMOOTH_ORDER else "" for t in terms] + [""] * len(rest))
    whole = np.arange(motion.size) < len(terms)
    numbers = [_Number("machine", whole.astype(np.float64), MACHINE_SIZE)] if priors.pooled else []
    numbers += _classes(kinds) + _motions(motion, np.array([t.order for t in terms] + [0] * len(rest)))
    design = np.array([n.column for n in numbers]).reshape(len(numbers), motion.size).T
    sd, low, high = np.array([n.bounds for n in numbers]).reshape(-1, 3).T
    blocks = tuple(np.flatnonzero(motion == m) for m in dict.fromkeys(motion) if m)
    rough, root = _rough_parts(machine, terms, motion.size)
    typical = np.concatenate([_reference(machine, terms, priors), rest_sd])
    names = tuple(n.name for n in numbers)
    model = SizeModel(typical, root, blocks, rough, FIRST_LENGTH, ENDS_SHARES[0], names, design, sd, low, high)
    return with_shapes(model, FIRST_LENGTH, ENDS_SHARES[0])


MACHINE_SIZE = (2.0 * np.log(5.0), -2.0 * np.log(40.0), 2.0 * np.log(5.0))
"""Hyperprior and bounds of the size of a whole machine's errors (`Priors.pooled`): from small ones of 0.3 um to those of a bad machine."""


class _Number(NamedTuple):
    """One number of psi: its column of the design; standard deviation, lower and upper bound."""

    name: str
    column: F1
    bounds: tuple[float, float, float]


def _classes(kinds: list[str]) -> list[_Number]:
    """Size of every class, with its bounds; the sizes of set-up errors and of lost motion have no lower bound."""
    high = 2.0 * np.log(LARGEST_SIZE)
    low = {k: -np.inf if k in (*LEARNED_SETUP, "backlash") else 2.0 * np.log(SMALLEST_SIZE) for k in kinds}
    bounds = {k: (2.0 * np.log(SIZE_FACTOR), low[k], high) for k in kinds}
    return [_Number(k, np.array([float(v == k) for v in kinds]), bounds[k]) for k in dict.fromkeys(kinds) if k]


def _motions(motion: NDArray[np.str_], order: NDArray[np.int64]) -> list[_Number]:
    """Size and smoothness of every motion, and the size of every order."""
    names = [str(m) for m in dict.fromkeys(motion) if m]
    bounds = (2.0 * np.log(MOTION_FACTOR), -2.0 * np.log(LARGEST_SIZE), 2.0 * np.log(LARGEST_MOTION))
    out = [_Number(m, (motion == m).astype(np.float64), bounds) for m in names]
    if not names or order[motion != ""].max() < 4:
        return out
    fall = -2.0 * np.log(np.maximum(order, 2) / 2.0)
    out += [_Number(f"smoothness {m}", fall * (motion == m), (SMOOTHNESS_SD, 0.0, np.inf)) for m in names]
    orders = range(4, int(order[motion != ""].max()) + 1)
    levels = [((order == k) & (motion != "")).astype(np.float64) for k in orders]
    return out + [_Number(f"order {k}", v, (ORDER_SD, LEAST_ORDER, LARGEST_ORDER)) for k, v in zip(orders, levels, strict=True)]


def _rough_parts(machine: Machine, terms: tuple[Term, ...], p: int) -> tuple[tuple[NDArray[np.intp], ...], F2]:
    root, motion = np.eye(p), np.array([t.motion if t.order > SMOOTH_ORDER else "" for t in terms])
    parts = tuple(np.flatnonzero(motion == m) for m in dict.fromkeys(motion) if m)
    for at in parts:
        first, last = terms[at[0]], terms[at[-1]]
        root[np.ix_(at, at)] = rough_root(first.order, last.order, ROUGH_LENGTH_MM / float(machine.length_mm[first.axis]))
    return parts, root


def with_shapes(model: SizeModel, length: float, ends: float) -> SizeModel:
    """Return the size model with another correlation length of the error motions (in strokes) and share of variance at the ends."""
    root = model.root.copy()
    for at in model.blocks:
        shapes, variance = smooth_shapes(at.size + 1, length, ends)
        root[np.ix_(at, at)] = shapes * np.sqrt(variance)
    return replace(model, root=root, length=length, ends=ends)


def _reference(machine: Machine, terms: tuple[Term, ...], p: Priors) -> F1:
    """Reference size of every term: for scales, squareness and slopes their prior; above order 1 the size of the whole motion."""
    return np.array([_sd(machine, t, p) if t.order < 2 else _bend_size(t, p) for t in terms])


def _bend_size(term: Term, p: Priors) -> float:
    """Prior standard deviation of an error motion at a point of its stroke, mm or rad."""
    if term.order > SMOOTH_ORDER:
        return p.rough_mm if term.component < 3 else p.rough_rad
    if term.component >= 3:
        return p.angle_rad
    return p.positioning_mm if term.component == term.axis else p.straightness_mm


def _class(term: Term) -> str:
    if term.order == 0:
        return ""
    if term.order > SMOOTH_ORDER:
        return "rough" if term.component < 3 else "rough angle"
    if term.component >= 3:
        return "slope" if term.order == 1 else "angle"
    if term.component == term.axis:
        return "" if term.order == 1 else "positioning"
    return "straightness"


def _setup_class(name: str) -> str:
    return next((kind for kind in (*LEARNED_SETUP, "backlash") if name.startswith(f"{kind}_")), "")
