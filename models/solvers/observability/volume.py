"""Uncertainty of the deviation at every point of the volume, and one number for the whole campaign.

All figures concern the deviation without its best-fit rigid motion over the inner 80 % of the strokes, because the workpiece's position is
no property of the machine. Every point has three standard deviations: of a typical machine (prior), after the runs (posterior), and per
micrometre of reading noise (noise gain).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from abbe.models.arrays import F1, F2, F3
from abbe.models.geometry.bases import Term
from abbe.models.geometry.chain import design
from abbe.models.geometry.volume import rigid_design, volume_grid
from abbe.models.machine import Machine

INNER = 0.8
NODES = 11
"""Nodes per axis over the strokes; those at 0.1 to 0.9 of a stroke form the inner 80 %."""
USABLE, GOOD = 3.0, 10.0
"""Bounds of the observability number (`observability_number`)."""


@dataclass(frozen=True)
class Knowing:
    """Covariances of the error motions' coefficients in their own units, shape (p, p).

    ``prior``: of a typical machine; ``posterior``: after the runs; ``noise``: the part of the posterior that comes from reading
    noise, divided by the mean square of that noise, mm^2.
    """

    prior: F2
    posterior: F2
    noise: F2


@dataclass(frozen=True)
class Volume:
    """Figures at points of the volume, rigid motion removed.

    Attributes
    ----------
    axes_mm : array, shape (n, 3)
    prior_mm, u_mm : array, shape (n,)
        Rms length of a typical machine's deviation; rms length of the difference between truth and prediction (root sum of squares of the
        components' standard uncertainties).
    worst_mm : array, shape (n,)
        Standard uncertainty in the direction in which it is largest.
    gain : array, shape (n,)
        Micrometres of predicted deviation (root of the sum of squares) per micrometre of reading noise.
    inner : array of bool, shape (n,)
        Inside the inner 80 % of every stroke.
    """

    axes_mm: F2
    prior_mm: F1
    u_mm: F1
    worst_mm: F1
    gain: F1
    inner: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]

    @property
    def worst_point(self) -> int:
        """Row with the largest uncertainty."""
        return int(np.argmax(self.u_mm))


@dataclass(frozen=True)
class Plane:
    """Figures on one plane of the volume; arrays of ``volume`` reshape to (second_mm.size, first_mm.size).

    ``first``, ``second``, ``fixed``: index of the axis across, up and normal to the plane, which lies at ``fixed_mm``.
    """

    first: int
    second: int
    fixed: int
    fixed_mm: float
    first_mm: F1
    second_mm: F1
    volume: Volume


@dataclass(frozen=True)
class Number:
    """The observability number: the factor by which these runs can reduce the volumetric error of a typical machine.

    ``value``: largest rms deviation in the inner 80 % before correction (``before_mm``) over the largest after it (``after_mm``, at
    ``worst_place_mm``); ``median``: the same with medians; ``verdict``: ``"good"``, ``"usable with care"`` or ``"mostly assumption"``;
    ``text``: a sentence.
    """

    value: float
    median: float
    before_mm: float
    after_mm: float
    worst_place_mm: F1
    verdict: str
    text: str


def inner_box(machine: Machine) -> F2:
    """The inner 80 % of every stroke, shape (3, 2), mm."""
    edge = 0.5 * (1.0 - INNER) * machine.length_mm[:, None] * np.array([1.0, -1.0])
    return np.asarray(machine.stroke_mm + edge)


def frame_free_design(machine: Machine, terms: tuple[Term, ...], axes_mm: F2, reference_mm: F2) -> F3:
    """Deviation per unit of every coefficient with the best-fit rigid motion over ``reference_mm`` removed, shape (n, 3, p)."""
    at_reference = design(machine, terms, reference_mm).reshape(-1, len(terms))
    centre = reference_mm.mean(axis=0)
    rigid = scipy.linalg.lstsq(rigid_design(reference_mm).reshape(-1, 6), at_reference, check_finite=False)[0]
    motion = _rigid_about(axes_mm, centre)
    return np.asarray(design(machine, terms, axes_mm) - motion @ rigid)


def _rigid_about(points_mm: F2, centre_mm: F1) -> F3:
    """Do the same as `abbe.models.geometry.volume.rigid_design`, about a given centre instead of the mean of the points."""
    out = np.zeros((points_mm.shape[0], 3, 6))
    out[:, :, :3] = np.eye(3)
    for k in range(3):
        out[:, :, 3 + k] = np.cross(np.eye(3)[k], points_mm - centre_mm)
    return out


def volume_at(machine: Machine, terms: tuple[Term, ...], knowing: Knowing, axes_mm: F2) -> Volume:
    """Prior size, uncertainty and noise gain of the deviation at commanded positions (n, 3), with the machine's own tool.

    Parameters
    ----------
    knowing : Knowing
    axes_mm : array, shape (n, 3)
        Commanded positions, mm.
    """
    box = inner_box(machine)
    field = frame_free_design(machine, terms, axes_mm, volume_grid(box, 7))
    prior, posterior, noise = (_point_covariance(field, c) for c in (knowing.prior, knowing.posterior, knowing.noise))
    slack = 1e-9 * machine.length_mm
    inner = np.all((axes_mm >= box[:, 0] - slack) & (axes_mm <= box[:, 1] + slack), axis=1)
    largest = np.linalg.eigvalsh(posterior)[:, -1]
    return Volume(axes_mm, _length(prior), _length(posterior), np.sqrt(np.maximum(largest, 0.0)), _length(noise), inner)


def plane_at(machine: Machine, terms: tuple[Term, ...], knowing: Knowing, fixed: int, nodes: int) -> Plane:
    """`volume_at` over the plane through the middle of the stroke of axis ``fixed``, over the whole strokes of the other two."""
    first, second = (a for a in range(3) if a != fixed)
    x, y = (np.linspace(machine.stroke_mm[a, 0], machine.stroke_mm[a, 1], nodes) for a in (first, second))
    points = np.empty((nodes * nodes, 3))
    points[:, first], points[:, second], points[:, fixed] = np.tile(x, nodes), np.repeat(y, nodes), machine.centre_mm[fixed]
    return Plane(first, second, fixed, float(machine.centre_mm[fixed]), x, y, volume_at(machine, terms, knowing, points))


def whole_volume(machine: Machine, terms: tuple[Term, ...], knowing: Knowing) -> Volume:
    """`volume_at` on a grid of 11 nodes per axis over the strokes, x slowest."""
    return volume_at(machine, terms, knowing, volume_grid(machine.stroke_mm, NODES))


def _point_covariance(field: F3, covariance: F2) -> F3:
    """Covariance of the deviation at every point, shape (n, 3, 3)."""
    return np.asarray(np.einsum("nip,njp->nij", (field.reshape(-1, field.shape[2]) @ covariance).reshape(field.shape), field))


def _length(covariance: F3) -> F1:
    return np.asarray(np.sqrt(np.maximum(np.trace(covariance, axis1=1, axis2=2), 0.0)))


def observability_number(volume: Volume) -> Number:
    """Factor by which a correction from these runs can at best reduce the largest error of a typical machine.

    It is the largest prior size divided by the largest remaining uncertainty in the inner 80 %, both without rigid motion. (A ratio at each
    point would be lowest in the middle of the volume, where the fitted rigid motion leaves little error.) At 10, a machine with 30 um of
    volumetric error can be brought to 3 um at best; without runs the number is 1. Below 3, more than a tenth of a typical machine's
    variance (1/3^2) stays unknown: a correction would be mostly assumption. From 10 on, at most a hundredth stays unknown, and
    repeatability and temperature dominate. The number does not include errors above the model's order and changes with time.
    """
    prior, u = volume.prior_mm[volume.inner], np.maximum(volume.u_mm[volume.inner], 1e-12)
    k = int(np.argmax(u))
    value, median, worst_place_mm = float(prior.max() / u[k]), float(np.median(prior) / np.median(u)), volume.axes_mm[volume.inner][k]
    verdict = "good" if value >= GOOD else "usable with care" if value >= USABLE else "mostly assumption"
    place = ", ".join(f"{v:.0f}" for v in worst_place_mm)
    sizes = f"from {prior.max() * 1e3:.2g} µm to {u[k] * 1e3:.2g} µm at ({place}) mm"
    text = (
        f"Observability {value:.1f} ({verdict}): at the worst place of the inner 80 % of the volume, a correction from these runs makes "
        f"the error of a typical machine at best {value:.1f} times smaller ({sizes}), {median:.1f} times at the median. Below {USABLE:g} "
        f"the result is mostly assumption, from {GOOD:g} on it is good."
    )
    return Number(value, median, float(prior.max()), float(u[k]), worst_place_mm, verdict, text)
