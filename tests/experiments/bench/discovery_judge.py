"""Answers to the bench's campaigns counted by the judge of the campaigns (`tests.experiments.campaigns.discovery_judge`), and what they
cost."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from abbe.models.effects.catalogue import CATALOGUE
from tests.experiments.campaigns.discovery_judge import Tally, judge

SCATTER = frozenset(e.name for e in CATALOGUE if e.kind != "mean")
"""Effects that move no reading on average: no column can show them, so a regression cannot name them."""
WITH_COLUMNS = "one effect that has columns"
ROWS = {
    "one effect, snr_total >= 10": "one effect: right name and axis first",
    WITH_COLUMNS: "... of those that move the mean",
    "two effects: both, nothing else": "two effects: both, nothing else",
    "recall of visible effects": "visible effects that are named",
    "null: false alarms": 'nothing hidden: anything but "none"',
    "outside of the catalogue: unknown": 'not in the catalogue: "unknown"',
    "false names": "false names, of all names",
}


def counted(truths: Sequence[dict], answers: Sequence[dict]) -> dict[str, list[int]]:
    """Row: [hits, of]. What is too weak to be asked for counts only by its false names, as in the campaigns."""
    tally = Tally()
    for truth, answer in zip(truths, answers, strict=True):
        judge(tally, truth, answer)
        if truth["kind"] == "single" and truth["effects"][0]["name"] not in SCATTER:
            alone = Tally()
            judge(alone, truth, answer)
            tally.count(WITH_COLUMNS, *alone.counts.get("one effect, snr_total >= 10", (0, 0)))
    return {row: list(tally.counts.get(row, [0, 0])) for row in ROWS}


def costs(runs: Sequence[dict]) -> dict:
    """Middle and largest of processor time per case, and of memory."""
    times = np.array([r["cpu_s"] for r in runs])
    beyond = [r["beyond_mb"] for r in runs]
    peak = [r["process_peak_mb"] for r in runs]
    return {
        "median_s": float(np.median(times)),
        "longest_s": float(times.max()),
        "columns_s": None if runs[0]["columns_s"] is None else float(np.median([r["columns_s"] for r in runs])),
        "clock_s": float(np.median([r["clock_s"] for r in runs])),
        "beyond_mb": None if None in beyond else max(beyond),
        "process_peak_mb": None if None in peak else max(peak),
    }
