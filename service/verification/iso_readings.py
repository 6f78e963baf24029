"""Runs grouped into tests of ISO 230: approaches of positions, diagonals, circles; and the readings of each that are used."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from abbe.models.arrays import F1
from abbe.models.evaluation.iso230_2 import Approaches
from abbe.models.evaluation.iso230_4 import CircularTest
from abbe.models.machine import AXES
from abbe.models.solvers.observations import nominal_reading
from abbe.service.domain.run import Run
from abbe.service.errors import AbbeError, MeasurementFault
from abbe.service.runs.observations import run_data

NEAR_MM = 0.05
"""Positions closer than this count as one position (as for discoveries: `abbe.service.effects.axis_test`)."""
ALL = 10**9


@dataclass(frozen=True, slots=True)
class AxisTest:
    """One bidirectional test along an axis or a diagonal. ``runs``: labels; ``notes``: remarks for the reader."""

    name: str
    setup: str
    runs: tuple[str, ...]
    readings: Approaches
    notes: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class CircleTest:
    """One path around a circle; ``sense`` +1: from the plane's first axis to its second."""

    run: str
    plane: str
    setup: str
    radius_mm: float
    sense: int
    path: CircularTest
    u_length_mm: float | None


def linear_tests(runs: Sequence[Run], refused: list[str]) -> list[AxisTest]:
    """Positioning tests of single axes. Appends unusable runs, with reason, to ``refused``."""
    groups = linear_groups(runs)
    return [t for (name, setup), group in groups.items() if (t := _test(name, setup, group, refused)) is not None]


def linear_groups(runs: Sequence[Run]) -> dict[tuple[str, str], list[Run]]:
    """Runs of one axis in one set-up, by axis and set-up: one positioning test each."""
    groups: dict[tuple[str, str], list[Run]] = {}
    for run in _open(runs, "laser_linear"):
        groups.setdefault((_axis(run), run.setup.setup_id), []).append(run)
    return groups


def diagonal_tests(runs: Sequence[Run], refused: list[str]) -> dict[str, list[AxisTest]]:
    """Plain diagonals by group: ``body``, or the plane of face diagonals. Step diagonals are not tests of ISO 230-6.

    Appends unusable runs, with reason, to ``refused``.
    """
    out: dict[str, list[AxisTest]] = {}
    for (plane, name, setup_id), group in diagonal_groups(runs).items():
        test = _test(name, setup_id, group, refused)
        if test is not None and name not in {t.name for t in out.get(plane, [])}:  # the first of repeated measurements counts
            out.setdefault(plane, []).append(test)
    return out


def diagonal_groups(runs: Sequence[Run]) -> dict[tuple[str, str, str], list[Run]]:
    """Runs of plain diagonals, by group (as `diagonal_tests`), diagonal and set-up."""
    groups: dict[tuple[str, str, str], list[Run]] = {}
    for run in _open(runs, "laser_diagonal"):
        setup = run.laser
        if not setup.order:
            name = "".join(setup.diagonal["XYZ".index(a)] for a in setup.face) if setup.face else setup.diagonal
            groups.setdefault((setup.face or "body", name, setup.setup_id), []).append(run)
    return groups


def circle_tests(runs: Sequence[Run], refused: list[str]) -> list[CircleTest]:
    """Ball-bar circles, one test per path. Appends unusable runs, with reason, to ``refused``."""
    out = []
    for run in _open(runs, "ballbar_circle"):
        try:
            out.append(_circle(run))
        except (AbbeError, ValueError) as error:
            refused.append(f"circle {run.run_id}: {_message(error)}")
    return out


def _circle(run: Run) -> CircleTest:
    setup, plane = run.bar, run.bar.plane
    data = run_data(run, blocks=ALL)
    assert data.centre_mm is not None
    a, b = ("XYZ".index(c) for c in plane)
    at = data.axes_mm - data.centre_mm
    angle = np.unwrap(np.arctan2(at[:, b], at[:, a]))
    path = CircularTest(angle, data.deviation_mm - nominal_reading(data))
    sense = 1 if angle[-1] >= angle[0] else -1
    u = setup.u_length_mm if setup.length_calibrated else None
    return CircleTest(run.run_id, plane, data.setup, setup.radius_mm, sense, path, u)


def _message(error: Exception) -> str:
    return error.detail if isinstance(error, AbbeError) else str(error)


def _open(runs: Sequence[Run], test: str) -> list[Run]:
    """Runs of one test that have readings (not sealed)."""
    return [r for r in runs if r.test == test and not r.is_sealed]


def _axis(run: Run) -> str:
    return run.laser.axis or AXES[int(np.argmax(np.abs(run.laser.span_mm)))]


def _test(name: str, setup: str, group: list[Run], refused: list[str]) -> AxisTest | None:
    """Sort readings by position, side and cycle into a test; None if it is not bidirectional, with the reason added to ``refused``."""
    runs = tuple(r.run_id for r in group)
    try:
        readings = _approaches(name, group)
    except (AbbeError, ValueError) as error:
        refused.append(f"{name} ({', '.join(runs)}): {_message(error)}")
        return None
    return AxisTest(name, setup, runs, readings, tuple(_notes(group)))


def _approaches(name: str, group: list[Run]) -> Approaches:
    cells: dict[tuple[float, int], list[float]] = {}
    for run in group:
        position, sign, value = readings_along(run, name)
        for p, s, v in zip(position, sign, value, strict=True):
            cells.setdefault((float(p), int(s)), []).append(float(v))
    return approaches_of(cells, {p for run in group for p in _turning_points(run, name)})


def approaches_of(cells: Mapping[tuple[float, int], list[float]], turns: Collection[float] = ()) -> Approaches:
    """Readings by position and direction as a test: positions that were approached from both sides, without turning points.

    Raises
    ------
    ValueError
        Fewer than two positions remain.
    """
    places = sorted({p for p, s in cells if (p, -s) in cells} - set(turns))
    cycles = max((len(cells[p, s]) for p in places for s in (1, -1)), default=0)
    sides = [np.array([cells[p, s] + [np.nan] * (cycles - len(cells[p, s])) for p in places]) for s in (1, -1)]
    return Approaches(np.array(places), *sides)


def readings_along(run: Run, name: str) -> tuple[F1, F1, F1]:
    """Position, direction and deviation of the valid readings along the positive sense of the axis, mm.

    Raises
    ------
    MeasurementFault
        The run does not move along this axis, or a valid deviation is not a number.
    ValueError
        The set-up states no start or no end.
    """
    axes, keep, deviation = run.columns.q_mm, run.columns.valid, run.columns.readings_mm
    way, start = run.laser.span_mm, run.laser.ends_mm[0]
    if len(name) == 1:
        along, turned = axes[:, "XYZ".index(name)], float(np.sign(way["XYZ".index(name)]))
    else:
        along, turned = (axes - start) @ (way / np.linalg.norm(way)), 1.0
    if turned == 0.0 or not np.isfinite(deviation[keep]).all():
        raise MeasurementFault(f"run {run.run_id} is not a test along {name}, or has a deviation that is not a number", "leave the run out")
    sign = run.columns.direction * turned
    return _place(along)[keep], sign[keep], (deviation * turned)[keep]


def _place(along: F1) -> F1:
    return np.asarray((np.round(along / NEAR_MM) * NEAR_MM).round(6))


def _turning_points(run: Run, name: str) -> list[float]:
    """Turning points of recipes with an overrun: they are read but are not target positions."""
    setup = run.laser
    if not setup.overrun_mm:
        return []
    if len(name) == 1:
        return [float(v) for v in _place(np.array(setup.ends_mm)[:, "XYZ".index(name)])]
    return [0.0, float(_place(np.array([np.linalg.norm(setup.span_mm)]))[0])]


def _notes(group: list[Run]) -> list[str]:
    out = []
    if not any(r.laser.overrun_mm for r in group):
        out.append("no overrun is recorded: at the end positions both directions may be one approach read twice, and then B shows nothing")
    if len(group) > 1 and all(r.columns.readings_mm[0] == 0.0 for r in group):
        out.append("every run was zeroed at its first reading: the scatter of that reading enters R and A of all other positions")
    return out
