"""Times of a run: the box's clock drifts, adapters batch, UTC jumps; the sync line and the arrivals are held against each other."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from abbe.drivers.api import BarSample
from abbe.service.campaign_data.campaign_checks import time_issues
from abbe.service.devices.session import KEPT, noted, notes_since
from abbe.service.domain.measured import ChunkRecord, Owner, RunRecord
from abbe.service.domain.run import Run
from abbe.service.runs.chunks import BAR_CODEC, encode_bar
from abbe.service.runs.columns import single_run

RATE_HZ = 100
FEED_MM_S = 20.0
SECONDS = 100.0
START_US = 8_000_000
MACHINE = {"name": "VMC-1"}
SYNC = 8


def start_doc() -> dict[str, Any]:
    points = [[0.0, 0.0, 0.0], [FEED_MM_S * SECONDS, 0.0, 0.0]]
    path = {"feed_mm_min": 60.0 * FEED_MM_S, "direction": 1, "points_mm": points}
    return {
        "setup": {"setup_id": "A", "t_set_s": 3.5, "centre_mm": [0.0, 0.0, 0.0], "radius_mm": 100.0},
        "machine": MACHINE,
        "ctrl0_us": 5_000_000,
        "path": path,
        "rate_hz": RATE_HZ,
    }


def measured(
    *,
    drift_ppm: float,
    sync_late_s: float = 0.0,
    jump: int = 0,
    pairs_kept: int = 600,
    utc: str = "2026-06-01",
) -> Any:
    """A run whose box runs fast by ``drift_ppm``; its reading is the true time since the path began, in us."""
    rng = np.random.default_rng(3)
    host0, phase_s, batch_s = 1000.0, 0.004, 0.016
    n = int((SECONDS + 2.0) * RATE_HZ)
    since = np.arange(n) / RATE_HZ / (1.0 + drift_ppm * 1e-6) - 1.0 + phase_s  # true seconds since the path began
    device_us = 10**9 + np.arange(n) * (1_000_000 // RATE_HZ)
    level = (since >= sync_late_s) & (since < SECONDS + sync_late_s)
    status = np.where(level, SYNC, 0)
    samples = [BarSample(k, int(device_us[k]), round(since[k] * 1e6), int(status[k])) for k in range(n)]
    flush = host0 - 1.5 + np.cumsum(batch_s + rng.normal(0.0, 3e-4, int(SECONDS / batch_s) + 400))
    arrived = flush[np.searchsorted(flush, host0 + since + 5e-4)]
    doc = start_doc() | {"clock": {"utc": f"{utc}T10:00:00+00:00", "host_s": host0 - 2.0, "ctrl_us": START_US - 2_000_000}}
    edges = np.flatnonzero(np.diff(arrived) > 0.0) + 1
    parts = np.split(np.arange(n), edges)
    joined = [np.concatenate(parts[k : k + 3]) for k in range(0, len(parts), 3)]
    chunks: list[ChunkRecord] = []
    for number, part in enumerate(joined):
        some = [samples[k] for k in part]
        host = float(arrived[part[0]]), float(arrived[part[-1]])
        ends = some[0].device_us, some[-1].device_us
        chunks.append(ChunkRecord(1, "bar", number, len(some), BAR_CODEC, 0, encode_bar(some), *host, *ends))
    polls = np.sort(rng.uniform(-0.5, SECONDS + 0.5, 600))
    pairs = [[START_US + p * 1e6, host0 + p + 4e-4 + rng.exponential(3e-4)] for p in polls]
    if jump:
        pairs[jump:] = [[c - 2e6, h] for c, h in pairs[jump:]]
    end = {
        "path_start_us": START_US,
        "path_end_us": START_US + int(SECONDS * 1e6),
        "clock_pairs": pairs[:pairs_kept],
        "ended_utc": "2025-06-01T10:00:00",
    }
    owner = Owner("", 0, "")
    known = {"campaign": "c1", "label": "r01", "test": "ballbar_helix", "role": "identify", "status": "complete", "reason": ""}
    known |= {"start_doc": doc, "end_doc": end, "started_utc": utc, "ended_utc": utc}
    return single_run(RunRecord(id=1, campaign_id=1, owner=owner, **known), chunks).to_document()


@pytest.mark.parametrize("drift_ppm", [0.0, 100.0, -100.0, 1000.0, -1000.0])
def test_every_reading_is_where_the_machine_was_although_the_boxs_clock_drifts(drift_ppm):
    run = measured(drift_ppm=drift_ppm)
    true_s = np.array(run["columns"]["deviation_mm"])
    error_s = np.array(run["columns"]["t_s"]) - 3.0 - true_s
    assert np.abs(error_s).max() < 0.5 / RATE_HZ + 1e-3  # half a sample period of the sync line, and no more at the end than at the start
    assert np.abs(np.array(run["columns"]["x_mm"]) - FEED_MM_S * true_s).max() < FEED_MM_S * (0.5 / RATE_HZ + 1e-3)
    timing = run["timing"]
    assert timing["box_slower_ppm"] == pytest.approx(-drift_ppm, abs=3.0 * timing["u_box_slower_ppm"] + 1.0)
    assert timing["u_box_slower_ppm"] < 20.0  # the edges of the sync line alone: 41 ppm
    assert timing["rate_from"] == "arrivals"
    assert "trouble" not in timing
    assert timing["u_sync_ms"] < 5.0


@pytest.mark.parametrize(("late_s", "says"), [(0.05, "earlier than the sync line shows"), (-0.05, "later than the sync line shows")])
def test_a_sync_line_that_is_late_is_held_against_the_arrivals_and_said(late_s, says):
    run = measured(drift_ppm=100.0, sync_late_s=late_s)
    assert says in run["timing"]["trouble"]
    assert run["timing"]["sync_start_ms"] == pytest.approx(1e3 * late_s, abs=8.0)
    (flag,) = [f for f in time_issues([Run.from_document(run)]) if "sync line" in f.what]
    assert not flag.refuse


def test_a_clock_that_is_set_during_the_run_is_said_and_not_used():
    run = measured(drift_ppm=100.0, jump=300)
    assert run["timing"]["trouble"].startswith("the clock of the controller")
    assert run["timing"]["rate_from"] == "sync line"


def test_utc_that_jumps_by_a_year_either_way_moves_no_sample():
    now, late, early = (measured(drift_ppm=100.0, utc=day) for day in ("2026-06-01", "2027-06-02", "2025-05-30"))
    assert now["columns"] == late["columns"] == early["columns"]


def test_without_arrivals_the_sync_lines_two_edges_tell_the_drift():
    timing = measured(drift_ppm=1000.0, pairs_kept=0)["timing"]
    assert timing["rate_from"] == "sync line"
    assert timing["corrected_ppm"] == pytest.approx(-1000.0, abs=120.0)


def test_the_promptest_status_of_each_stretch_is_kept():
    class Quick:
        async def status(self) -> Any:
            raise AssertionError

    controller: Any = noted(Quick())
    controller.clock_notes.extend((k * 1000, 1e-3 * k + (0.0 if k % 40 == 7 else 0.01)) for k in range(40 * KEPT))
    kept = notes_since(controller, 0)
    assert len(kept) == KEPT
    assert all(h - 1e-6 * c < 1e-9 for c, h in kept)
    assert notes_since(controller, 39 * KEPT * 1000)[0][0] >= 39 * KEPT * 1000
