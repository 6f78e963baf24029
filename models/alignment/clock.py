"""Device time to host time by a robust fit with drift. Arrival times are never taken for sample times: they only say when at the latest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from abbe.models.alignment.envelope import LOWEST, lower_envelope
from abbe.models.arrays import F1

LEAST_PAIRS = 2 * LOWEST + 2
EARLY = 3.0
"""A single arrival that lies below the line of all others by more than this many times the 24th least delay is no arrival: a stamp is
wrong."""
MOST_EARLY = 3


@dataclass(frozen=True, slots=True)
class ClockFit:
    """One clock in terms of another: ``host = host_s0 + rate (device - device_s0)``, least delay taken off.

    ``u_offset_s`` and ``u_rate`` are standard uncertainties at ``device_s0``, the middle of what was fitted, and of the rate; ``u_delay_s``
    that of the least delay, which no arrival tells. ``early``: arrivals that were left out because they came before they could.
    """

    device_s0: float
    host_s0: float
    rate: float
    u_offset_s: float
    u_rate: float
    u_delay_s: float
    pairs: int
    early: int = 0

    @property
    def drift_ppm(self) -> float:
        """How much faster than the host the device's clock runs."""
        return (1.0 / self.rate - 1.0) * 1e6

    @property
    def u_drift_ppm(self) -> float:
        """Standard uncertainty of the drift."""
        return self.u_rate / self.rate**2 * 1e6

    def host_s(self, device_s: F1) -> F1:
        """Host time at which the device's clock showed ``device_s``."""
        return np.asarray(self.host_s0 + self.rate * (np.asarray(device_s, dtype=np.float64) - self.device_s0))

    def u_host_s(self, device_s: F1) -> F1:
        """Standard uncertainty of that."""
        away = self.u_rate * (np.asarray(device_s, dtype=np.float64) - self.device_s0)
        return np.sqrt(self.u_offset_s**2 + self.u_delay_s**2 + away**2)

    def device_s(self, host_s: F1) -> F1:
        """What the device's clock showed at a host time."""
        return np.asarray(self.device_s0 + (np.asarray(host_s, dtype=np.float64) - self.host_s0) / self.rate)


def fit_clock(device_s: F1, arrived_s: F1, *, least_delay_s: float = 0.0, u_delay_s: float = 0.0, grid_s: float = 0.0) -> ClockFit:
    """Fit host time over device time to pairs of stamp and arrival.

    Delays are never negative and have a long tail (adapters collect bytes for 16 ms, the operating system adds spikes), so the fit is the
    line under all arrivals, not through their middle (Moon, Skelly, Towsley 1999; here with its bias and uncertainty from the least
    delays).

    Parameters
    ----------
    device_s, arrived_s : array, shape (n,)
        Device time of a sample (of one that arrived together with others, the newest says most), and monotonic host time of its arrival.
        50 pairs or more, of one segment: no reboot, no step in between (`abbe.models.alignment.breaks`).
    least_delay_s, u_delay_s : float
        Shortest delay that the link has by itself, and its standard uncertainty: no arrival tells it.
    grid_s : float
        Where an adapter collects bytes for a time that keeps step with the samples, delays come on a grid of this width (the greatest
        common divisor of both periods): the arrivals alone do not tell a drift that is slow against it. Uncertainties are not below what it
        leaves open (0.6 of it over the span; for the offset an even chance between none and all of it).

    Raises
    ------
    ValueError
        Too few pairs, device time not rising, or numbers that are none.
    """
    x, y = np.asarray(device_s, dtype=np.float64), np.asarray(arrived_s, dtype=np.float64)
    if x.size < LEAST_PAIRS:
        raise ValueError(f"clock: {x.size} pairs of stamp and arrival, at least {LEAST_PAIRS} are needed")
    early = 0
    found = lower_envelope(x, y)
    while early < MOST_EARLY and x.size > LEAST_PAIRS:
        worst = _too_early(x, y, found.lowest)
        if worst is None:
            break
        x, y, early = np.delete(x, worst), np.delete(y, worst), early + 1
        found = lower_envelope(x, y)
    if not found.slope > 0.0:
        raise ValueError("clock: the host's time does not grow with the device's")
    level = found.level - least_delay_s
    u_level = float(np.hypot(found.u_level, grid_s / np.sqrt(3.0)))
    u_slope = float(np.hypot(found.u_slope, 0.6 * grid_s / found.span))
    return ClockFit(found.middle, level, found.slope, u_level, u_slope, u_delay_s, x.size, early)


def _too_early(x: F1, y: F1, lowest: tuple[int, int]) -> int | None:
    """The one of the two points under the line that the others do not explain."""
    for k in lowest:
        rest_x, rest_y = np.delete(x, k), np.delete(y, k)
        line = lower_envelope(rest_x, rest_y)
        above = rest_y - line.level - line.slope * (rest_x - line.middle)
        top = float(np.partition(above, LOWEST)[LOWEST])
        below = line.level + line.slope * (x[k] - line.middle) - y[k]
        if below > EARLY * max(top, 1e-9) and below > 1e-5:
            return k
    return None


def across(device: ClockFit, other: ClockFit, device_s: F1) -> tuple[F1, F1]:
    """A device's time in the time of another one's clock, by way of the host, with its standard uncertainty."""
    host = device.host_s(device_s)
    there = other.device_s(host)
    u = np.sqrt(device.u_host_s(device_s) ** 2 + other.u_host_s(there) ** 2) / other.rate
    return there, u


def relative_rate(device: ClockFit, other: ClockFit) -> tuple[float, float]:
    """Seconds of the other clock per second of the device's, and the standard uncertainty."""
    rate = device.rate / other.rate
    return rate, rate * float(np.hypot(device.u_rate / device.rate, other.u_rate / other.rate))
