"""A program of a laser line with overrun on a machine that drifts, and what its laser shows: which standstill is which is known here."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from abbe.models.alignment.dwell import Dwells, PlannedDwell, merged
from abbe.models.paths import cycles_of

SETTLE_S = 0.3
SAMPLE_S = 0.05
ZERO_MM = 3.0


@dataclass(frozen=True)
class Case:
    """``planned`` and the stream. ``visits``: start, end and number of the planned standstill of each one made (-1: of none, it was
    approached from the other side). ``lost``: numbers of those that were passed without resting."""

    planned: tuple[PlannedDwell, ...]
    t_s: np.ndarray
    y_mm: np.ndarray
    visits: tuple[tuple[float, float, int], ...]
    lost: tuple[int, ...]
    words: str


def line_targets(rng: np.random.Generator, overrun_mm: float) -> list[float]:
    """Positions out and back, several cycles, with a turning point beyond either end, counted from the first."""
    n, step = int(rng.integers(4, 12)), float(rng.choice([5.0, 20.0, 60.0]))
    way = np.outer(step * np.arange(n), [1.0, 0.0, 0.0])
    places, _ = cycles_of(way, int(rng.integers(2, 6)), overrun_mm)
    return [float(x) for x in places[:, 0] - places[0, 0]]


def case(seed: int) -> Case:
    """One case, all drawn from its seed: overrun 0.05 to 1 mm, drift within 20 um/h, lost motion within 15 um, pitch errors within 150
    um/m, noise 0.3 um; in turn nothing wrong, lost dwells, doubled dwells, both."""
    rng = np.random.default_rng([seed, 20])
    overrun = float(np.exp(rng.uniform(np.log(0.05), 0.0)))
    planned = merged([PlannedDwell(x, 1.0) for x in line_targets(rng, overrun)])
    slow = float(rng.choice([1.0, 1.0, 4.0]))  # long dwells: the drift has time
    drift = rng.uniform(-20e-3, 20e-3) / 3600.0
    lost_motion, scale, wave = rng.uniform(-15e-3, 15e-3), rng.uniform(-150e-6, 150e-6), rng.uniform(0.0, 5e-3)
    length = rng.uniform(3.0, 80.0)
    inner = np.arange(1, len(planned) - 1)
    lost = set(map(int, rng.choice(inner, int(rng.integers(1, 4)), replace=False))) if seed % 4 in (1, 3) else set()
    doubled = {int(k) for k in rng.choice(inner, int(rng.integers(1, 3)), replace=False)} - lost if seed % 4 in (2, 3) else set()
    feed = float(rng.choice([5.0, 50.0, 100.0]))
    knots, now, came = [(0.0, ZERO_MM)], 0.0, 1.0
    visits: list[tuple[float, float, int]] = []

    def level(target: float) -> float:
        return ZERO_MM + target + scale * target + wave * (np.sin(target / length)) + (lost_motion if came < 0 else 0.0)

    before = planned[0].target
    for k, one in enumerate(planned):
        came = np.sign(one.target - before) or came
        for visit in range(2 if k in doubled else 1):
            if visit:  # away and back: the line of the program is there twice with a move between
                away = float(rng.choice([-1.0, 1.0])) * float(rng.uniform(0.3, 3.0))
                now += 0.3
                knots.append((now, level(one.target) + away))
                came = -np.sign(away)
                now += 0.3
                knots.append((now, level(one.target)))
            else:
                now += abs(one.target - before) / feed
                knots.append((now, level(one.target)))
            if k in lost:
                continue
            begun = now
            now += one.seconds * slow * float(rng.uniform(0.9, 1.2))
            visits.append((begun, now, k if came == (np.sign(one.target - before) or 1.0) or k == 0 else -1))
            knots.append((now, level(one.target)))
        before = one.target
    t = np.arange(0.0, now, SAMPLE_S) + rng.uniform(0.0, 0.9 * SAMPLE_S)
    y = np.interp(t, *zip(*knots, strict=True)) + drift * t + 0.3e-3 * rng.normal(size=t.size)
    planned = tuple(PlannedDwell(p.target, p.seconds * slow, p.readings) for p in planned)
    words = f"seed {seed}: overrun {overrun:.3f} mm, drift {drift * 3.6e6:.0f} um/h, lost motion {lost_motion * 1e3:.0f} um"
    return Case(planned, t, y, tuple(visits), tuple(sorted(lost)), f"{words}, lost {sorted(lost)}, doubled {sorted(doubled)}")


def wrong_readings(one: Case, found: Dwells) -> list[int]:
    """Numbers of planned standstills that were given a reading of another place, or of the right one approached from the other side."""
    out, values = [], iter(found.readings)
    way = [p.target for p in one.planned]
    side = [0.0, *np.sign(np.diff(way))]
    for k, plan in enumerate(one.planned):
        for reading in [next(values) for _ in range(plan.readings)]:
            if reading is None:
                continue
            middle = 0.5 * (reading.start_s + reading.end_s)
            true = next((j for begun, ended, j in one.visits if begun - SAMPLE_S <= middle <= ended + SAMPLE_S), -1)
            if true < 0 or way[true] != way[k] or (side[true] and side[k] and side[true] != side[k]):
                out.append(k)
    return out
