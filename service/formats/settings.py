"""Settings of an export for one machine. Every field has a usual default."""

from __future__ import annotations

from dataclasses import dataclass

from abbe.models.machine import Machine


@dataclass(frozen=True)
class FormatSettings:
    """Attributes.

    reference_mm : (x, y, z), optional
        Position at which the tables must be zero (reference point, home); None: not checked.
    decimals : int
        Decimals of millimetres. Angles have three more.
    points : int, optional
        Largest number of points of a table on this machine (Siemens MD38000, MD18342; Fanuc option); None: limit of the format.
    machine : Machine, optional
        Nominal geometry for a control with a kinematic model (ISG).
    axis_names : (str, str, str)
        Siemens machine axes of X, Y, Z.
    unit_mm, magnification, largest_step : Fanuc
        Detection unit; parameter 3623; largest number of a point (127, on old series 7).
    first_point : int
        Fanuc: number of the first point that may be used.
    counts_per_mm : float
        Centroid: encoder counts per millimetre.
    power_of_two : bool
        Heidenhain TNC 4xx: spacing is a power of two times 0.1 µm.
    """

    reference_mm: tuple[float, float, float] | None = None
    decimals: int = 6
    points: int | None = None
    machine: Machine | None = None
    axis_names: tuple[str, str, str] = ("X1", "Y1", "Z1")
    unit_mm: float = 0.001
    magnification: int = 1
    largest_step: int = 127
    first_point: int = 0
    counts_per_mm: float = 1000.0
    power_of_two: bool = False

    @property
    def step_mm(self) -> float:
        """Value of one unit in the last decimal, mm."""
        return float(10.0**-self.decimals)
