"""What a campaign can use: bars, laser, their noise, and how many minutes each set-up takes a person."""

from __future__ import annotations

from dataclasses import dataclass, field

from abbe.models.solvers.priors import U_WAVELENGTH
from abbe.models.uncertainty.inputs import StatedInputs

BAR_LENGTHS_MM = (50.0, 100.0, 150.0, 200.0, 250.0, 300.0)
"""Bars that exist as a bar with extensions."""


@dataclass(frozen=True, slots=True)
class SetupMinutes:
    """How long a person needs for each set-up, minutes: typical figures, to be replaced by one's own.

    Attributes
    ----------
    cup : put up cup and bar at a new centre.
    bar : hang another bar in at the same cup. Another direction with the same bar takes no set-up at all.
    line : align the laser along an edge.
    diagonal : align laser and flat mirror along a body diagonal. Another step order on the same mirror takes no set-up at all.
    """

    cup: float = 3.0
    bar: float = 1.5
    line: float = 5.0
    diagonal: float = 8.0

    def __post_init__(self) -> None:
        """Refuse negative times."""
        if not all(0 <= v < float("inf") for v in (self.cup, self.bar, self.line, self.diagonal)):
            raise ValueError("set-up minutes: every time must be 0 or more")


@dataclass(frozen=True, slots=True)
class Instruments:
    """What there is to measure with, and how well it reads.

    Attributes
    ----------
    bar_lengths_mm : tuple of float
        Nominal lengths of the ball-bars at hand; empty: no ball-bar.
    laser : bool
        Whether there is a laser with a flat mirror.
    bar_noise_mm, laser_noise_mm : float
        Standard deviation of one reading.
    floor_mm : float
        Smallest uncertainty of an averaged value: what smooth error functions do not follow (as in the joint solution).
    u_bar_length_mm : float
        Standard uncertainty of each bar's calibrated length.
    u_wavelength : float
        Relative standard uncertainty of the laser's wavelength, common to all laser runs.
    setup : SetupMinutes
        How long set-ups take.
    max_feed_mm_min : float
        Fastest feed of any measurement on the machine.
    inputs : StatedInputs
        How well temperatures of bars and scales are known; default: as in the budget of a solution.
    """

    bar_lengths_mm: tuple[float, ...] = BAR_LENGTHS_MM
    laser: bool = True
    bar_noise_mm: float = 0.5e-3
    laser_noise_mm: float = 0.3e-3
    floor_mm: float = 0.3e-3
    u_bar_length_mm: float = 2e-3
    u_wavelength: float = U_WAVELENGTH
    setup: SetupMinutes = field(default_factory=SetupMinutes)
    max_feed_mm_min: float = 6000.0
    inputs: StatedInputs = field(default_factory=StatedInputs)

    def __post_init__(self) -> None:
        """Refuse what no instrument has, in one line."""
        noise = (self.bar_noise_mm, self.laser_noise_mm)
        sizes = (*self.bar_lengths_mm, *noise, self.u_bar_length_mm, self.u_wavelength, self.max_feed_mm_min)
        if not all(0 < v < float("inf") for v in sizes) or not 0 <= self.floor_mm < float("inf"):
            raise ValueError("instruments: lengths, noise, uncertainties and feed must be positive numbers")
        if not self.bar_lengths_mm and not self.laser:
            raise ValueError("instruments: neither a ball-bar nor a laser")
