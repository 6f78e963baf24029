"""Temperature sensors: every axis, the spindle and the air warm up, whether or not they do harm."""

import numpy as np

from abbe.simulators.arrays import F
from abbe.simulators.hidden.effect import Hidden
from abbe.simulators.hidden.instrument import air_rise
from abbe.simulators.hidden.thermal import rise, warmth

ROOM_C = 20.0
SENSORS = ("x", "y", "z", "spindle", "air")


def temperatures(effects: tuple[Hidden, ...], seed: int, t_s: F) -> dict[str, F]:
    """What the sensors at the axes, the spindle and in the air really have, degree C, (n,) each: everything warms up, guilty or not."""
    rng = np.random.default_rng([44, seed])
    out: dict[str, F] = {}
    for i, name in enumerate(SENSORS[:4]):
        size = rng.uniform(2.0, 12.0) if name == "spindle" else rng.uniform(0.5, 4.0)
        tau = rng.uniform(1200.0, 7200.0)
        guilty = next((e for e in effects if e.name == "axis_thermal_growth" and e.axis == i), None)
        idle = size * warmth(t_s, tau)
        out[name] = ROOM_C + (idle if guilty is None else guilty["strength"] * rise(guilty, t_s) + 0.15 * idle)
    swing, period, phase = rng.uniform(0.2, 1.5), rng.uniform(5000.0, 14000.0), rng.uniform(0.0, 2.0 * np.pi)
    air = next((e for e in effects if e.name == "air_refraction"), None)
    out["air"] = ROOM_C + (swing * np.sin(2.0 * np.pi * t_s / period + phase) if air is None else air_rise(air, t_s))
    return out
