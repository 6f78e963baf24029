"""Paths measured in pieces: the progress of an interrupted run, and the readings of each piece that are used."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from abbe.models.arrays import F1
from abbe.service.domain.measured import RunEnd, RunPiece, RunRecord, RunStart
from abbe.service.domain.run import Columns

STRETCH_S, STRETCH_MM = 0.5, 5.0
"""Duration and least length of the stretch that a resumed path reads a second time, to compare both readings."""
LEAST_READINGS = 5
MOST_LOST = 1e-3


@dataclass(frozen=True, slots=True, kw_only=True)
class PathReadings:
    """Readings of a path before its interruption: its valid ``pieces``, and the readings that the rest is compared with.

    ``arc_mm`` and ``deviation_mm``, shape (n,): position along the path and reading, mm; ``boot_id``: boot id of the ball-bar's box.
    """

    pieces: tuple[RunPiece, ...]
    arc_mm: F1
    deviation_mm: F1
    boot_id: int


@dataclass(frozen=True, slots=True, kw_only=True)
class ReadProgress(PathReadings):
    """Progress of a path: its pieces, the last one up to the end of its constant feed, and the readings of the last piece.

    ``counted_from_mm``: start of the counted part of the last piece; ``arc_mm`` counts along the whole path.
    """

    counted_from_mm: float


def progress_of(record: RunRecord, columns: Columns) -> ReadProgress | None:
    """Return the progress of an interrupted run with these columns; None if the path cannot be resumed from it."""
    start, end = record.start, record.end
    path = start.path
    if path is None or end.good_us is None or end.path_start_us is None or end.box_boot_id is None:
        return None
    good_mm, counted_mm = (end.good_us - end.path_start_us) * 1e-6 * path.feed_mm_s, path.counted_mm[0]
    at_mm = along_mm(start, end, columns)[columns.valid]
    seq = columns.further["device_seq"]
    lost = int(seq[-1] - seq[0]) % 2**32 + 1 - seq.size if seq.size else 0
    if lost > max(1.0, MOST_LOST * seq.size):
        return None  # such a loss ends a run (abbe.service.capture), so pieces must not have it either
    known = at_mm <= good_mm
    good_mm = float(at_mm[known].max(initial=0.0))  # the bar may have left its range before the feed changed
    if good_mm - counted_mm < max(STRETCH_MM, STRETCH_S * path.feed_mm_s) or int(known.sum()) < LEAST_READINGS:
        return None
    pieces = (*path.pieces, RunPiece(record.id, path.offset_mm + good_mm))
    read_mm = columns.readings_mm[columns.valid]
    return ReadProgress(
        pieces=pieces,
        counted_from_mm=path.offset_mm + counted_mm,
        arc_mm=path.offset_mm + at_mm[known],
        deviation_mm=read_mm[known],
        boot_id=end.box_boot_id,
    )


def along_mm(start: RunStart, end: RunEnd, columns: Columns) -> F1:
    """Return the position of each reading of an interrupted run along its own path, mm from the first point, shape (n,).

    Raises
    ------
    KeyError
        The documents do not state when the path began.
    """
    if end.path_start_us is None:
        raise KeyError("path_start_us")
    return np.asarray((columns.t_s - start.since_zero_s(end.path_start_us)) * start.commanded.feed_mm_min / 60.0)


def counted_columns(record: RunRecord, columns: Columns, to_mm: float) -> Columns:
    """Return the readings of an interrupted run that are used: those before position ``to_mm`` on the whole path."""
    start = record.start
    return columns.rows(start.commanded.offset_mm + along_mm(start, record.end, columns) < to_mm)
