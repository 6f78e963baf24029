"""Expansion of an axis' scale and of the workpieces as the machine file states it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class AxisMaterial:
    """Section ``[material]`` of the machine file for one axis; None: not stated. Every ``u_`` is a standard uncertainty.

    ``scale_per_k``, ``laser_per_k``: expansion coefficients of the scale and of the laser's own compensation (0: off), 1/K;
    ``temperature_c``: of the scale, °C, for runs that did not record it; ``u_temperature_k``: of the recorded or stated one, K.
    ``workpiece_per_k``: expansion coefficient of the workpieces, 1/K, the same for all axes.
    """

    scale_per_k: float | None
    u_scale_per_k: float | None
    temperature_c: float | None
    u_temperature_k: float
    laser_per_k: float
    workpiece_per_k: float | None = None
    u_workpiece_per_k: float | None = None
