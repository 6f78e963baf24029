"""Geometry of the translational 3-PUU parallel machine, nominal or with an error of its own on every leg."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from abbe.models.arrays import F1, F2, F3

LEGS = 3
THIRDS = np.array([0.0, 2.0 * np.pi / 3.0, 4.0 * np.pi / 3.0])
PER_LEG = ("R", "r", "l", "thb", "thp", "dz")
"""Parameters that may differ from leg to leg, in the letters of math.md 6."""
FIELDS = {"R": "R_mm", "r": "r_mm", "l": "l_mm", "thb": "theta_b_rad", "thp": "theta_p_rad", "dz": "dz_mm"}
COMMON = ("l_up_mm", "l_dw_mm", "theta_rad", "le_mm")


def _zeros() -> F1:
    return np.zeros(LEGS)


@dataclass(frozen=True)
class Geometry:
    """Three linear drives on a base, three links of constant length, a platform that only translates (Kwon 2004, 2.1, Fig. 2).

    Base frame: origin in the base plane at the middle of the drives, z up, drive 1 along +x. A drive moves its joint by ``lambda`` TOWARDS
    the origin. Values of one leg may be given as one number for all legs.

    Parameters
    ----------
    R_mm, r_mm, l_mm : float or array, shape (3,)
        Base radius at lambda = 0, platform radius, link length between its joints.
    l_up_mm, l_dw_mm, theta_rad : float
        Lengths of the upper and lower joint brackets and their constant elevation (theta_up = theta_dw).
    le_mm : float
        Ball centre above the platform.
    theta_b_rad, theta_p_rad : array, shape (3,)
        Directions of the drives and of the platform's corners about z; 0, 120, 240 degrees when not given.
    dz_mm : float or array, shape (3,)
        Base joint above the base plane, + up.

    Raises
    ------
    ValueError
        A value is not finite, a shape does not fit, or a length that must be positive is not.
    """

    R_mm: F1
    r_mm: F1
    l_mm: F1
    l_up_mm: float
    l_dw_mm: float
    theta_rad: float
    le_mm: float
    theta_b_rad: F1 = field(default_factory=THIRDS.copy)
    theta_p_rad: F1 = field(default_factory=THIRDS.copy)
    dz_mm: F1 = field(default_factory=_zeros)

    def __post_init__(self) -> None:
        """Spread single numbers over the legs and check once."""
        for name in FIELDS.values():
            value = np.asarray(getattr(self, name), dtype=np.float64)
            if value.shape not in ((), (LEGS,)):
                raise ValueError(f"geometry: {name} must be one finite number or one for each of the 3 legs, got shape {value.shape}")
            if not np.isfinite(value).all():
                raise ValueError(f"geometry: {name} must be finite")
            object.__setattr__(self, name, np.broadcast_to(value, (LEGS,)).copy())
        for name in COMMON:
            value = np.asarray(getattr(self, name), dtype=np.float64)
            if value.shape != () or not np.isfinite(value):
                raise ValueError(f"geometry: {name} must be one finite number for all legs, got shape {value.shape} or a value not finite")
        if (self.R_mm <= 0).any() or (self.r_mm <= 0).any() or (self.l_mm <= 0).any():
            raise ValueError("geometry: R_mm, r_mm and l_mm must be positive")

    @property
    def r_hat_mm(self) -> F1:
        """Eq (7) for every leg: platform centre to upper joint in plan, shape (3,)."""
        value: F1 = self.r_mm + self.l_up_mm * np.cos(self.theta_rad)
        return value

    @property
    def reach_mm(self) -> F1:
        """R - l_dw cos(theta): eq (8) at lambda = 0, shape (3,)."""
        value: F1 = self.R_mm - self.l_dw_mm * np.cos(self.theta_rad)
        return value

    @property
    def lift_mm(self) -> F1:
        """(l_up + l_dw) sin(theta) + l_e + dz: height of the sphere centres, shape (3,)."""
        value: F1 = (self.l_up_mm + self.l_dw_mm) * np.sin(self.theta_rad) + self.le_mm + self.dz_mm
        return value

    @property
    def rails(self) -> F2:
        """Unit vectors outwards along the rails, shape (3 legs, 3)."""
        return _in_plan(self.theta_b_rad)

    @property
    def corners(self) -> F2:
        """Unit vectors from the platform centre to its corners, shape (3 legs, 3)."""
        return _in_plan(self.theta_p_rad)

    def centres_mm(self, lambda_mm: F2) -> F3:
        """Centres (-A, -B, lift) of the spheres on which the ball centre lies, shape (n, 3 legs, 3); (5), (6) of Kwon.

        Parameters
        ----------
        lambda_mm : array, shape (n, 3)
        """
        lambda_hat = self.reach_mm - lambda_mm
        centres: F3 = lambda_hat[..., None] * self.rails - self.r_hat_mm[:, None] * self.corners
        centres[..., 2] = self.lift_mm
        return centres

    def with_errors(self, errors: dict[str, F1]) -> Geometry:
        """Same machine with deviations (actual - nominal) added.

        Parameters
        ----------
        errors : dict
            From names of PER_LEG to one number or shape (3,), mm or rad.

        Raises
        ------
        ValueError
            A name is not one of PER_LEG.
        """
        unknown = [name for name in errors if name not in FIELDS]
        if unknown:
            raise ValueError(f"geometry: no parameter is called {unknown[0]!r}; known are {', '.join(PER_LEG)}")
        return replace(self, **{FIELDS[name]: getattr(self, FIELDS[name]) + np.asarray(value) for name, value in errors.items()})


def poses(name: str, value: F2) -> F2:
    """Finite float64 array of shape (n, 3).

    Raises
    ------
    ValueError
        It has another shape or holds something that is not finite.
    """
    array = np.asarray(value, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != LEGS:
        raise ValueError(f"{name}: expected numbers of shape (n, 3), got shape {array.shape}")
    bad = np.flatnonzero(~np.isfinite(array).all(axis=1))
    if bad.size:
        more = f" and {bad.size - 1} more" if bad.size > 1 else ""
        raise ValueError(f"{name}: row {bad[0]}{more}: every number must be finite")
    return array


def _in_plan(angle_rad: F1) -> F2:
    return np.stack([np.cos(angle_rad), np.sin(angle_rad), np.zeros(LEGS)], axis=1)
