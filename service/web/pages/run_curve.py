"""The readings of a run for the script that zooms: the least and the largest of each part of the shown time, so that no peak is lost."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from abbe.models.arrays import F1
from abbe.service.domain.document import Doc
from abbe.service.runs.columns import load_run
from abbe.service.storage.store import Store
from abbe.service.web.frame import current
from abbe.service.web.pages.runs import readings_of

NOTHING: Doc = {"x": [], "low": [], "high": [], "whole": [0.0, 0.0], "readings": 0}
PARTS = 1000
"""Number of parts, about as many as a screen has columns; if the shown time has fewer than twice as many readings, all are sent."""


def envelope(x: F1, y: F1, low: float, high: float) -> tuple[F1, F1, F1]:
    """Middle, least and largest reading of each part of ``x`` from ``low`` to ``high``; the readings themselves if there are few.

    ``x``: ascending, shape (n,). The last reading before and the first one after are included, so that lines reach the edges.
    """
    first = max(int(np.searchsorted(x, low)) - 1, 0)
    last = min(int(np.searchsorted(x, high, side="right")) + 1, len(x))
    x, y = x[first:last], y[first:last]
    if len(x) <= 2 * PARTS:
        return x, y, y
    begins = np.linspace(0, len(x), PARTS, endpoint=False).astype(int)
    ends = np.append(begins[1:], len(x)) - 1
    return (x[begins] + x[ends]) / 2.0, np.minimum.reduceat(y, begins), np.maximum.reduceat(y, begins)


def run_curve(store: Store, number: int, low: float, high: float) -> Doc:
    """Deviation in the reader's unit against time, as read. Raises NotStored, StoreError, MeasurementFault."""
    samples = readings_of(store, number)
    shown = _overview(store, number, samples)
    if not shown.readings:  # sealed: its readings are not here
        return NOTHING
    x, least, largest = shown.drawn
    if low > shown.whole[0] or high < shown.whole[1]:
        t_s, deviation_mm = _readings(store, number, samples)
        x, least, largest = envelope(t_s, deviation_mm, max(low, shown.whole[0]), min(high, shown.whole[1]))
    scale = 1e3 / current().drawn().size
    return {
        "x": [float(f"{v:.9g}") for v in x],
        "low": [float(f"{v:.5g}") for v in least * scale],
        "high": [float(f"{v:.5g}") for v in largest * scale],
        "whole": list(shown.whole),
        "readings": shown.readings,
    }


@dataclass(frozen=True, slots=True)
class _Overview:
    """A whole run as a screen shows it: its envelope, its first and last time in s, and the number of its readings."""

    drawn: tuple[F1, F1, F1]
    whole: tuple[float, float]
    readings: int


@lru_cache(64)
def _overview(store: Store, number: int, samples: int) -> _Overview:
    """Overview of a run, cached for runs shown lately. ``samples``: their number so far; a new number makes a new overview."""
    t_s, deviation_mm = _readings(store, number, samples)
    if not len(t_s):
        return _Overview((t_s, t_s, t_s), (0.0, 0.0), 0)
    whole = float(t_s[0]), float(t_s[-1])
    return _Overview(envelope(t_s, deviation_mm, *whole), whole, len(t_s))


@lru_cache(1)
def _readings(store: Store, number: int, _samples: int) -> tuple[F1, F1]:
    """The valid readings of the run on the screen, cached until it has more samples."""
    columns = load_run(store, number, full=False).columns
    deviation_mm = np.empty(0) if columns.deviation_mm is None else columns.deviation_mm
    t_s = columns.t_s[: deviation_mm.size]
    good = columns.valid[: deviation_mm.size] & np.isfinite(deviation_mm)
    if not good.all():
        t_s, deviation_mm = t_s[good], deviation_mm[good]
    if (t_s[1:] < t_s[:-1]).any():
        order = np.argsort(t_s, kind="stable")
        t_s, deviation_mm = t_s[order], deviation_mm[order]
    return t_s, deviation_mm
