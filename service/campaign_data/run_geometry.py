"""Check that the commanded positions of a run lie where its set-up says: on the sphere, in the plane, on the line, inside the strokes.

If not, the check tries the usual mistakes (inches, micrometres, metres, exchanged columns) and names the one that explains the positions.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import permutations

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.service.domain.artefact import Feature
from abbe.service.domain.document import Doc
from abbe.service.domain.run import FEATURE, ArtefactSetup, BarSetup, Columns, LaserSetup, Run

Distance = Callable[[F2], float]

TOLERANCE_MM = 1.5
"""Largest distance from the nominal path: chords of a polyline deviate by less than 0.1 mm, a ball-bar has a range of about 1 mm."""
SMALLEST_RADIUS_MM = 15.0
UNITS = {"inches": 25.4, "µm": 1e-3, "m": 1e3}
AXES = "xyz"


@dataclass(frozen=True, slots=True)
class GeometryMistake:
    """A mistake in the geometry of a run, and its remedy."""

    text: str
    remedy: str
    refuse: bool = True


def geometry_mistake(machine: Doc, run: Run) -> GeometryMistake | None:
    """Return the first mistake in the geometry of a run, or None. Missing keys are not checked."""
    points, setup = run.columns.q_mm, run.setup
    if not np.isfinite(points).all():
        return GeometryMistake("a position is not a finite number", "correct x_mm, y_mm, z_mm")
    found = None
    if isinstance(setup, BarSetup):
        found = _bar(run.test, setup, points)
    elif isinstance(setup, LaserSetup):
        found = _laser(run.test, setup, points)
    elif setup.by_machine and setup.features is not None:
        found = _artefact(setup, {f.id: f for f in setup.features.features}, run.columns)
    return found or _inside(machine, points)


def _bar(test: str, setup: BarSetup, points: F2) -> GeometryMistake | None:
    centre, radius = setup.centre_mm, setup.radius_mm
    plane = setup.plane.lower() if test == "ballbar_circle" else ""

    def off(p: F2, c: F1 = centre, r: float = radius) -> float:
        return float(np.abs(np.linalg.norm(p - c, axis=1) - r).max())

    largest = off(points)
    if largest > TOLERANCE_MM:
        place = f"points lie up to {largest:.0f} mm beside the sphere of radius {radius:g} mm about centre_mm"
        return (
            _explained(points, place, off) or _setup_unit(points, centre, radius, place) or _unexplained(place, "centre_mm and radius_mm")
        )
    if plane:
        normal = next(k for k, a in enumerate(AXES) if a not in plane)
        out = float(np.abs(points[:, normal] - centre[normal]).max())
        if out > TOLERANCE_MM:
            place = f"points leave the plane {plane.upper()} by up to {out:.0f} mm"
            return _explained(points, place, lambda p: float(np.abs(p[:, normal] - centre[normal]).max())) or _unexplained(place, "plane")
    if radius < SMALLEST_RADIUS_MM:
        return GeometryMistake(
            f"radius_mm is {radius:g}: no ball-bar is that short; read as inches it is {radius * 25.4:.0f} mm", "write mm, not inches"
        )
    return None


def _setup_unit(points: F2, centre: F1, radius: float, place: str) -> GeometryMistake | None:
    for unit, factor in UNITS.items():
        for key, c, r in (
            ("radius_mm", centre, factor * radius),
            ("centre_mm", factor * centre, radius),
            ("both", factor * centre, factor * radius),
        ):
            if float(np.abs(np.linalg.norm(points - c, axis=1) - r).max()) < TOLERANCE_MM:
                name = "centre_mm and radius_mm hold" if key == "both" else f"{key} holds"
                return GeometryMistake(f"{place}: {name} {unit}", "convert to mm")
    return None


def _artefact(setup: ArtefactSetup, known: dict[str, Feature], columns: Columns) -> GeometryMistake | None:
    """Compare the deviation of each hole or ball with its position, pose and nominal place; walls are not compared."""
    names = [str(name) for name in columns.further[FEATURE]]
    read = np.column_stack([columns.further.get(f"deviation_{a}_mm", np.full(len(names), np.nan)) for a in AXES]).astype(np.float64)
    nominal = np.array([known[name].nominal_mm if known[name].normal is None else [np.nan] * 3 for name in names])
    own = (columns.q_mm - setup.pose.origin_mm) @ setup.pose.matrix - nominal
    off = np.where(columns.valid[:, None], own - read, np.nan)
    off = off - [np.nanmedian(one) if np.isfinite(one).any() else 0.0 for one in off.T]  # the solution fits the pose's origin
    away = np.nan_to_num(np.abs(off)).max(axis=1)
    worst = int(np.argmax(away))
    if away[worst] <= TOLERANCE_MM:
        return None
    place = f"feature {names[worst]}: position and pose place it {away[worst]:.0f} mm from where its deviation places it"
    return GeometryMistake(place, "correct its label, the pose, or deviation_x_mm, deviation_y_mm, deviation_z_mm")


def _laser(test: str, setup: LaserSetup, points: F2) -> GeometryMistake | None:
    start, end = setup.start_mm, setup.end_mm
    if start is None or end is None:
        return None
    mistake = _direction(test, setup, end - start)
    if mistake is not None:
        return mistake

    def off(p: F2) -> float:
        low, high = np.minimum(start, end), np.maximum(start, end)
        outside = np.maximum(np.maximum(low - p, p - high), 0.0).max()
        ends = max(np.linalg.norm(p - e, axis=1).min() for e in (start, end))
        return float(max(outside, ends))

    largest = off(points)
    if largest > TOLERANCE_MM:
        place = f"positions miss the line from start_mm to end_mm by {largest:.0f} mm"
        return _explained(points, place, off) or _unexplained(place, "start_mm and end_mm")
    return _sequence(setup, points) if test == "laser_diagonal" else None


def _direction(test: str, setup: LaserSetup, span: F1) -> GeometryMistake | None:
    """Check beam, axis, letters of the diagonal and increments against the line from start to end."""
    if test == "laser_linear" and setup.axis and not span.any():
        stood = "the axis stood still: its readings over time hold no geometry; only a report shows them"
        remedy = (
            "leave the run out (--without); abbe discover takes a campaign of such runs with temperatures, and shows the thermal response"
        )
        return GeometryMistake(stood, remedy)
    unit = span / max(float(np.linalg.norm(span)), 1e-9)
    beam = setup.nominal_beam
    if beam is not None and float(np.dot(beam, unit)) < 0.999 * float(np.linalg.norm(beam)):
        return GeometryMistake("nominal_beam does not point from start_mm to end_mm", "look in the set-up for exchanged or reversed axes")
    if test == "laser_linear" and not setup.axis:
        return GeometryMistake("its set-up states no axis", "state axis: X, Y or Z")
    if test == "laser_linear" and abs(unit["XYZ".index(setup.axis)]) < 0.999:
        moved = "XYZ"[int(np.argmax(np.abs(unit)))]
        return GeometryMistake(f"axis is {setup.axis}, but start_mm and end_mm differ in {moved}", "correct axis, start_mm or end_mm")
    letters = setup.diagonal if test == "laser_diagonal" else ""
    if letters and any((s > 0) != (c == "p") for s, c in zip(span, letters, strict=True) if s):  # a face diagonal leaves one axis alone
        return GeometryMistake(
            f"diagonal is {letters}, but the line from start_mm to end_mm is another diagonal", "correct diagonal, start_mm or end_mm"
        )
    step, count = setup.increment_mm, setup.steps
    allowed = TOLERANCE_MM + 2.0 * setup.overrun_mm  # the ends are the turning points
    if step is not None and step.ndim and count and float(np.abs(step * count - span).max()) > allowed:
        return GeometryMistake(
            f"{count} steps of increment_mm do not lead from start_mm to end_mm", "correct increment_mm, steps or the ends"
        )
    return None


def _sequence(setup: LaserSetup, points: F2) -> GeometryMistake | None:
    """Check the outward path of a step diagonal: one axis after the other, in the order of the set-up (default X, Y, Z)."""
    count = setup.steps
    if count == 0 or len(points) < 3 * count + 1 or (setup.order == "" and len(points) <= 2 * count + 2):
        return None
    order = setup.order or "XYZ"
    moved = np.abs(np.diff(points[: 3 * count + 1], axis=0)) > 1e-3
    wanted = np.tile(np.array([[a == o for a in "XYZ"] for o in order]), (count, 1))
    if (moved.sum(axis=1) == 1).all() and not (moved == wanted).all():
        first = "".join("XYZ"[int(np.argmax(row))] for row in moved[:3])
        return GeometryMistake(
            f"steps go in the order {first}, the run says {order}: columns are exchanged, or the key order is wrong", "correct the file"
        )
    return None


def _inside(machine: Doc, points: F2) -> GeometryMistake | None:
    stroke = machine.get("stroke_mm")
    if stroke is None:
        return None
    box = np.array([stroke[a] for a in "XYZ"], dtype=np.float64)

    def off(p: F2) -> float:
        return float(np.maximum(box[:, 0] - p.min(axis=0), p.max(axis=0) - box[:, 1]).max())

    largest = off(points)
    if largest <= TOLERANCE_MM:
        return None
    axis = int(np.argmax(np.maximum(box[:, 0] - points.min(axis=0), points.max(axis=0) - box[:, 1])))
    low, high = (f"{v:g}" for v in box[axis])
    place = f"{'XYZ'[axis]} goes {largest:.0f} mm beyond the stroke {low} to {high} mm"
    return GeometryMistake(place, "correct the positions or the machine's stroke, or leave the run out (--without)")


def _explained(points: F2, place: str, off: Distance) -> GeometryMistake | None:
    for unit, factor in UNITS.items():
        if off(factor * points) < TOLERANCE_MM:
            return GeometryMistake(f"{place}: x_mm, y_mm, z_mm hold {unit}", "convert the columns to mm")
    for order in permutations(range(3)):
        if order != (0, 1, 2) and off(points[:, order]) < TOLERANCE_MM:
            moved = [f"{AXES[k]}_mm" for k in range(3) if order[k] != k]
            return GeometryMistake(f"{place}: columns {' and '.join(moved)} are exchanged", "correct the order of the columns")
    return None


def _unexplained(place: str, keys: str) -> GeometryMistake:
    return GeometryMistake(
        f"{place}: {keys} or the positions do not belong to this run", "correct the set-up, or leave the run out (--without)"
    )
