"""Ball-bar readings at standstill become columns: one row for each point, the mean of the samples that were taken there."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from abbe.service.storage.records import Doc

INVALID_BITS = 0b10101


def bar_point_columns(records: Sequence[dict[str, Any]], start: Doc) -> Doc:
    """Turn the records of a point-by-point ball-bar test into columns.

    Parameters
    ----------
    records : sequence of dict
        ``ctrl_us`` (controller time, after the axes had settled), ``target_mm``, ``direction``, ``feed_mm_min``, and for every sample
        ``device_us``, ``reading_nm``, ``status``; in order.
    start : dict
        Start document (abbe.service.runs.columns).

    Returns
    -------
    dict
        Columns of ``abbe-run/1`` and ``reading_u_mm`` (standard uncertainty of each mean), ``samples_count``, ``device_us`` of the first
        sample.
    """
    means = [np.mean(one["reading_nm"]) * 1e-6 for one in records]
    return {
        "t_s": [(one["ctrl_us"] - start["ctrl0_us"]) * 1e-6 for one in records],
        **{f"{axis}_mm": [float(one["target_mm"][index]) for one in records] for index, axis in enumerate("xyz")},
        "feed_mm_min": [float(one["feed_mm_min"]) for one in records],
        "direction": [int(one["direction"]) for one in records],
        "deviation_mm": [float(m) for m in means],
        "valid": [0 if any(s & INVALID_BITS for s in one["status"]) else 1 for one in records],
        "reading_u_mm": [_u_mm(one["reading_nm"]) for one in records],
        "samples_count": [len(one["reading_nm"]) for one in records],
        "device_us": [int(one["device_us"][0]) for one in records],
    }


def _u_mm(reading_nm: Sequence[int]) -> float:
    n = len(reading_nm)
    return float(np.std(reading_nm, ddof=1) * 1e-6 / np.sqrt(n)) if n > 1 else 0.0
