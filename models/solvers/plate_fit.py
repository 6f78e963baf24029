"""Plain fit of one workpiece that a CMM measured: offset, rotation, scales, squareness, and rotation growing with r^2, each with its U.

One plate alone does not separate the machine from the part: the fit shows the sum of their errors. The uncertainty comes from a jackknife
over sectors about the plate's centre, because neighbouring holes have similar errors, and from CMM and temperature (JCGM 100; jackknife of
groups: Tukey 1958).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.solvers.observations import RunData

SECTORS = 8
COVERAGE = 2.0
WARM_K = 0.3
"""Standard uncertainty of the temperature of part and scales."""
CLEAR = 1.5
"""A quantity is reported as present if it exceeds this multiple of its expanded uncertainty."""
NAMES = ("EXX", "EYY", "C0Y", "swirl")


@dataclass(frozen=True)
class PlateFit:
    """Fit of a plate of ``holes`` points.

    ``offset_mm`` (2,), ``rotation_rad``: position of the plate as a CMM prints it (measured minus nominal). ``value``: quantities `NAMES`,
    that is, two scales (m/m), squareness (rad, positive: obtuse) and swirl (mm at the farthest hole, ``reach_mm`` from the centre);
    ``expanded``: their expanded uncertainties. ``rms_mm``: rms residual of one component.
    """

    label: str
    holes: int
    offset_mm: F1
    rotation_rad: float
    value: F1
    expanded: F1
    reach_mm: float
    rms_mm: float

    @property
    def verdict(self) -> str:
        """Deviations of the plate beyond a rigid motion."""
        there = np.abs(self.value) > CLEAR * self.expanded
        if there[3]:
            return (
                "unknown: one plate cannot show whether the rotation growing with r² belongs to the part or to the machine "
                "(yaw, straightness); measure a second plate made elsewhere on the table"
            )
        if there.any():
            return f"{', '.join(n for n, t in zip(NAMES, there, strict=True) if t)} of machine and part together"
        return "none: nothing beyond offset and rotation is larger than its uncertainty"

    @property
    def text(self) -> str:
        """One line for people."""
        said = zip(("EXX", "EYY", "C0Y"), self.value * 1e6, self.expanded * 1e6, ("µm/m", "µm/m", "µrad"), strict=False)
        return (
            f"plate {self.label}, {self.holes} holes, alone: offset ({self.offset_mm[0]:.3f}, {self.offset_mm[1]:.3f}) mm, "
            f"rotation {np.degrees(self.rotation_rad):.3f}°, {', '.join(f'{n} {v:+.0f} ± {u:.0f} {unit}' for n, v, u, unit in said)}, "
            f"rotation growing with r² {self.value[3] * 1e3:+.0f} ± {self.expanded[3] * 1e3:.0f} µm at {self.reach_mm:.0f} mm, "
            f"{self.rms_mm * 1e3:.1f} µm rms left: {self.verdict}"
        )


def plate_fit(run: RunData) -> PlateFit | None:
    """Fit the holes of a workpiece in its plane; None for a probed artefact or fewer than 12 holes found in both directions."""
    p = run.points
    if p is None or p.source != "cmm" or p.normal[:, 0].all():
        return None
    both = [{f: i for i, (f, c) in enumerate(zip(p.feature, p.component, strict=True)) if c == k} for k in (0, 1)]
    names = [f for f in both[0] if f in both[1]]
    if len(names) < 12:
        return None
    rows = np.array([[column[f] for f in names] for column in both])
    nominal, deviation = p.nominal_mm[rows[0], :2], run.deviation_mm[rows].T
    away = nominal - nominal.mean(axis=0)
    reach = float(np.linalg.norm(away, axis=1).max())
    q = away / reach
    whole, left = _fitted(nominal, deviation, q)
    sector = ((np.arctan2(away[:, 1], away[:, 0]) + np.pi) / (2.0 * np.pi) * SECTORS).astype(np.int64) % SECTORS
    parts = np.array([_fitted(nominal[sector != s], deviation[sector != s], q[sector != s])[0] for s in np.unique(sector)])
    spread = (len(parts) - 1) / len(parts) * ((parts - parts.mean(axis=0)) ** 2).sum(axis=0)
    warm = p.expansion_per_K * WARM_K
    stated = np.array([np.hypot(p.u_cmm_scale, warm)] * 2 + [p.u_cmm_scale, 0.0])
    u = np.sqrt(spread[3:] + stated**2)
    return PlateFit(
        run.label, len(names), whole[:2], float(whole[2]), whole[3:], COVERAGE * u, reach, float(np.sqrt(np.mean(left**2)))
    )  # fmt: skip


def _fitted(nominal: F2, deviation: F2, q: F2) -> tuple[F1, F2]:
    """Offset (2), rotation, EXX, EYY, C0Y of a plain affine fit, with the swirl of a second fit, and the residuals of the first, (n, 2).

    ``q``: places from the centre, 1 at the farthest hole.
    """
    affine = np.column_stack([np.ones(len(nominal)), nominal])
    c = np.linalg.lstsq(affine, deviation, rcond=None)[0]
    (exx, eyx), (exy, eyy) = c[1:]
    left = deviation - affine @ c
    swirl = np.stack([-q[:, 1], q[:, 0]], axis=1) * (q**2).sum(axis=1, keepdims=True)
    free = swirl - affine @ np.linalg.lstsq(affine, swirl, rcond=None)[0]
    return np.array([*c[0], 0.5 * (eyx - exy), exx, eyy, -(exy + eyx), float((free * left).sum() / (free**2).sum())]), left
