"""A path measured in pieces: the progress of interrupted runs, and joining their readings with those of the last run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from abbe.models.arrays import F1
from abbe.service.domain.document import Doc
from abbe.service.domain.measured import RunRecord
from abbe.service.domain.run import Columns

STRETCH_S, STRETCH_MM = 0.5, 5.0
"""Duration, and least length, of the stretch that is read twice."""
LEAST_READINGS = 5
MOST_LOST = 1e-3


@dataclass(frozen=True, slots=True)
class RunPiece:
    """An interrupted run, and the position on the whole path up to which its readings count, mm from the first point."""

    run: int
    to_mm: float


@dataclass(frozen=True, slots=True)
class ReadProgress:
    """Progress of a path: its pieces, the last one up to the end of its constant feed, and the readings of the last piece.

    ``counted_from_mm``: start of the counted part of the last piece; ``arc_mm`` and ``deviation_mm``, shape (n,): position along the whole
    path and reading; ``boot_id``: of the box.
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
    """The interrupted runs whose readings belong to a run, oldest first; empty for a run without interruption."""
    return tuple(RunPiece(int(one["run"]), float(one["to_mm"])) for one in (start.get("path") or {}).get("pieces", []))


def progress_of(record: RunRecord, columns: Columns) -> ReadProgress | None:
    """Progress of an interrupted run with these columns; None if the path cannot be resumed from it."""
    path, end = record.start_doc.get("path"), record.end_doc or {}
    if not path or "good_us" not in end or "box_boot_id" not in end:
        return None
    feed_mm_s, offset = path["feed_mm_min"] / 60.0, float(path.get("offset_mm", 0.0))
    good_mm = (end["good_us"] - end["path_start_us"]) * 1e-6 * feed_mm_s
    arc = arc_of(path["points_mm"])
    counted_mm = float(arc[path["measured"][0]]) if path.get("measured") else 0.0
    at_mm = along_mm(record.start_doc, end, columns)[columns.valid]
    seq = columns.further["device_seq"]
    lost = int(seq[-1] - seq[0]) % 2**32 + 1 - seq.size if seq.size else 0
    if lost > max(1.0, MOST_LOST * seq.size):
        return None  # such a loss ends a run (abbe.service.capture), so pieces must not have it either
    known = at_mm <= good_mm
    good_mm = float(at_mm[known].max(initial=0.0))  # the bar may have left its range before the feed changed
    if good_mm - counted_mm < max(STRETCH_MM, STRETCH_S * feed_mm_s) or int(known.sum()) < LEAST_READINGS:
        return None
    pieces = (*pieces_of(record.start_doc), RunPiece(record.id, offset + good_mm))
    deviation = columns.readings_mm[columns.valid]
    return ReadProgress(pieces, offset + counted_mm, offset + at_mm[known], deviation[known], int(end["box_boot_id"]))


def along_mm(start: Doc, end: Doc, columns: Columns) -> F1:
    """Position of each reading of an interrupted run along its own path, mm from the first point, shape (n,)."""
    since_s = columns.t_s - (end["path_start_us"] - start["ctrl0_us"]) * 1e-6
    return np.asarray(since_s * float(start["path"]["feed_mm_min"]) / 60.0)


def counted_columns(record: RunRecord, columns: Columns, to_mm: float) -> Columns:
    """The columns of an interrupted run before ``to_mm`` on the whole path."""
    offset = float(record.start_doc["path"].get("offset_mm", 0.0))
    return columns.rows(offset + along_mm(record.start_doc, record.end_doc or {}, columns) < to_mm)
