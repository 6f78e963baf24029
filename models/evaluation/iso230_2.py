"""ISO 230-2: accuracy and repeatability of positioning of a linear axis, from approaches of the same positions from both sides.

Index i counts positions (1 to m), j cycles (1 to n); single approaches may be missing. The standard uncertainties follow ISO/TR 230-9: the
scatter of the cycles and the contributions of instrument and temperature are propagated through each figure's own formula. The closed
formulas of ISO 230-2's annex are not used, because they hold for five cycles.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from abbe.models.arrays import F1, F2

CYCLES = 5
POSITIONS = 5
"""ISO 230-2 asks for five cycles and five positions per metre, and for five positions on a shorter axis."""


@dataclass(frozen=True, slots=True)
class Approaches:
    """Readings at the positions of one axis (or of a diagonal).

    ``position_mm``: shape (m,), growing; ``forward_mm`` and ``backward_mm``: deviations (m, n), NaN where an approach is missing.
    """

    position_mm: F1
    forward_mm: F2
    backward_mm: F2

    def __post_init__(self) -> None:
        """Check positions and shapes.

        Raises
        ------
        ValueError
            Fewer than two positions, positions that do not grow, unequal shapes, or a position without a reading from one side.
        """
        m = self.position_mm.size
        if m < 2 or not (np.diff(self.position_mm) > 0.0).all():
            raise ValueError(f"ISO 230-2: {m} positions; two or more are needed, in growing order")
        if self.forward_mm.shape != self.backward_mm.shape or self.forward_mm.ndim != 2 or self.forward_mm.shape[0] != m:
            raise ValueError(f"ISO 230-2: {m} positions, but readings of shape {self.forward_mm.shape} and {self.backward_mm.shape}")
        for name, values in (("+", self.forward_mm), ("-", self.backward_mm)):
            lost = np.flatnonzero(~np.isfinite(values).any(axis=1))
            if lost.size:
                raise ValueError(f"ISO 230-2: no reading at position {self.position_mm[lost[0]]:g} mm approached in {name} direction")


@dataclass(frozen=True, slots=True)
class ScaleBudget:
    """Standard uncertainties that the repeats do not show.

    ``slope``: uncertainty of a common slope of all deviations, mm per mm (wavelength, temperature and expansion of the scales). Each figure
    is evaluated again with the deviations tilted by this slope, so that a flat axis has this uncertainty, too. ``reading_mm``: uncertainty
    of the mean at each position, independent from position to position (resolution, drift of the environment).
    """

    slope: float = 0.0
    reading_mm: float = 0.0


@dataclass(frozen=True, slots=True)
class Value:
    """A figure and its standard uncertainty, mm."""

    value_mm: float
    u_mm: float


@dataclass(frozen=True, slots=True)
class Positioning:
    """All figures of ISO 230-2 of a bidirectional test, mm. Arrays have the shape (m,). None: not known, because one cycle has no scatter.

    ``mean_forward_mm``, ``mean_backward_mm``, ``mean_mm``: mean deviations; ``reversal_mm``: B_i; ``s_forward_mm``, ``s_backward_mm``:
    standard deviations of the approaches. ``lowest``, ``most``: fewest and most approaches of a position from one side. All other
    names are the standard's symbols.
    """

    position_mm: F1
    mean_forward_mm: F1
    mean_backward_mm: F1
    mean_mm: F1
    reversal_mm: F1
    s_forward_mm: F1 | None
    s_backward_mm: F1 | None
    B: Value
    B_mean: Value
    E_forward: Value
    E_backward: Value
    E: Value
    M: Value
    R_forward: Value | None
    R_backward: Value | None
    R: Value | None
    A_forward: Value | None
    A_backward: Value | None
    A: Value | None
    lowest: int
    most: int

    def departures(self) -> tuple[str, ...]:
        """Return a sentence for each departure of the test from ISO 230-2."""
        m = self.position_mm.size
        travel = float(np.ptp(self.position_mm))
        needed = max(POSITIONS, int(np.ceil(POSITIONS * travel * 1e-3 - 1e-9)))
        out = []
        if m < needed:
            out.append(f"{m} positions over {travel:.0f} mm; ISO 230-2 asks for {needed} or more")
        if self.lowest < CYCLES:
            count = "one cycle" if self.lowest == 1 else f"{self.lowest} cycles"
            out.append(f"{count}; ISO 230-2 asks for {CYCLES}" + ("; without repeats there is no R and no A" if self.lowest == 1 else ""))
        return tuple(out)


@dataclass(frozen=True, slots=True)
class _Side:
    """Mean, standard deviation and number of the approaches in one direction, shape (m,) each."""

    x: F1
    s: F1
    n: F1


def positioning(readings: Approaches, budget: ScaleBudget | None = None) -> Positioning:
    """Evaluate a bidirectional positioning test.

    E = max(all mean deviations of both directions) - min(the same); R = max over positions of max(2 s+ + 2 s- + |B_i|, 4 s+, 4 s-);
    A = max(mean + 2 s) - min(mean - 2 s) over both directions; M = range of the bidirectional means; B = max |B_i|.

    Parameters
    ----------
    readings : Approaches
    budget : ScaleBudget, optional
        Without it the uncertainties contain only the scatter of the cycles. For a single cycle they use the scatter of the reversals B_i
        about their mean instead, which is too large where lost motion changes along the axis.
    """
    budget = budget or ScaleBudget()
    fwd, bwd = _side(readings.forward_mm), _side(readings.backward_mm)
    lowest = int(min(fwd.n.min(), bwd.n.min()))
    p, scattered = readings.position_mm, lowest > 1
    mean, b = (fwd.x + bwd.x) / 2.0, fwd.x - bwd.x
    u_fwd, u_bwd = (np.hypot(_of_mean(side, b), budget.reading_mm) for side in (fwd, bwd))
    u_b = np.hypot(u_fwd, u_bwd)
    at, both = np.concatenate([p, p]), np.concatenate([fwd.x, bwd.x])
    k = int(np.argmax(np.abs(b)))
    return Positioning(
        p,
        fwd.x,
        bwd.x,
        mean,
        b,
        fwd.s if scattered else None,
        bwd.s if scattered else None,
        Value(float(abs(b[k])), float(u_b[k])),
        Value(float(b.mean()), float(np.sqrt(np.sum(u_b**2)) / p.size)),
        _range(p, fwd.x, fwd.x, u_fwd, budget),
        _range(p, bwd.x, bwd.x, u_bwd, budget),
        _range(at, both, both, np.concatenate([u_fwd, u_bwd]), budget),
        _range(p, mean, mean, u_b / 2.0, budget),
        _repeatability(fwd) if scattered else None,
        _repeatability(bwd) if scattered else None,
        _bidirectional_repeatability(fwd, bwd, b, u_b) if scattered else None,
        _accuracy(p, (fwd,), u_fwd, budget) if scattered else None,
        _accuracy(p, (bwd,), u_bwd, budget) if scattered else None,
        _accuracy(at, (fwd, bwd), np.concatenate([u_fwd, u_bwd]), budget) if scattered else None,
        lowest,
        int(max(fwd.n.max(), bwd.n.max())),
    )


def _side(values: F2) -> _Side:
    n = np.isfinite(values).sum(axis=1).astype(np.float64)
    x = np.nansum(values, axis=1) / n
    left = np.where(np.isfinite(values), values - x[:, None], 0.0)
    return _Side(x, np.sqrt(np.sum(left**2, axis=1) / np.maximum(n - 1.0, 1.0)), n)


def _of_mean(side: _Side, reversal: F1) -> F1:
    """Standard uncertainty of the means; for single readings from the scatter of the reversals, which are differences of two readings."""
    from_reversal = float(np.std(reversal, ddof=1)) / np.sqrt(2.0)
    return np.where(side.n > 1.0, side.s / np.sqrt(side.n), from_reversal)


def _of_s(side: _Side) -> F1:
    """Standard uncertainty of an estimated standard deviation (normal readings)."""
    return np.asarray(side.s / np.sqrt(2.0 * np.maximum(side.n - 1.0, 1.0)))


def _range(at: F1, upper: F1, lower: F1, u: F1, budget: ScaleBudget) -> Value:
    """Return max(upper) - min(lower) with its uncertainty, from ``u`` at both extremes and the uncertainty of the slope."""
    hi, lo = int(np.argmax(upper)), int(np.argmin(lower))
    apart = float(np.hypot(u[hi], u[lo])) if hi != lo else 0.0
    return Value(float(upper[hi] - lower[lo]), float(np.hypot(apart, _tilt(at, upper, lower, budget))))


def _tilt(at: F1, upper: F1, lower: F1, budget: ScaleBudget) -> float:
    """Return the largest change of max(upper) - min(lower) if all deviations tilt by plus or minus the slope's uncertainty."""
    along = budget.slope * (at - at.min())
    plain = np.max(upper) - np.min(lower)
    return max(float(abs(np.max(upper + t) - np.min(lower + t) - plain)) for t in (along, -along))


def _accuracy(at: F1, sides: tuple[_Side, ...], u: F1, budget: ScaleBudget) -> Value:
    x, s, u_s = (np.concatenate(v) for v in zip(*((side.x, side.s, _of_s(side)) for side in sides), strict=True))
    hi, lo = int(np.argmax(x + 2.0 * s)), int(np.argmin(x - 2.0 * s))
    value = _range(at, x + 2.0 * s, x - 2.0 * s, np.hypot(u, 2.0 * u_s), budget)
    # If one position decides both ends, its mean cancels and its scatter counts twice.
    if hi != lo:
        return value
    return Value(value.value_mm, float(np.hypot(4.0 * u_s[hi], _tilt(at, x + 2.0 * s, x - 2.0 * s, budget))))


def _repeatability(side: _Side) -> Value:
    k = int(np.argmax(side.s))
    return Value(float(4.0 * side.s[k]), float(4.0 * _of_s(side)[k]))


def _bidirectional_repeatability(fwd: _Side, bwd: _Side, b: F1, u_b: F1) -> Value:
    joint = 2.0 * fwd.s + 2.0 * bwd.s + np.abs(b)
    u_joint = np.sqrt((2.0 * _of_s(fwd)) ** 2 + (2.0 * _of_s(bwd)) ** 2 + u_b**2)
    ways = np.stack([joint, 4.0 * fwd.s, 4.0 * bwd.s])
    us = np.stack([u_joint, 4.0 * _of_s(fwd), 4.0 * _of_s(bwd)])
    k = int(np.argmax(ways))
    return Value(float(ways.ravel()[k]), float(us.ravel()[k]))
