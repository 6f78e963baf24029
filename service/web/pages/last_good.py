"""The last check that passed, for the live screen, which shows it in grey below the path that is being recorded."""

from __future__ import annotations

import numpy as np

from abbe.service.domain.document import Doc
from abbe.service.errors import AbbeError
from abbe.service.queries.checks import last_good, latest_checks
from abbe.service.queries.reader import Reader
from abbe.service.runs.columns import load_run

LOOK_BACK = 200
"""Number of earlier checks among which the last good one is searched."""
PARTS = 720
NO_SHAPE: Doc = {"check": None, "values": []}


def last_good_shape(reader: Reader, recipe: str, label: str) -> Doc:
    """Mean deviation, µm, in each of at most `PARTS` equal parts of a run of the last good check; empty without such a check."""
    good = last_good(latest_checks(reader, LOOK_BACK), recipe)
    if good is None or not good.campaign or label not in good.runs:
        return NO_SHAPE
    try:
        campaign = reader.store.campaigns.find(good.campaign)
        run = next((r for r in reader.store.runs.all(campaign.id) if r.label == label and r.visible_status == "complete"), None)
        columns = None if run is None else load_run(reader.store, run.id).columns
    except AbbeError:
        return NO_SHAPE
    if columns is None or columns.deviation_mm is None or not columns.t_s.size:
        return NO_SHAPE
    t_s, deviation_um = columns.t_s, 1e3 * columns.deviation_mm
    good_ones = columns.valid & np.isfinite(deviation_um)
    parts = min(PARTS, -(-t_s.size // 2))
    share = (t_s - t_s[0]) / max(float(t_s[-1] - t_s[0]), 1e-9)
    part = np.minimum((share * parts).astype(int), parts - 1)[good_ones]
    count = np.bincount(part, minlength=parts)
    total = np.bincount(part, deviation_um[good_ones], minlength=parts)
    return {"check": good.id, "values": [float(f"{v / n:.4g}") if n else None for v, n in zip(total, count, strict=True)]}
