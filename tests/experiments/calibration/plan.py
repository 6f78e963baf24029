"""The runs of plan "full" of the practice set, for any stroke: where the machine goes, when, and what the run is for.

Ball-bar: two helices on the lower half of a sphere, there and back at two feeds, circles in three planes, a second sphere; laser: step
diagonals of the volume; held-out and sealed runs at other feeds and from another place. 22 of 30 runs identify.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from tests.experiments.calibration.kinematics import F

PAUSE_S, DWELL_S, MARGIN_MM = 20.0, 4.0, 60.0
TOP = 0.997
"""A helix ends this share of the radius above its cup."""
PLANES = {"XY": (0, 1), "YZ": (1, 2), "ZX": (2, 0)}
DIAGONALS = {
    "ppp": ("identify", "identify", "sealed"),
    "npp": ("identify", "holdout", "sealed"),
    "pnp": ("identify", "identify"),
    "ppn": ("identify", "holdout"),
}


@dataclass(frozen=True)
class Step:
    """One run: commanded positions (n, 3), time of each, and what run and set-up say of themselves."""

    run: str
    test: str
    role: str
    setup: dict[str, Any]
    axes_mm: F
    t_s: F
    feed_mm_min: float
    direction: F

    @property
    def is_bar(self) -> bool:
        """Whether a ball-bar measures."""
        return self.test.startswith("ballbar")

    @property
    def sign(self) -> F:
        """Direction in which each axis last moved, shape (n, 3); the run's first motion before it."""
        moved = np.sign(np.round(np.diff(self.axes_mm, axis=0), 6))
        out = np.zeros_like(self.axes_mm)
        for a in range(3):
            at = np.flatnonzero(moved[:, a])
            if at.size:
                last = np.searchsorted(at, np.arange(len(out)) - 1, side="right") - 1
                out[:, a] = moved[at[np.maximum(last, 0)], a]
        return out


@dataclass
class _Clock:
    """Writes runs one after the other."""

    now_s: float = 600.0
    steps: list[Step] = field(default_factory=list)

    def setup(self, name: str, wait_s: float, **parts: Any) -> dict[str, Any]:
        self.now_s += wait_s
        return {"setup_id": name, "t_set_s": self.now_s, **parts}

    def bar(self, setup: dict[str, Any], role: str, feed: float, *, back: bool = False, plane: str = "") -> None:
        centre, radius = np.array(setup["centre_mm"]), float(setup["radius_mm"])
        path, length = circle(centre, radius, plane) if plane else helix(centre, radius)
        last = length / feed * 60.0
        t = self.now_s + (np.arange(len(path)) + 0.5) / len(path) * last
        extra = {"plane": plane} if plane else {"turns": 4.0}
        test = "ballbar_circle" if plane else "ballbar_helix"
        self._add(test, role, {**setup, **extra}, path[::-1] if back else path, t, feed, np.full(len(path), -1 if back else 1))
        self.now_s += last + PAUSE_S

    def there_and_back(self, setup: dict[str, Any], feed: float, plane: str = "") -> None:
        self.bar(setup, "identify", feed, plane=plane)
        self.bar(setup, "identify", feed, plane=plane, back=True)

    def diagonal(self, setup: dict[str, Any], role: str, feed: float = 3000.0) -> None:
        path = staircase(np.array(setup["start_mm"]), np.array(setup["end_mm"]), setup["steps"])
        path = np.concatenate([path, path[::-1]])
        moved = np.linalg.norm(np.diff(path, axis=0, prepend=path[:1]), axis=1)
        t = self.now_s + np.cumsum(DWELL_S + moved / feed * 60.0)
        way = np.repeat([1, -1], len(path) // 2)
        self._add("laser_diagonal", role, setup, path, t, feed, way)
        self.now_s = float(t[-1]) + PAUSE_S

    def _add(self, test: str, role: str, setup: dict[str, Any], path: F, t: F, feed: float, way: F) -> None:
        name = f"r{len(self.steps) + 1:02d}"
        self.steps.append(Step(name, test, role, setup, np.round(path, 5), np.round(t, 4), feed, way))


def full_plan(stroke_mm: F, size: float = 1.0) -> list[Step]:
    """The 30 runs on these strokes (3, 2). ``size``: share of the readings of the bar, for short tests."""
    clock, bar = _Clock(), _places(stroke_mm)
    a = clock.setup("A", 0.0, **bar["A"])
    for feed in (1000.0, 4000.0):
        clock.there_and_back(a, feed)
    b = clock.setup("B", 520.0, **bar["B"])
    for plane, feed in (("XY", 1000.0), ("XY", 4000.0), ("YZ", 2000.0), ("ZX", 2000.0)):
        clock.there_and_back(b, feed, plane)
    clock.there_and_back(clock.setup("C", 480.0, **bar["C"]), 1500.0)
    for name, roles in DIAGONALS.items():
        setup = clock.setup(f"L{name}", 600.0, **beam_along(stroke_mm, name))
        for role in roles:
            clock.diagonal(setup, role)
    d = clock.setup("D", 600.0, **bar["A"])
    clock.there_and_back(d, 1000.0)
    clock.bar(d, "holdout", 2400.0, back=True)
    clock.bar(d, "holdout", 1300.0, plane="XY")
    clock.bar(d, "sealed", 3000.0)
    clock.bar(clock.setup("E", 480.0, **bar["E"]), "sealed", 1200.0, back=True)
    return clock.steps if size >= 1.0 else [_thinned(s, size) for s in clock.steps]


def _places(stroke_mm: F) -> dict[str, dict[str, Any]]:
    """Cups and bars of 150 and 100 mm, shorter where the strokes are."""
    low, mid = stroke_mm[:, 0], stroke_mm.mean(axis=1)
    long_mm = min(150.0, *(np.round(0.5 * np.ptp(stroke_mm, axis=1)[:2] - 40.0)), np.round(0.4 * np.ptp(stroke_mm[2]) - 20.0))
    short_mm = np.round(long_mm / 1.5)
    spots = {
        "A": (mid[0], mid[1], low[2] + 80.0),
        "B": (mid[0], mid[1], low[2] + 80.0 + long_mm),
        "C": (mid[0] - 0.9 * short_mm, mid[1] + 0.4 * short_mm, low[2] + 1.5 * short_mm),
        "E": (mid[0] + 0.4 * short_mm, mid[1] - 0.4 * short_mm, low[2] + 1.1 * short_mm),
    }
    lengths = {name: float(short_mm if name in "CE" else long_mm) for name in spots}
    return {s: {"centre_mm": [float(v) for v in np.round(p, 3)], "radius_mm": lengths[s]} for s, p in spots.items()}


def _thinned(step: Step, size: float) -> Step:
    """A bar's run with a share of its readings, for short tests."""
    if not step.is_bar:
        return step
    every = slice(None, None, max(1, round(1.0 / size)))
    return Step(step.run, step.test, step.role, step.setup, step.axes_mm[every], step.t_s[every], step.feed_mm_min, step.direction[every])


def helix(centre_mm: F, radius_mm: float, n: int = 540) -> tuple[F, float]:
    """Four turns up a sphere at constant speed, from its equator nearly to its pole: n positions and the length of the path, mm."""
    f = np.linspace(0.0, 1.0, 20001)
    rise, turn = np.arcsin(TOP) * f, 8.0 * np.pi * f
    unit = np.stack([np.cos(rise) * np.cos(turn), np.cos(rise) * np.sin(turn), np.sin(rise)], axis=1)
    far = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(unit, axis=0), axis=1))])
    g = np.interp((np.arange(n) + 0.5) / n * far[-1], far, f)
    rise, turn = np.arcsin(TOP) * g, 8.0 * np.pi * g
    path = np.stack([np.cos(rise) * np.cos(turn), np.cos(rise) * np.sin(turn), np.sin(rise)], axis=1)
    return centre_mm + radius_mm * path, radius_mm * float(far[-1])


def circle(centre_mm: F, radius_mm: float, plane: str, n: int = 420) -> tuple[F, float]:
    """A whole circle in a plane: n positions and the length of the path, mm."""
    turn = 2.0 * np.pi * (np.arange(n) + 0.5) / n
    path = np.tile(centre_mm, (n, 1))
    first, second = PLANES[plane]
    path[:, first] += radius_mm * np.cos(turn)
    path[:, second] += radius_mm * np.sin(turn)
    return path, 2.0 * np.pi * radius_mm


def beam_along(stroke_mm: F, name: str, steps: int = 12) -> dict[str, Any]:
    """Set-up of a body diagonal, e.g. ``npp``: from the end of X to its start, along Y and Z."""
    ends = np.stack([stroke_mm[:, 0] + MARGIN_MM, stroke_mm[:, 1] - MARGIN_MM])
    n = np.array([c == "n" for c in name])
    start, end = np.where(n, ends[1], ends[0]), np.where(n, ends[0], ends[1])
    beam = (end - start) / np.linalg.norm(end - start)
    return {
        "diagonal": name,
        "start_mm": start.tolist(),
        "end_mm": end.tolist(),
        "increment_mm": ((end - start) / steps).tolist(),
        "steps": steps,
        "nominal_beam": beam.tolist(),
    }


def staircase(start_mm: F, end_mm: F, steps: int) -> F:
    """From start to end one axis at a time, X, Y, Z, shape (3 steps + 1, 3)."""
    k = np.arange(3 * steps + 1)
    done = np.stack([(k + 2 - a) // 3 for a in range(3)], axis=1) / steps
    return start_mm + done * (end_mm - start_mm)
