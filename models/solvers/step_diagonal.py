"""Sequential step diagonals in the paper's form (Wang eq (6)-(13); math.md 5.1 to 5.4).

`wang_eq7` is the published three-of-four formula, `wang_four` the least-squares form that uses all four diagonals. Both take the mirrors
as perfectly square to the beams; `models.solvers.joint` treats the tilts as unknowns.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from models.arrays import F1, F2, F3
from models.paths.lines import DIAGONALS

ORDER = ("ppp", "npp", "pnp", "ppn")


def increments(readings_mm: dict[str, F1], order: str = "XYZ") -> dict[str, F2]:
    """Normalised step readings q_s(a, j) of math.md 5.1, per diagonal, shape (3 axes, n intervals).

    ``readings_mm``: outward readings of each diagonal (deviation since the first record), shape (3 n + 1,), stepping in ``order``.
    q = sign of the axis x reading step, intervals counted from the axis' small end (reversed where the diagonal runs it down).
    """
    out = {}
    for name, values in readings_mm.items():
        step = np.diff(np.asarray(values, dtype=np.float64))
        if step.size % 3:
            raise ValueError(f"step diagonal {name}: {step.size + 1} records are not 3 n + 1")
        q = np.empty((3, step.size // 3))
        for k, letter in enumerate(order):
            a = "XYZ".index(letter)
            sign = DIAGONALS[name][a]
            series = sign * step[k::3]
            q[a] = series if sign > 0 else series[::-1]
        out[name] = q
    return out


def wang_eq7(q: dict[str, F2], inc_mm: F1) -> F3:
    """Displacement errors by the printed formula (7), shape (3, 3, n + 1), mm: E[i, a, k] in direction i after k steps of axis a."""
    r = float(np.linalg.norm(inc_mm))
    p = q["ppp"]
    raw = np.stack([(p - q[ORDER[i + 1]]) * r / (2 * inc_mm[i]) for i in range(3)])
    return _cumulate(raw)


def wang_four(q: dict[str, F2], inc_mm: F1) -> F3:
    """The same by least squares over all four diagonals (variance halved), shape (3, 3, n + 1), mm."""
    r = float(np.linalg.norm(inc_mm))
    signs = np.array([DIAGONALS[s] for s in ORDER], dtype=np.float64)
    raw = np.stack([sum(signs[k, i] * q[s] for k, s in enumerate(ORDER)) * r / (4 * inc_mm[i]) for i in range(3)])
    return _cumulate(raw)


def u_wang_four(inc_mm: F1, n: int, u_reading_mm: float, u_scale: float = 0.0) -> F3:
    """Standard uncertainty of `wang_four` from reading noise and wavelength alone, shape (3, 3, n + 1), mm.

    One interval: R / (2 X) sigma_q with sigma_q = sqrt(2) sigma of a reading (math.md 5.1); the intervals of an axis share no reading, so
    k of them cumulate to sqrt(k). ``u_scale``, the relative uncertainty of the laser's wavelength, lengthens only E[a, a]. Mirror tilts
    (5.4), angular errors (5.2) and drift are biases of the method and NOT in it.
    """
    r = float(np.linalg.norm(inc_mm))
    steps = np.arange(n + 1)
    out = np.empty((3, 3, n + 1))
    for i in range(3):
        noise = r / (2 * inc_mm[i]) * np.sqrt(2.0 * steps) * u_reading_mm
        out[i] = noise
        out[i, i] = np.hypot(noise, u_scale * inc_mm[i] * steps)
    return out


def closure_mm(q: dict[str, F2]) -> F2:
    """ppp - npp - pnp - ppn per axis and interval, shape (3, n): zero for pure translations, visible for mirror tilt (math.md 5.1, 5.4)."""
    return q["ppp"] - q["npp"] - q["pnp"] - q["ppn"]


@dataclass(frozen=True, slots=True)
class SquarenessContrast:
    """Obtuse-positive squareness from the diagonals' end values, free of the scale errors (math.md 5.3), rad, with uncertainties."""

    theta_xy: float
    theta_xz: float
    theta_yz: float
    u_xy: float
    u_xz: float
    u_yz: float


def squareness_contrast(totals_mm: dict[str, float], length_mm: F1, u_total_mm: float = 0.0) -> SquarenessContrast:
    """Bias-free minimum-variance contrasts instead of the printed (13), whose values carry the scale errors.

    ``totals_mm``: deviation at the end of each diagonal; ``length_mm``: travels X, Y, Z; ``u_total_mm``: their standard uncertainty.
    """
    r = float(np.linalg.norm(length_mm))
    p, n, q, s = (totals_mm[k] for k in ORDER)
    x, y, z = (float(v) for v in length_mm)
    u = u_total_mm * r / 2
    return SquarenessContrast(
        -(p - n - q + s) * r / (4 * x * y),
        -(p - n + q - s) * r / (4 * x * z),
        -(p + n - q - s) * r / (4 * y * z),
        u / (x * y),
        u / (x * z),
        u / (y * z),
    )


def _cumulate(raw: F3) -> F3:
    return np.concatenate([np.zeros((3, 3, 1)), np.cumsum(raw, axis=2)], axis=2)
