"""A path that was measured in pieces: how far broken runs have read it, and their readings and the last run's as one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from abbe.models.arrays import F1
from abbe.service.domain.document import Doc
from abbe.service.domain.measured import RunRecord

STRETCH_S, STRETCH_MM = 0.5, 5.0
"""So long, and at least so far, is what is read twice."""
LEAST_READINGS = 5
MOST_LOST = 1e-3


@dataclass(frozen=True, slots=True)
class RunPiece:
    """A run that was broken off, and up to where on the whole path (mm from its first point) its readings count."""

    run: int
    to_mm: float


@dataclass(frozen=True, slots=True)
class SoFar:
    """How far a path was read: its pieces, the last one up to where it was at constant feed; from where on that one counts; what it read.

    ``arc_mm`` and ``deviation_mm``, shape (n,): of the last piece, along the whole path. ``boot_id``: of the box that read.
    """

    pieces: tuple[RunPiece, ...]
    counted_from_mm: float
    arc_mm: F1
    deviation_mm: F1
    boot_id: int


def arc_of(points: Sequence[Sequence[float]]) -> F1:
    """Length of a polyline up to each of its points, mm."""
    steps = np.linalg.norm(np.diff(np.asarray(points, dtype=np.float64), axis=0), axis=1)
    return np.concatenate(([0.0], np.cumsum(steps)))


def pieces_of(start: Doc) -> tuple[RunPiece, ...]:
    """The broken runs whose readings belong to a run, oldest first; none for a run that was measured in one go."""
    return tuple(RunPiece(int(one["run"]), float(one["to_mm"])) for one in (start.get("path") or {}).get("pieces", []))


def read_so_far(record: RunRecord, columns: Doc) -> SoFar | None:
    """How far a broken run has read its path; None if it gives nothing that could be gone on with.

    Parameters
    ----------
    record : RunRecord
        The run that was broken off.
    columns : dict
        Its columns.
    """
    path, end = record.start_doc.get("path"), record.end_doc or {}
    if not path or "good_us" not in end or "box_boot_id" not in end:
        return None
    feed_mm_s, offset = path["feed_mm_min"] / 60.0, float(path.get("offset_mm", 0.0))
    good_mm = (end["good_us"] - end["path_start_us"]) * 1e-6 * feed_mm_s
    arc = arc_of(path["points_mm"])
    counted_mm = float(arc[path["measured"][0]]) if path.get("measured") else 0.0
    valid = np.asarray(columns["valid"], dtype=bool)
    at_mm = along_mm(record.start_doc, end, columns)[valid]
    seq = np.asarray(columns["device_seq"], dtype=np.int64)
    lost = int(seq[-1] - seq[0]) % 2**32 + 1 - seq.size if seq.size else 0
    if lost > max(1.0, MOST_LOST * seq.size):
        return None  # a line that bad ends a run (abbe.service.capture); it must not get in by pieces
    known = at_mm <= good_mm
    good_mm = float(at_mm[known].max(initial=0.0))  # a bar that was out of range before anything else stopped has read no farther
    if good_mm - counted_mm < max(STRETCH_MM, STRETCH_S * feed_mm_s) or int(known.sum()) < LEAST_READINGS:
        return None
    pieces = (*pieces_of(record.start_doc), RunPiece(record.id, offset + good_mm))
    deviation = np.asarray(columns["deviation_mm"], dtype=np.float64)[valid]
    return SoFar(pieces, offset + counted_mm, offset + at_mm[known], deviation[known], int(end["box_boot_id"]))


def along_mm(start: Doc, end: Doc, columns: Doc) -> Any:
    """Where along its own path each reading of a broken run was taken, mm from the path's first point; shape (n,)."""
    since_s = np.asarray(columns["t_s"], dtype=np.float64) - (end["path_start_us"] - start["ctrl0_us"]) * 1e-6
    return since_s * start["path"]["feed_mm_min"] / 60.0


def up_to(record: RunRecord, columns: Doc, to_mm: float) -> Doc:
    """The columns of a broken run as far as they count."""
    offset = float(record.start_doc["path"].get("offset_mm", 0.0))
    counts = offset + along_mm(record.start_doc, record.end_doc or {}, columns) < to_mm
    return {name: [v for v, yes in zip(values, counts, strict=True) if yes] for name, values in columns.items()}


def joined(parts: list[Doc]) -> Doc:
    """Columns one after the other."""
    return {name: [v for part in parts for v in part[name]] for name in parts[-1]}
