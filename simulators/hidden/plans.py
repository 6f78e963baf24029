"""Measuring plans: runs with their order, feeds and places, and with the clock of a whole day at the machine."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from abbe.simulators.arrays import F
from abbe.simulators.hidden.track import RUN_IN_MM, Track, dense_times, history

PLANS = ("full", "one_way", "one_feed", "one_radius", "ballbar", "laser", "minimal")
HELIX_N, CIRCLE_N, TURNS, TILT = 540, 420, 4.0, 0.95
POWER_ON_S, PAUSE_S, NEW_CUP_S, NEW_MOUNT_S, DWELL_S = 600.0, 20.0, 480.0, 600.0, 4.0
EDGE_MM, STEPS, RAPID = 60.0, 12, 3000.0
PLANES = {"XY": (0, 1), "YZ": (1, 2), "ZX": (2, 0)}


@dataclass(frozen=True)
class Run:
    """One run: ``test``, ``role`` and ``setup`` as in its abbe-run/1 file, and its track."""

    run_id: str
    test: str
    role: str
    setup: dict[str, object]
    direction: F
    feed: float
    track: Track


@dataclass(frozen=True)
class Machinery:
    """Facts of the machine for a plan: strokes (3,) mm, vertical axis, and direction of each axis' last motion (``rest``, +-1)."""

    low_mm: F
    high_mm: F
    vertical: int
    rest: F

    @property
    def middle_x(self) -> float:
        """Middle of the X stroke, mm, where the set-ups are."""
        return float(0.5 * (self.low_mm[0] + self.high_mm[0]))


@dataclass
class _Clock:
    """The runs planned so far, and the time after them."""

    machine: Machinery
    t_s: float = POWER_ON_S
    set_s: float = POWER_ON_S
    last: str = ""
    runs: list[Run] = field(default_factory=list)

    def mount(self, kind: str, *, later: bool = False) -> None:
        if self.last:
            self.t_s += NEW_CUP_S if self.last == kind == "bar" and not later else NEW_MOUNT_S
        elif kind == "laser":
            self.t_s += 300.0
        self.set_s, self.last = self.t_s, kind

    def later(self) -> None:
        """Set up the cup again after a break."""
        self.mount("bar", later=True)

    def bar(self, setup: dict[str, object], shape: str, role: str, feed: float, direction: int) -> None:
        track, setup = bar_track(self, setup, shape, feed, direction)
        test = "ballbar_helix" if shape == "helix" else "ballbar_circle"
        self._done(Run(f"r{len(self.runs) + 1:02d}", test, role, setup, np.full(track.n, float(direction)), feed, track))

    def laser(self, diagonal: str, role: str) -> None:
        track, setup, direction = laser_track(self, diagonal)
        self._done(Run(f"r{len(self.runs) + 1:02d}", "laser_diagonal", role, setup, direction, RAPID, track))

    def _done(self, run: Run) -> None:
        self.runs.append(run)
        self.t_s = float(run.track.t_s[-1]) + PAUSE_S


def runs_of(plan: str, machine: Machinery) -> list[Run]:
    """Return all runs of a plan, in order."""
    clock = _Clock(machine)
    for do, *what in _orders(plan, machine.middle_x):
        getattr(clock, str(do))(*what)
    return clock.runs


def _orders(plan: str, x: float) -> Iterator[tuple[object, ...]]:
    both = (1,) if plan in ("one_way", "minimal") else (1, -1)
    one = plan == "one_feed"
    a: dict[str, object] = {"setup_id": "A", "centre_mm": [x, 250.0, 80.0], "radius_mm": 150.0}
    b: dict[str, object] = {"setup_id": "B", "centre_mm": [x, 250.0, 230.0], "radius_mm": 150.0}
    radius = 150.0 if plan in ("one_radius", "minimal") else 100.0
    c: dict[str, object] = {"setup_id": "C", "centre_mm": [x - 90.0, 290.0, 150.0], "radius_mm": radius}
    d, e = {**a, "setup_id": "D"}, {"setup_id": "E", "centre_mm": [x + 40.0, 210.0, 110.0], "radius_mm": radius}
    if plan != "laser":
        yield ("mount", "bar")
        for feed in (2000.0,) if one or plan == "minimal" else (1000.0, 4000.0):
            yield from (("bar", a, "helix", "identify", feed, way) for way in both)
    if plan not in ("laser", "minimal"):
        yield ("mount", "bar")
        for plane, feeds in (("XY", (2000.0,) if one else (1000.0, 4000.0)), ("YZ", (2000.0,)), ("ZX", (2000.0,))):
            yield from (("bar", b, plane, "identify", feed, way) for feed in feeds for way in both)
        yield ("mount", "bar")
        yield from (("bar", c, "helix", "identify", 2000.0 if one else 1500.0, way) for way in both)
    if plan not in ("ballbar", "minimal"):
        for diagonal, roles in (("ppp", "iis"), ("npp", "ihs"), ("pnp", "ii"), ("ppn", "ih")):
            yield ("mount", "laser")
            yield from (("laser", diagonal, {"i": "identify", "h": "holdout", "s": "sealed"}[r]) for r in roles)
    if plan != "laser":
        last = (2000.0, 1200.0, 2600.0, 1500.0, 2400.0) if one or plan == "minimal" else (1000.0, 2400.0, 1300.0, 3000.0, 1200.0)
        yield ("later",)
        yield from (("bar", d, "helix", "identify", last[0], way) for way in both)
        yield ("bar", d, "helix", "holdout", last[1], both[-1])
        yield ("bar", d, "XY", "holdout", last[2], 1)
        yield ("bar", d, "helix", "sealed", last[3], 1)
        yield ("mount", "bar")
        yield ("bar", e, "helix", "sealed", last[4], both[-1])


def shape_points(shape: str, part: F) -> F:
    """Return points of a helix over the upper half sphere or of a circle, radius 1, (n, 3); ``part``: 0 to 1 and slightly beyond."""
    if shape == "helix":
        around, up = 2.0 * np.pi * TURNS * part, TILT * 0.5 * np.pi * part
        return np.stack([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)], axis=1)
    out = np.zeros((len(part), 3))
    first, second = PLANES[shape]
    out[:, first], out[:, second] = np.cos(2.0 * np.pi * part), np.sin(2.0 * np.pi * part)
    return out


def bar_track(clock: _Clock, setup: dict[str, object], shape: str, feed: float, direction: int) -> tuple[Track, dict[str, object]]:
    """Return the track and set-up of a ball-bar run at constant feed, sampled evenly."""
    n = HELIX_N if shape == "helix" else CIRCLE_N
    radius, centre = float(str(setup["radius_mm"])), np.array(setup["centre_mm"], dtype=np.float64)
    fine = np.linspace(-0.1, 1.1, 60001)
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(shape_points(shape, fine), axis=0), axis=1))])
    way = (way - np.interp(0.0, fine, way)) * radius
    length = float(np.interp(1.0, fine, way))
    start, speed = clock.t_s, feed / 60.0

    def course(t_s: F) -> F:
        along = (t_s - start) * speed
        part = np.interp(along if direction > 0 else length - along, way, fine)
        return np.asarray(centre + radius * shape_points(shape, part))

    t = start + (np.arange(n) + 0.5) * length / n / speed
    q, tiny = course(t), 0.02
    ahead, behind = course(t + tiny), course(t - tiny)
    track = Track(
        "bar", str(setup["setup_id"]), q, t, (ahead - behind) / (2.0 * tiny), (ahead + behind - 2.0 * q) / tiny**2,
        q * 0.0, q * 0.0, q * 0.0, (q - centre) / radius, np.zeros(n), start, clock.set_s,
        clock.machine.low_mm, clock.machine.high_mm, clock.machine.vertical, feed, len(clock.runs), radius, course,
    )  # fmt: skip
    more: dict[str, object] = {"turns": TURNS} if shape == "helix" else {"plane": shape}
    times, at = dense_times(track)
    return _remembering(track, course(times), at, clock.machine.rest), {
        "setup_id": setup["setup_id"], "t_set_s": clock.set_s, "centre_mm": setup["centre_mm"], "radius_mm": radius, **more,
    }  # fmt: skip


def laser_track(clock: _Clock, diagonal: str) -> tuple[Track, dict[str, object], F]:
    """Return track, set-up and directions of a diagonal: out in steps X, Y, Z, back in steps Z, Y, X, with a dwell after every move."""
    ways = np.array([1.0 if s == "p" else -1.0 for s in diagonal])
    low, high = clock.machine.low_mm + EDGE_MM, clock.machine.high_mm - EDGE_MM
    start, step = np.where(ways > 0, low, high), ways * (high - low) / STEPS
    out = [start]
    for k in range(3 * STEPS):
        out.append(out[-1] + step * (np.arange(3) == k % 3))
    q = np.array([*out, *reversed(out)])
    moves = np.abs(np.diff(q, axis=0)).sum(axis=1)
    t = clock.t_s + np.concatenate([[DWELL_S], DWELL_S + np.cumsum(moves / (RAPID / 60.0) + DWELL_S)])
    beam = (high - low) * ways / np.linalg.norm(high - low)
    n = len(q)
    lead = q[0] - RUN_IN_MM * ways
    track = Track(
        "laser", f"L{diagonal}", q, t, q * 0.0, q * 0.0, q * 0.0, q * 0.0, q * 0.0, np.tile(beam, (n, 1)), (q - q[0]) @ beam,
        clock.t_s, clock.set_s, clock.machine.low_mm, clock.machine.high_mm, clock.machine.vertical, RAPID, len(clock.runs),
    )  # fmt: skip
    setup: dict[str, object] = {
        "setup_id": f"L{diagonal}", "t_set_s": clock.set_s, "diagonal": diagonal, "start_mm": start.tolist(),
        "end_mm": (start + STEPS * step).tolist(), "increment_mm": step.tolist(), "steps": STEPS, "nominal_beam": beam.tolist(),
    }  # fmt: skip
    direction = np.where(np.arange(n) <= 3 * STEPS, 1.0, -1.0)
    return _remembering(track, np.vstack([lead, q]), np.arange(1, n + 1), clock.machine.rest), setup, direction


def _remembering(track: Track, dense_mm: F, at: np.ndarray, rest: F) -> Track:
    h = history(dense_mm, at, rest)
    return replace(track, sign=h.sign, since_mm=h.since_mm, travelled_mm=h.travelled_mm)


def standing(track: Track, centre_mm: F) -> Track:
    """Return the track of a single instant: when the cup was placed at the spindle."""
    zero, one = np.zeros((1, 3)), np.array([track.set_s])
    return Track(
        "bar", track.setup, centre_mm[None], one, zero, zero, zero, zero + 1e9, zero, zero, np.zeros(1), track.set_s, track.set_s,
        track.low_mm, track.high_mm, track.vertical, track.feed_mm_min, -1, track.radius_mm,
    )  # fmt: skip
