"""A spindle that stands still on several days while ambient and motor heat it: three sensors a minute, and the displacement in um."""

from dataclasses import dataclass

import numpy as np

LAG_MIN = 30.0
AT_ONCE_UM_K, SETTLED_UM_K = np.array([0.0, 3.0, -2.0]), np.array([2.0, 6.0, -2.0])
"""Of ambient, spindle and bed."""


@dataclass(frozen=True)
class Day:
    """``t_s`` (n,), ``temperatures_c`` (n, 3), ``displacement_um`` (n,) since the first reading."""

    t_s: np.ndarray
    temperatures_c: np.ndarray
    displacement_um: np.ndarray


def heated_days(count=9, seed=1, minutes=200, noise_um=0.3, shifted=(), shift_um=0.0):
    """Days of a machine that begins each day in equilibrium; on the days ``shifted`` something else moves it soon after the start."""
    rng = np.random.default_rng(seed)
    out, begin = [], 0.0
    for day in range(count):
        t = np.arange(minutes, dtype=float)
        start = 20.0 + rng.normal(0.0, 2.0)
        ambient = start + rng.normal(4.0, 1.5) * np.sin(np.pi * t / rng.uniform(350, 500)) + 0.3 * np.sin(t / rng.uniform(9, 15))
        spindle = start + 1.0 + rng.uniform(6, 14) * -np.expm1(-t / rng.uniform(40, 70))
        bed = start + rng.uniform(3, 6) * -np.expm1(-t / rng.uniform(90, 160))
        temperatures = np.round(np.column_stack([ambient, spindle, bed]), 2)
        lagged = temperatures.copy()
        for k in range(1, minutes):  # d lagged / dt = (sensor - lagged) / lag, by Heun's rule
            slope = (temperatures[k - 1] - lagged[k - 1]) / LAG_MIN
            lagged[k] = lagged[k - 1] + 0.5 * (slope + (temperatures[k] - lagged[k - 1] - slope) / LAG_MIN)
        move = temperatures @ AT_ONCE_UM_K + lagged @ (SETTLED_UM_K - AT_ONCE_UM_K)
        move += shift_um * (day in shifted) * -np.expm1(-t / 3.0)
        move += rng.normal(0.0, noise_um, minutes) + 0.05 * np.cumsum(rng.normal(size=minutes))
        out.append(Day(begin + 60.0 * t, temperatures, move - move[0]))
        begin += 60.0 * minutes + 60.0
    return out
