"""`abbe errors`: the deviation of a machine with known error motions at given points, with its uncertainty where the file gives one."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from abbe.models.arrays import F1, F2, F3
from abbe.models.functions.motions import REVERSE, ErrorMotions
from abbe.models.geometry.chain import deviation_mm, exact_deviation_mm
from abbe.models.geometry.field import field_mm, in_blocks
from abbe.models.geometry.propagation import Points, deviation_covariance
from abbe.models.machine import AXES, Machine
from abbe.service.config import load_machine, read_toml
from abbe.service.config_schema import MachineFile
from abbe.service.domain.machine import MachineObject, machine_from_doc
from abbe.service.errors import ConfigError, FileFormatError, nearest
from abbe.service.runs.checks import check, read_json
from abbe.service.runs.errors_file import KnownErrors, read_errors
from abbe.service.runs.points import POSITION, TOOL, PointsFile, read_points

FORMAT = "abbe-deviations/1"
CONVENTION = "actual minus nominal, tool relative to workpiece; rigid motion not removed; squareness counts from axis zero"
SLACK_MM = 1e-9
"""Tolerance for rounding at the ends of a stroke."""
ROWS = 4096
"""Points written at a time."""

Model = Literal["first-order", "exact"]


@dataclass(frozen=True, slots=True)
class Deviations:
    """Deviation at points, shape (n, 3), actual minus nominal.

    ``u_mm``: standard uncertainty of dX, dY, dZ and of the norm, shape (n, 4) (`standard_uncertainty_mm`); None if the errors file gives no
    uncertainty. ``uncertainty``: one line about it. ``not_observable``: as in the errors file.
    """

    machine: str
    model: Model
    points: PointsFile
    deviation_mm: F2
    u_mm: F2 | None
    uncertainty: str
    not_observable: list[dict[str, Any]]
    warnings: list[str]

    @property
    def norm_mm(self) -> F1:
        """Length of the deviation, shape (n,)."""
        return np.asarray(np.linalg.norm(self.deviation_mm, axis=1), dtype=np.float64)


def standard_uncertainty_mm(deviation_mm: F2, covariance_mm2: F3) -> F2:
    """Standard uncertainty of dX, dY, dZ and of the norm.

    The uncertainty of the norm is the linear term along the deviation. If the norm is at most twice the uncertainty of the worst direction
    (root of the covariance's largest eigenvalue), the direction is uncertain and the linear term too small (undefined at norm zero): the
    uncertainty of the worst direction is used instead.

    Parameters
    ----------
    deviation_mm : array, shape (n, 3)
    covariance_mm2 : array, shape (n, 3, 3)

    Returns
    -------
    array, shape (n, 4)
        NaN where the covariance is not finite.
    """
    finite = np.asarray(np.isfinite(covariance_mm2).all(axis=(1, 2)))
    covariance = np.where(finite[:, None, None], covariance_mm2, 0.0)
    norm: F1 = np.asarray(np.linalg.norm(deviation_mm, axis=1))
    along = np.divide(deviation_mm, norm[:, None], out=np.zeros_like(deviation_mm), where=norm[:, None] > 0.0)
    of_norm = np.einsum("ni,nij,nj->n", along, covariance, along)
    near = np.flatnonzero(norm * norm <= 4.0 * np.trace(covariance, axis1=1, axis2=2))  # the trace bounds the largest eigenvalue
    worst = np.linalg.eigvalsh(covariance[near])[:, -1]
    of_norm[near] = np.where(norm[near] ** 2 <= 4.0 * worst, worst, of_norm[near])
    variances = np.concatenate([np.diagonal(covariance, axis1=1, axis2=2), of_norm[:, None]], axis=1)
    variances[~finite] = np.nan
    return np.asarray(np.sqrt(np.maximum(variances, 0.0)), dtype=np.float64)


def deviations(machine_path: Path, errors_path: Path, points_path: Path, *, exact: bool = False) -> Deviations:
    """Evaluate a machine's error motions at points.

    Parameters
    ----------
    machine_path : Path
        Abbe's machine file (TOML), or a machine object (docs/schemas/machine.schema.json) as TOML or JSON.
    errors_path : Path
        ``abbe-errors/1``.
    points_path : Path
        CSV, see `abbe.service.runs.points.read_points`.
    exact : bool
        Finite rotations (docs/explanation/conventions.md) instead of rule G.

    Raises
    ------
    ConfigError, FileFormatError
        A file is missing or invalid, or a point lies outside the strokes.
    """
    name, machine, notes = read_machine(machine_path)
    with np.errstate(all="ignore"):  # _check_finite reports overflows
        known = read_errors(errors_path)
        points = read_points(points_path)
        _check_strokes(machine, points)
        off, u = _evaluate(machine, known, points, exact=exact)
        _check_finite(errors_path, points, off, u)
    notes += [*known.warnings(), *_notes(known, points)]
    return Deviations(name, "exact" if exact else "first-order", points, off, u, known.uncertainty, known.not_observable, notes)


def _evaluate(machine: Machine, known: KnownErrors, points: PointsFile, *, exact: bool) -> tuple[F2, F2 | None]:
    """Deviation, shape (n, 3), and uncertainties, shape (n, 4), mm; in blocks, to bound the memory for a million points."""
    at = Points(points.axes_mm, points.direction, points.tool_mm)
    u: F2 | None = None if known.covariance is None else np.empty((points.axes_mm.shape[0], 4))
    off = _deviation(machine, known, at, exact=exact)

    def block(rows: slice) -> None:
        if u is not None and known.covariance is not None:
            covariance = deviation_covariance(machine, known.motions, known.covariance, at.rows(rows), exact=exact)
            u[rows] = standard_uncertainty_mm(off[rows], covariance)

    in_blocks(points.axes_mm.shape[0], block)
    return off, u


def _deviation(machine: Machine, known: KnownErrors, at: Points, *, exact: bool) -> F2:
    """Deviation, shape (n, 3), mm: as a field if all points have one tool and no direction; if not, point by point, in blocks."""
    if not exact and at.direction is None and at.tool_mm is None:
        return field_mm(machine, known.motions.motions, at.axes_mm)
    off: F2 = np.empty((at.axes_mm.shape[0], 3))

    def block(rows: slice) -> None:
        some = at.rows(rows)
        values = known.motions.motions(some.axes_mm, some.direction)
        off[rows] = (exact_deviation_mm if exact else deviation_mm)(machine, some.axes_mm, values, some.tool_mm)

    in_blocks(at.axes_mm.shape[0], block)
    return off


def read_machine(path: Path) -> tuple[str, Machine, list[str]]:
    """Name, nominal geometry and notes from Abbe's machine file or from a machine object, TOML or JSON.

    Raises
    ------
    ConfigError, FileFormatError
        The message names file, key and expected value.
    """
    if path.suffix.lower() == ".json":
        if not path.exists():
            raise ConfigError(f"machine file {path} does not exist", "give the path of a machine file (TOML or JSON)")
        document = read_json(path)
    else:
        document = json.loads(json.dumps(read_toml(path), default=str))  # dates become text, as in JSON machine objects
        own, found = set(MachineFile.model_fields), set(document)
        if found & (own - set(MachineObject.model_fields)) or ("name" in found and found <= own):
            loaded = load_machine(path).machine
            return loaded.name, machine_from_doc(loaded.machine_doc()), []
    check(path, document, MachineObject)
    strange = sorted(set(document) - set(MachineObject.model_fields))
    notes = [f"{path}: key {key!r} is not used ({nearest(key, MachineObject.model_fields)})" for key in strange]
    plain = {key: value for key, value in document.items() if value is not None}
    plain["pivots_mm"] = {axis: point for axis, point in (document.get("pivots_mm") or {}).items() if point is not None}
    return str(document.get("name") or path.stem), machine_from_doc(plain), notes


def _check_strokes(machine: Machine, points: PointsFile) -> None:
    low, high = machine.stroke_mm[:, 0] - SLACK_MM, machine.stroke_mm[:, 1] + SLACK_MM
    outside = (points.axes_mm < low) | (points.axes_mm > high)
    rows = np.flatnonzero(outside.any(axis=1))
    if rows.size:
        index, axis = int(rows[0]), int(np.argmax(outside[rows[0]]))
        stroke = f"the stroke of {AXES[axis]}, {machine.stroke_mm[axis, 0]:g} to {machine.stroke_mm[axis, 1]:g} mm"
        more = f" (and {rows.size - 1} more rows)" if rows.size > 1 else ""
        raise FileFormatError(
            f"{points.place(index)}: {POSITION[axis]} = {points.axes_mm[index, axis]:g} is outside {stroke}{more}",
            "leave the point out: the errors are not known there",
        )


def _check_finite(path: Path, points: PointsFile, off: F2, u: F2 | None) -> None:
    bad = ~np.isfinite(np.linalg.norm(off, axis=1))
    if u is not None:
        bad |= ~np.isfinite(u).all(axis=1)
    if bad.any():
        what = "functions" if u is None else "functions or the covariance"
        raise FileFormatError(
            f"{path}: the values are too large to compute the deviation at {points.place(int(np.argmax(bad)))}", f"correct the {what}"
        )


def _notes(known: KnownErrors, points: PointsFile) -> list[str]:
    notes = [f"{points.path}: column {name!r} is not used" for name in points.unused]
    for axis, letter in enumerate(AXES):
        reverse = [key for key in known.motions.functions if key.endswith(letter + REVERSE)]
        if reverse and axis not in points.directed:
            unused = ", ".join(reverse)
            notes.append(f"no column direction_{letter.lower()}: Abbe assumes that {letter} last moved in +, and {unused} is not used")
    return notes + _ends(known.motions, points)


def _ends(motions: ErrorMotions, points: PointsFile) -> list[str]:
    notes = []
    for key, function in motions.functions.items():
        lo, hi = function.domain_mm
        x = points.axes_mm[:, AXES.index(key.removesuffix(REVERSE)[-1])]
        count = int(((x < lo - SLACK_MM) | (x > hi + SLACK_MM)).sum())
        if count:
            notes.append(f"{key} is known from {lo:g} to {hi:g} mm only: its end value is held at {count} of {x.size} points")
    return notes


def deviations_json(found: Deviations) -> Iterator[str]:
    """One JSON object on one line, in pieces: one object per point with the columns of the points file, lengths in mm.

    ``u_`` is a standard uncertainty. The pieces bound the memory: a million points as Python objects take more than a gigabyte.
    """
    head = {
        "format": FORMAT,
        "machine": found.machine,
        "model": found.model,
        "meaning": CONVENTION,
        "uncertainty": {"given": found.u_mm is not None, "text": found.uncertainty},
        "not_observable": found.not_observable,
        "warnings": found.warnings,
    }
    yield json.dumps(head, ensure_ascii=False).removesuffix("}") + ', "points": ['
    norm = found.norm_mm
    for start in range(0, norm.size, ROWS):
        columns = _columns(found, norm, slice(start, start + ROWS))
        rows = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
        yield (", " if start else "") + json.dumps(rows)[1:-1]
    yield "]}"


def _columns(found: Deviations, norm: F1, rows: slice) -> dict[str, list[Any]]:
    points = found.points
    columns: dict[str, list[Any]] = dict(zip(POSITION, points.axes_mm[rows].T.tolist(), strict=True))
    if points.direction is not None:
        signs = points.direction[rows].astype(int).T.tolist()
        columns |= {f"direction_{AXES[axis].lower()}": signs[axis] for axis in points.directed}
    if points.tool_mm is not None:
        columns |= dict(zip(TOOL, points.tool_mm[rows].T.tolist(), strict=True))
    columns |= {"deviation_mm": found.deviation_mm[rows].tolist(), "norm_mm": norm[rows].tolist()}
    if found.u_mm is None:
        nothing = [None] * len(columns["norm_mm"])
        return columns | {"u_deviation_mm": nothing, "u_norm_mm": nothing}
    return columns | {"u_deviation_mm": found.u_mm[rows, :3].tolist(), "u_norm_mm": found.u_mm[rows, 3].tolist()}
