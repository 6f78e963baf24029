"""The clocks of a ball-bar run: the rate of the box's clock against the controller's, and the agreement of sync line and arrivals.

If the box has a sync line, its two edges tie its clock to the controller's. The stamps and arrivals of both streams are an independent
check by way of this computer's clock; a disagreement is reported. Arrival times are used for nothing else.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from abbe.models.alignment.clock import LEAST_PAIRS, ClockFit, across, breaks, fit_clock, relative_rate
from abbe.models.arrays import F1
from abbe.service.domain.document import Doc
from abbe.service.domain.measured import ChunkRecord
from abbe.service.domain.run_start import RunEnd

U_DELAY_S = 2e-3
"""Standard uncertainty of a link's least delay, which arrivals do not show: 0 to 7 ms in the adapter and the operating system."""
COLLECTS_MS = 16
"""Time for which a serial adapter collects bytes, possibly in step with the samples."""
SURE = 3.0
"""A drift or a disagreement counts from this multiple of its standard uncertainty."""


@dataclass(frozen=True, slots=True)
class RunClock:
    """Seconds of the controller per second of the box, its standard uncertainty, and the ``timing`` document of the run."""

    rate: float
    u_rate: float
    doc: Doc


@dataclass(frozen=True, slots=True)
class Edges:
    """Edges of the sync line: box time of the first and last sample with the line set, and the sample period.

    ``whole``: the samples next to both edges exist; otherwise an edge fell into a gap of the stream and cannot be used.
    """

    first_us: int
    last_us: int
    period_s: float
    whole: bool = True


def run_clock(chunks: Sequence[ChunkRecord], end: RunEnd, edges: Edges) -> RunClock:
    """Rate of the box's clock against the controller's, from the sync line or the arrivals, whichever has the smaller uncertainty.

    A drift below `SURE` standard uncertainties is not corrected; ``u_rate`` covers it.
    """
    found = _fits(chunks, end, edges.period_s)
    doc: Doc = {}
    tries: list[tuple[float, float, str]] = []
    path_us = end.path_us
    if edges.whole and path_us is not None and edges.last_us > edges.first_us:
        recorded_s = (edges.last_us - edges.first_us) * 1e-6 + edges.period_s
        run_s = (path_us[1] - path_us[0]) * 1e-6
        tries.append((run_s / recorded_s, float(np.sqrt(1.0 / 6.0)) * edges.period_s / recorded_s, "sync line"))
    if isinstance(found, tuple):
        tries.append((*relative_rate(*found), "arrivals"))
        doc |= _compared(found, end, edges)
    elif found:
        doc["trouble"] = found
    if not tries:
        return RunClock(1.0, 0.0, doc | {"rate_from": "nothing: taken to be equal"})
    rate, u, source = min(tries, key=lambda one: one[1])
    doc |= {"box_slower_ppm": (rate - 1.0) * 1e6, "u_box_slower_ppm": u * 1e6, "rate_from": source}
    used = rate if abs(rate - 1.0) > SURE * u else 1.0
    return RunClock(used, u, doc | {"corrected_ppm": (used - 1.0) * 1e6})


def _fits(chunks: Sequence[ChunkRecord], end: RunEnd, period_s: float) -> tuple[ClockFit, ClockFit] | str:
    """Fits of the box's and the controller's clock to this computer's; a text if a clock jumped, empty with too few pairs."""
    box = np.array([(c.last_device_us * 1e-6, c.last_host_s) for c in chunks], dtype=np.float64).reshape(-1, 2)
    cnc = np.array(end.clock_pairs, dtype=np.float64).reshape(-1, 2) * [1e-6, 1.0]
    for name, pairs in (("ball-bar's box", box), ("controller", cnc)):
        if len(pairs) < LEAST_PAIRS:
            return ""
        for one in breaks(pairs[:, 0], pairs[:, 1]):
            what = "started anew" if one.kind == "restart" else f"was set by {one.step_s * 1e3:.0f} ms"
            return f"the clock of the {name} {what} during the run"
    return _fit(box, 1e-3 * math.gcd(round(period_s * 1e3), COLLECTS_MS)), _fit(cnc, 0.0)


def _fit(pairs: Any, grid_s: float) -> ClockFit:
    return fit_clock(pairs[:, 0], pairs[:, 1], u_delay_s=U_DELAY_S, grid_s=grid_s)


def _compared(fits: tuple[ClockFit, ClockFit], end: RunEnd, edges: Edges) -> Doc:
    """Edges by the arrivals minus edges by the controller, ms of controller time.

    Positive: the arrivals date the edge later than the controller does, so by them the path began (or ended) earlier.
    """
    doc: Doc = {"box_drift_ppm": fits[0].drift_ppm, "controller_drift_ppm": fits[1].drift_ppm}
    path_us = end.path_us
    if path_us is None or not edges.whole:
        return doc
    half = 0.5 * edges.period_s
    at: F1 = np.array([edges.first_us * 1e-6 - half, edges.last_us * 1e-6 + half])
    there, u = across(*fits, at)
    off = there - np.array(path_us) * 1e-6
    u = np.hypot(u, edges.period_s / np.sqrt(12.0))
    doc |= {"sync_start_ms": float(off[0]) * 1e3, "sync_end_ms": float(off[1]) * 1e3, "u_sync_ms": float(u.max()) * 1e3}
    if (np.abs(off) > SURE * u).any():
        worst = int(np.argmax(np.abs(off) / u))
        edge = ("begins", "ends")[worst]
        later = "earlier" if off[worst] > 0.0 else "later"
        by, u_ms = abs(off[worst]) * 1e3, u[worst] * 1e3
        doc["trouble"] = f"by stamps and arrivals the path {edge} {by:.0f} ms {later} than by the sync line (u = {u_ms:.0f} ms)"
    return doc
