"""Convert laser records to columns: displacement along the beam minus the nominal displacement of the commanded positions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from abbe.drivers.flags import beam_is_gone
from abbe.service.domain.run import Columns
from abbe.service.domain.run_start import RunStart

MM_PER_COUNT = 1e-7
"""The displacement counts tenths of a nanometre."""


def laser_columns(records: Sequence[dict[str, Any]], start: RunStart) -> Columns:
    """Convert laser records to columns.

    Parameters
    ----------
    records : sequence of dict
        ``host_s``, ``ctrl_us``, ``target_mm`` [x, y, z], ``direction``, ``displacement_tenth_nm``, ``status``, ``signal_permille``,
        ``air_temp_c``, ``air_pressure_pa``, ``feed_mm_min``; one for each standstill, in order. ``missing``: no reading at that standstill.
    start : RunStart
        Its set-up states the beam.

    Returns
    -------
    Columns
        With ``status``, ``signal_permille``. Deviations count from the first record, or from the laser's zero if
        that record is missing. A missing reading is a row with the commanded position, deviation 0 and ``valid`` 0, so that later rows keep
        their places.
    """
    first = records[0] if records else {}
    beam = start.setup["nominal_beam"]
    return Columns(
        t_s=np.array([start.since_zero_s(one["ctrl_us"]) for one in records], dtype=np.float64),
        q_mm=np.array([one["target_mm"] for one in records], dtype=np.float64).reshape(-1, 3),
        feed_mm_min=np.array([one["feed_mm_min"] for one in records], dtype=np.float64),
        direction=np.array([one["direction"] for one in records], dtype=np.float64),
        deviation_mm=np.array([_deviation_mm(one, first, beam) for one in records], dtype=np.float64),
        valid=np.array([not (one.get("missing") or beam_is_gone(one["status"])) for one in records], dtype=np.bool_),
        further={
            "temp_air_C": np.array([one["air_temp_c"] for one in records], dtype=np.float64),
            "pressure_air_Pa": np.array([one["air_pressure_pa"] for one in records], dtype=np.float64),
            "status": np.array([one["status"] for one in records], dtype=np.int64),
            "signal_permille": np.array([one["signal_permille"] for one in records], dtype=np.int64),
        },
    )


def _deviation_mm(one: dict[str, Any], first: dict[str, Any], beam: Sequence[float]) -> float:
    if one.get("missing"):
        return 0.0
    nominal_mm = sum(b * (now - before) for b, now, before in zip(beam, one["target_mm"], first["target_mm"], strict=True))
    return float((one["displacement_tenth_nm"] - first["displacement_tenth_nm"]) * MM_PER_COUNT - nominal_mm)
