"""Additions to a campaign as runs to be simulated, and the blind spots of a campaign that found nothing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.discovery.answer import BlindSpot, NextTest
from abbe.models.discovery.case import Case, CaseRun
from abbe.models.effects.path import Path, Places, at_rest, driven
from abbe.models.machine import AXES, Machine
from abbe.models.paths import DIAGONALS, diagonal_ends, step_diagonal, straight_line

BAR_MIN, LASER_MIN, LINE_MIN, TOOL_MIN, WAIT_MIN, LENGTH_MIN = 10.0, 25.0, 20.0, 15.0, 120.0, 10.0
"""Minutes to set up: ball-bar; laser on one diagonal; laser or angular interferometer on one axis; another tool; the wait before a late
repeat; a length standard. Shop practice as makers of ball-bars and lasers state it, rounded."""
RUN_MIN = 1.0
POSITION_S = 4.5
"""Time that a laser needs per position: move, dwell, read."""
READINGS = 120
MARGIN = 0.05
LONGER_TOOL_MM = 100.0
ARM_MM = 100.0
"""Distance of the two beams of an angular measurement."""
LATE_S = 3.0 * 3600.0
GAP_S = 900.0
FEED_MM_MIN = 1500.0
SHORTEST_BAR_MM = 10.0
"""Length of the shortest ball-bar."""
OTHER_FEED = 1.3
"""Feeds that differ by a smaller factor count as one: feed-dependent effects then change too little to differ from geometry."""
REPEAT_LATE_S = 3600.0
"""A repeat counts as late after this time: axes and spindle warm up within 20 minutes to two hours."""
SAME_MM = 2.0
"""Two paths are the same if their extents agree within this along every axis. Single positions depend on the feed and are not compared."""
SAME_LOOK = 0.01
"""Beams are parallel if their unit vectors differ by less than this in every component."""
GROWS = "errors that grow with the feed (lag, servo mismatch, vibration of the drives) look like geometry"
TURNS = "errors that differ between the two directions along a path (lost motion, lateral play) look like geometry"
LENGTH = "errors of the bar (its length, its balls, its temperature) look like errors of the machine"
SLOW = "slow changes (axes, spindle and air that warm up) look like geometry or like errors of the set-up"
SCALE = "only the bar's calibrated length shows an error common to all scales, and the search does not use the bar's certificate"
MOVING = "errors that occur only in motion on a curve (reversals of two axes, servo mismatch, lag) leave no trace"


@dataclass(frozen=True)
class ExperimentOffer:
    """A possible addition to a campaign: its name (``adds``), the runs to simulate, the minutes for them, and a description (``why``).

    ``subtracted``: runs of an angular interferometer's second beam, whose readings are subtracted from those of ``runs``.
    ``knows_length``: whether the addition makes the bar's length known.
    """

    adds: str
    runs: tuple[CaseRun, ...]
    minutes: float
    why: str
    subtracted: tuple[CaseRun, ...] = ()
    knows_length: bool = False

    @property
    def special(self) -> bool:
        """Whether the addition needs more than a ball-bar, a linear laser and the present tool."""
        return self.adds in ("angular_interferometer", "second_tool_length", "reference_length")


def offers(case: Case) -> tuple[ExperimentOffer, ...]:
    """Return every addition that the identify runs lack."""
    runs = [r.path for r in case.of("identify")]
    bars, lasers = [p for p in runs if p.kind == "bar"], [p for p in runs if p.kind == "laser"]
    if not runs:
        return ()
    start = max(float(r.path.at.t_s[-1]) for r in case.runs) + GAP_S
    out: list[ExperimentOffer] = []
    if bars:
        out += _bar_variants(bars, start)
    else:
        out += _ballbar(runs[0], start)
    if not any(p.test == "laser_diagonal" for p in lasers):
        out.append(_diagonals(runs[0], start))
    if not any(p.test == "laser_linear" for p in lasers):
        found = tuple(_line(runs[0], a, start + a * 3000.0, f"next_line_{AXES[a]}") for a in range(3))
        out.append(ExperimentOffer("single_axis_laser", found, 3 * LINE_MIN + _minutes(found), "a laser along each axis alone"))
    out += [_angles(runs[0], start), _late(bars or lasers, start)]
    if len({tuple(np.round(p.machine.tool_mm)) for p in runs}) < 2:
        out.append(_second_tool(bars or lasers, start))
    if bars and not any(r.length_calibrated for r in case.of("identify")):
        out.append(ExperimentOffer("reference_length", (), LENGTH_MIN, "the bar's length against a standard", knows_length=True))
    return tuple(out)


def judging_run(case: Case) -> NextTest | None:
    """Return a holdout run in the other direction, to prove a name; None if the campaign has a holdout run already, or no ball-bar run."""
    bars = [r.path for r in case.of("identify") if r.path.kind == "bar"]
    if case.of("holdout") or not bars:
        return None
    minutes = BAR_MIN + RUN_MIN + float(np.ptp(bars[0].at.t_s)) / 60.0
    why = "this campaign has no holdout run: measure the path of its first helix the other way round"
    return NextTest(("judging_run",), (), None, minutes, why)


def one_feed(bars: list[Path]) -> bool:
    """Whether the ball-bar runs (at least one) all have the same feed."""
    feeds = [float(np.round(np.median(p.feed_mm_min))) for p in bars]
    return max(feeds) < OTHER_FEED * min(feeds)


def one_way(bars: list[Path]) -> bool:
    """Whether all ball-bar runs go in the same direction."""
    return len({float(np.sign(p.direction[0])) for p in bars}) < 2


def one_radius(bars: list[Path]) -> bool:
    """Whether all ball-bar runs have the same radius."""
    return len({round(p.radius_mm) for p in bars}) < 2


def _minutes(runs: tuple[CaseRun, ...]) -> float:
    return sum(float(np.ptp(r.path.at.t_s)) / 60.0 + RUN_MIN for r in runs)


def _bar_variants(bars: list[Path], start: float) -> list[ExperimentOffer]:
    out, first = [], bars[0]
    feeds = {float(np.round(np.median(p.feed_mm_min))) for p in bars}
    if one_feed(bars):
        other = max(feeds) * (0.4 if max(feeds) > 1500.0 else 2.5)
        both = _with_back(first, bars, lambda q, t, label: _bar(first, q, other, t, label), start, "next_feed")
        out.append(ExperimentOffer("second_feed", both, BAR_MIN + _minutes(both), f"the same path at {other:.0f} mm/min"))
    if one_way(bars):
        again = (_bar(first, first.at.q_mm[::-1], min(feeds), start, "next_back"),)
        out.append(ExperimentOffer("opposite_direction", again, BAR_MIN + _minutes(again), "the same path the other way round"))
    if one_radius(bars):
        radius = first.radius_mm * (2.0 / 3.0 if first.radius_mm > 100.0 else 1.5)
        if _fits(first.machine, first.centre_mm, radius):
            shape = (first.at.q_mm - first.centre_mm) * (radius / first.radius_mm) + first.centre_mm
            both = _with_back(first, bars, lambda q, t, label: _bar(first, q, max(feeds), t, label), start, "next_radius", shape)
            out.append(ExperimentOffer("second_radius", both, BAR_MIN + _minutes(both), f"the same path with a bar of {radius:.0f} mm"))
    if not any(p.test == "ballbar_circle" for p in bars):
        found = _circles(first, start, max(feeds))
        if found:
            out.append(ExperimentOffer("planar_circles", found, BAR_MIN + _minutes(found), "circles in planes of two axes, both ways"))
    return out


def _with_back(
    like: Path, bars: list[Path], make: Callable[[F2, float, str], CaseRun], start: float, label: str, q_mm: F2 | None = None
) -> tuple[CaseRun, ...]:
    """Return a run along a path and, if the campaign has both directions, a run back along this path."""
    q = like.at.q_mm if q_mm is None else q_mm
    out = [make(q, start, label)]
    if not one_way(bars):
        out.append(
            replace(
                make(q[::-1], start + 300.0, f"{label}_back"), path=_same_setup(make(q[::-1], start + 300.0, f"{label}_back").path, out[0])
            )
        )
    return tuple(out)


def _same_setup(path: Path, first: CaseRun) -> Path:
    return replace(path, setup=first.path.setup, t_set_s=first.path.t_set_s, reference=first.path.reference)


def _fits(machine: Machine, centre_mm: F1, radius_mm: float) -> bool:
    """Whether a circle of this radius fits into the strokes of at least two axes."""
    room = np.minimum(centre_mm - machine.stroke_mm[:, 0], machine.stroke_mm[:, 1] - centre_mm)
    return bool(np.sum(room >= radius_mm) >= 2)


def _bar(like: Path, q_mm: F2, feed_mm_min: float, t_set_s: float, label: str, centre_mm: F1 | None = None) -> CaseRun:
    """Return a ball-bar run over some of the given positions (about `READINGS`), in a separate set-up."""
    q = q_mm[:: max(len(q_mm) // READINGS, 1)]
    centre = like.centre_mm if centre_mm is None else centre_mm
    way = np.linalg.norm(np.diff(q, axis=0, prepend=q[:1]), axis=1).cumsum()
    t = t_set_s + 5.0 + way / (feed_mm_min / 60.0) + 1e-3 * np.arange(len(q))
    feed = np.full(len(q), feed_mm_min)
    at = driven(q, t, feed, dwelling=False, temp_c={})
    away = q - centre
    length = np.linalg.norm(away, axis=1, keepdims=True)
    path = Path(
        label, f"~{label}", "ballbar_helix", "bar", like.machine, like.vertical, at, at_rest(centre, t_set_s, {}), away / length, feed,
        np.ones(len(q)), np.zeros(len(q)), t_set_s, 0.0, float(np.median(length)), centre,
    )  # fmt: skip
    return _run(path)


def _run(path: Path) -> CaseRun:
    return CaseRun(path, "identify", np.zeros(path.n), np.ones(path.n, dtype=bool))


def _circles(like: Path, start: float, feed: float) -> tuple[CaseRun, ...]:
    """Circles about the middle of the strokes, in both directions, in each plane in which they fit."""
    centre = like.machine.centre_mm
    out: list[CaseRun] = []
    radius = like.radius_mm if like.kind == "bar" else min(150.0, float(np.floor(0.45 * like.machine.length_mm.min())))
    angle = np.linspace(0.0, 2.0 * np.pi, READINGS)
    for k, (a, b) in enumerate(((0, 1), (1, 2), (2, 0))):
        if radius < SHORTEST_BAR_MM or radius > 0.48 * min(like.machine.length_mm[a], like.machine.length_mm[b]):
            continue
        q = np.tile(centre, (len(angle), 1))
        q[:, a] += radius * np.cos(angle)
        q[:, b] += radius * np.sin(angle)
        for back in (False, True):
            t = start + 120.0 * (2 * k + back)
            run = _bar(like, q[::-1] if back else q, feed, t, f"next_circle_{k}{'b' if back else ''}", centre)
            path = replace(run.path, test="ballbar_circle")
            out.append(replace(run, path=_same_setup(path, out[0]) if out else path))
    return tuple(out)


def _ballbar(like: Path, start: float) -> list[ExperimentOffer]:
    """Ball-bar circles in three planes at two feeds; empty if the strokes have no room for a bar."""
    runs = _circles(like, start, 2.0 * FEED_MM_MIN) + tuple(
        replace(r, path=replace(r.path, label=f"{r.path.label}_slow", setup=f"{r.path.setup}_slow"))
        for r in _circles(like, start + 1500.0, FEED_MM_MIN)
    )
    return (
        [ExperimentOffer("ballbar", runs, BAR_MIN + _minutes(runs), "a ball-bar in three planes at two feeds, both ways")] if runs else []
    )


def _laser(like: Path, q_mm: F2, beam: F1, start: float, label: str, test: str) -> CaseRun:
    n = len(q_mm)
    t: F1 = start + 5.0 + POSITION_S * np.arange(n, dtype=np.float64)
    feed, half = np.full(n, 3000.0), np.where(np.arange(n) < n // 2, 1.0, -1.0)
    at = driven(q_mm, t, feed, dwelling=True, temp_c={})
    first = Places(q_mm[:1], at.sign[:1], at.since_mm[:1], at.v_mm_s[:1], at.a_mm_s2[:1], t[:1], {})
    dead = like.dead_path_mm if like.dead_path_mm > 0 else 500.0
    path = Path(
        label, f"~{label}", test, "laser", like.machine, like.vertical, at, first, np.tile(beam, (n, 1)), feed, half,
        (q_mm - q_mm[0]) @ beam, start, dead, 0.0, np.zeros(3),
    )  # fmt: skip
    return _run(path)


def _box(machine: Machine) -> F2:
    inside = MARGIN * machine.length_mm
    return np.column_stack([machine.stroke_mm[:, 0] + inside, machine.stroke_mm[:, 1] - inside])


def _diagonals(like: Path, start: float) -> ExperimentOffer:
    found = []
    for k, name in enumerate(DIAGONALS):
        a, b = diagonal_ends(_box(like.machine), name)
        beam = (b - a) / np.linalg.norm(b - a)
        found.append(_laser(like, step_diagonal(a, b, 12), beam, start + 2000.0 * k, f"next_{name}", "laser_diagonal"))
    runs = tuple(found)
    return ExperimentOffer("laser_diagonals", runs, 4 * LASER_MIN + _minutes(runs), "the four body diagonals in steps, out and back")


def _line(like: Path, axis: int, start: float, label: str, tool_mm: F1 | None = None) -> CaseRun:
    box = _box(like.machine)
    a, b = like.machine.centre_mm.copy(), like.machine.centre_mm.copy()
    a[axis], b[axis] = box[axis]
    run = _laser(like, straight_line(a, b, 21), np.eye(3)[axis], start, label, "laser_linear")
    if tool_mm is None:
        return run
    return replace(run, path=replace(run.path, machine=replace(like.machine, tool_mm=like.machine.tool_mm + tool_mm)))


def _angles(like: Path, start: float) -> ExperimentOffer:
    """Offer an angular interferometer, simulated as the difference of two beams, for pitch and yaw of each axis."""
    one, two, t = [], [], start
    for a in range(3):
        for across in ((a + 1) % 3, (a + 2) % 3):
            arm = ARM_MM * np.eye(3)[across]
            label = f"next_angle_{AXES[a]}{AXES[across]}"
            one.append(_line(like, a, t, label, arm))
            two.append(_line(like, a, t, label, -arm))
            t += 1500.0
    runs = tuple(one)
    return ExperimentOffer(
        "angular_interferometer", runs, 3 * LINE_MIN + _minutes(runs), "pitch and yaw of each axis by themselves", subtracted=tuple(two)
    )


def _late(known: list[Path], start: float) -> ExperimentOffer:
    """Offer to repeat the first paths hours later, each in a separate set-up."""
    runs = []
    for k, p in enumerate(_different(known)[:4]):
        runs.append(_again(p, start + LATE_S + 1500.0 * k, f"next_late_{k}", p.machine))
    setup = BAR_MIN if known[0].kind == "bar" else LASER_MIN
    found = tuple(runs)
    return ExperimentOffer("longer_session", found, WAIT_MIN + len(found) * setup + _minutes(found), "the first runs again hours later")


def _second_tool(known: list[Path], start: float) -> ExperimentOffer:
    tool = known[0].machine.tool_mm
    along = tool / np.linalg.norm(tool) if np.linalg.norm(tool) > 1.0 else -np.eye(3)[2]
    longer = replace(known[0].machine, tool_mm=tool + LONGER_TOOL_MM * along)
    runs = tuple(_again(p, start + 1500.0 * k, f"next_tool_{k}", longer) for k, p in enumerate(_different(known)[:4]))
    return ExperimentOffer(
        "second_tool_length", runs, TOOL_MIN + len(runs) * BAR_MIN + _minutes(runs), "the same runs with a tool 100 mm longer"
    )


def _different(known: list[Path]) -> list[Path]:
    """Return the first run of every set-up, in order of time."""
    first: dict[str, Path] = {}
    for p in sorted(known, key=lambda p: float(p.at.t_s[0])):
        first.setdefault(p.setup, p)
    return list(first.values())


def _again(p: Path, start: float, label: str, machine: Machine) -> CaseRun:
    feed = float(np.median(p.feed_mm_min))
    run = _bar(p, p.at.q_mm, feed, start, label) if p.kind == "bar" else _laser(p, p.at.q_mm, p.look[0], start, label, p.test)
    return replace(run, path=replace(run.path, machine=machine, test=p.test))


def blind_spots(case: Case) -> tuple[BlindSpot, ...]:
    """Return the blind spots of a campaign's identify runs, each with the measurement that would cover it.

    Runs with other roles are left out, because the search does not use them.
    """
    paths = [r.path for r in case.of("identify")]
    bars, lasers = [p for p in paths if p.kind == "bar"], [p for p in paths if p.kind == "laser"]
    out: list[BlindSpot] = []
    if not paths:
        return ()
    if not bars:
        out.append(BlindSpot(MOVING, "no ball-bar run was fitted", "ballbar"))
    else:
        if one_feed(bars):
            out.append(BlindSpot(GROWS, "all ball-bar runs have one feed", "second_feed"))
        if one_way(bars):
            out.append(BlindSpot(TURNS, "all ball-bar runs go one way round", "opposite_direction"))
        if one_radius(bars):
            out.append(BlindSpot(LENGTH, "all ball-bar runs have one radius", "second_radius"))
    if not lasers:
        out.append(BlindSpot(SCALE, "no laser run was fitted", "laser_diagonals"))
    if not _repeated_late(paths):
        out.append(BlindSpot(SLOW, f"no path was run again {REPEAT_LATE_S / 3600.0:.0f} h later or more", "longer_session"))
    return tuple(out)


def _repeated_late(paths: list[Path]) -> bool:
    """Whether some path was repeated, in either direction, `REPEAT_LATE_S` or more after its first run."""
    first: list[tuple[str, F1, float]] = []
    for p in sorted(paths, key=lambda p: float(p.at.t_s[0])):
        place, began = _place(p), float(p.at.t_s[0])
        before = next((t for test, known, t in first if test == p.test and np.all(np.abs(place - known) <= SAME_MM)), None)
        if before is None:
            first.append((p.test, place, began))
        elif began - before >= REPEAT_LATE_S:
            return True
    return False


def _place(path: Path) -> F1:
    """Return numbers, mm, that identify a path in either direction: extent, and a bar's cup and radius or a beam's scaled direction."""
    reach = [path.at.q_mm.min(axis=0), path.at.q_mm.max(axis=0)]
    if path.kind == "bar":
        return np.concatenate([*reach, path.centre_mm, [path.radius_mm]])
    beam = path.look[0]
    back = beam[np.flatnonzero(np.abs(beam) > 0.1)[0]] < 0.0
    return np.concatenate([*reach, (-beam if back else beam) * SAME_MM / SAME_LOOK])
