"""Reduction of positioning deviations to 20 °C: correction of the nominal differential expansion (NDE) of scale and laser.

ISO 230-2 (2014, clause 4.1, Environment) requires results as if everything were at 20 °C, the reference temperature of ISO 1: results at
another temperature are corrected for the nominal differential expansion between the axis' measuring system and the test equipment. The
uncertainty follows ISO/TR 16015: temperature and coefficients are independent contributions.

Convention. Displacements and deviations grow with the axis coordinate; deviation = displacement read - displacement commanded. At t °C a
scale of coefficient a moves the axis by (1 + a (t - 20)) for each commanded mm. A laser reads true length, so its coefficient is 0. If its
own compensation of material expansion is on, the laser has already taken off b (t_L - 20) for each mm; b is its coefficient, t_L the
reading of its own sensor of material temperature. Let the scale be at T, t = T + e and t_L = T + e_L. The measurement contains a (T - 20) -
b (T + e_L - 20), the correction removes (a - b) (T + e - 20), and -(a - b) e - b e_L remains. The errors e and e_L are independent and
have the same u(t).

A workpiece of coefficient w has the temperature of the scale when it is made, and shrinks when it cools down: for dimensions at 20 °C of
such parts, w (t - 20) is taken off in place of a (t - 20). Along a diagonal every axis counts with the square of its share of the
direction.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from abbe.models.evaluation.iso230_2 import Approaches

REFERENCE_C = 20.0
"""Reference temperature of length, ISO 1."""


class Strain(Protocol):
    """Thermal part of deviations along a line, mm per mm of travel, and its standard uncertainties (`Expansion`)."""

    @property
    def strain(self) -> float:
        """The thermal part."""
        ...

    @property
    def u_as_measured(self) -> float:
        """Standard uncertainty of the thermal part, at exactly the stated temperature."""
        ...

    @property
    def u_reduced(self) -> float:
        """Standard uncertainty of the reduction."""
        ...


@dataclass(frozen=True, slots=True)
class Expansion:
    """Expansion of one axis' scale against the laser during a test. Every ``u_`` is a standard uncertainty.

    ``scale_per_k``: expansion coefficient of the scale, or of the screw of an axis without a scale, 1/K; ``temperature_c``: temperature of
    this scale or screw, °C (``u_temperature_k`` in K); ``laser_per_k``: coefficient of the laser's own material compensation, 1/K (0: off).
    """

    scale_per_k: float
    u_scale_per_k: float
    temperature_c: float
    u_temperature_k: float
    laser_per_k: float = 0.0

    def __post_init__(self) -> None:
        """Refuse values that are not numbers.

        Raises
        ------
        ValueError
            A value is not finite, or an uncertainty is negative.
        """
        for name in self.__slots__:
            value = getattr(self, name)
            if not np.isfinite(value) or (name.startswith("u_") and value < 0.0):
                raise ValueError(f"reduction to 20 °C: {name} is {value}, expected a finite number" + ", 0 or more" * name.startswith("u_"))

    @property
    def rise_k(self) -> float:
        """Temperature above 20 °C, K; negative below."""
        return self.temperature_c - REFERENCE_C

    @property
    def strain(self) -> float:
        """Thermal part of the deviation, mm per mm of travel: (scale - laser) (t - 20); positive: the axis goes too far."""
        return (self.scale_per_k - self.laser_per_k) * self.rise_k

    @property
    def u_as_measured(self) -> float:
        """Standard uncertainty of the deviation as measured at exactly ``temperature_c``, mm per mm.

        u² = ((scale - laser) u(t))² + (laser u(t))²: error of ``temperature_c``, and of the laser's compensation by its own sensor.
        """
        return float(np.hypot(self.scale_per_k - self.laser_per_k, self.laser_per_k)) * self.u_temperature_k

    @property
    def u_reduced(self) -> float:
        """Standard uncertainty of the reduction, mm per mm of travel (ISO/TR 16015, first order).

        u² = ((scale - laser) u(t))² + (laser u(t))² + ((t - 20) u(scale))². The laser's coefficient is a set number and has no u.
        """
        return float(np.hypot(self.u_as_measured, self.rise_k * self.u_scale_per_k))


@dataclass(frozen=True, slots=True)
class DiagonalExpansion:
    """Expansion along a diagonal: the sum over its axes, each weighted by its squared direction cosine.

    ``axes``: expansion of each axis; ``shares``: the weights, in the same order, which sum to 1. One laser measures all axes. Errors of
    the scales' temperatures are independent; errors of their coefficients add up, since scales of one make have one coefficient.
    """

    axes: tuple[Expansion, ...]
    shares: tuple[float, ...]

    @property
    def strain(self) -> float:
        """Thermal part of the deviation, mm per mm of travel along the diagonal."""
        return sum(share * one.strain for one, share in zip(self.axes, self.shares, strict=True))

    @property
    def u_as_measured(self) -> float:
        """Standard uncertainty of the deviation as measured, mm per mm, from each scale's temperature and the laser's own sensor."""
        scales = [
            share * (one.scale_per_k - one.laser_per_k) * one.u_temperature_k for one, share in zip(self.axes, self.shares, strict=True)
        ]
        return float(np.linalg.norm([*scales, max(one.laser_per_k * one.u_temperature_k for one in self.axes)]))

    @property
    def u_reduced(self) -> float:
        """Standard uncertainty of the reduction, mm per mm of travel along the diagonal (ISO/TR 16015, first order)."""
        coefficients = sum(share * abs(one.rise_k) * one.u_scale_per_k for one, share in zip(self.axes, self.shares, strict=True))
        return float(np.hypot(self.u_as_measured, coefficients))


def reduced(readings: Approaches, expansion: Strain) -> Approaches:
    """Return the same approaches with deviations as at 20 °C.

    Deviation at 20 °C = deviation as measured - (scale - laser) (t - 20) (position - first position). Both directions and all cycles of a
    position change by the same amount, so that reversal and repeatability stay; the first position is the zero of the correction.

    Parameters
    ----------
    readings : Approaches
        Deviations as measured, mm.
    expansion : Strain
        Strain of the axis or diagonal; each scale has one temperature during the whole test.
    """
    taken_off = (expansion.strain * (readings.position_mm - readings.position_mm[0]))[:, None]
    return replace(readings, forward_mm=readings.forward_mm - taken_off, backward_mm=readings.backward_mm - taken_off)
