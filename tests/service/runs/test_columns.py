"""Raw samples get the position and time at which they were taken."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from abbe.drivers.api import BarSample
from abbe.service.domain.measured import ImportedRun
from abbe.service.errors import MeasurementFault, StoreError
from abbe.service.runs.chunks import BAR_CODEC, JSON_CODEC, encode_bar, encode_json
from abbe.service.runs.columns import load_run, pack_columns, run_document
from abbe.service.storage.store import Store

RATE_HZ = 1000
PERIOD_US = 1000
FEED_MM_MIN = 6000.0
POINTS = [[0.0, 0.0, 0.0], [30.0, 0.0, 0.0], [30.0, 0.0, 0.0], [30.0, 40.0, 0.0], [30.0, 40.0, 30.0]]
PATH_US = 1_000_000
SYNC = 8
MACHINE = {"name": "VMC-1"}
SETUP = {"setup_id": "A", "t_set_s": 3.5, "centre_mm": [0.0, 0.0, 0.0], "radius_mm": 100.0}


def start_doc() -> dict[str, Any]:
    path = {"feed_mm_min": FEED_MM_MIN, "direction": -1, "points_mm": POINTS}
    return {"setup": SETUP, "machine": MACHINE, "ctrl0_us": 5_000_000, "path": path, "rate_hz": RATE_HZ}


def stream(phase_us: int = 300, duration_us: int = PATH_US, idle: int = 20) -> list[BarSample]:
    """Samples whose first one on the path is taken ``phase_us`` after its start; the reading is the true time since the start, in us."""
    samples = []
    for seq in range(2 * idle + duration_us // PERIOD_US):
        since_start_us = (seq - idle) * PERIOD_US + phase_us
        status = SYNC if 0 <= since_start_us < duration_us else 0
        samples.append(BarSample(seq, 10**9 + seq * PERIOD_US, since_start_us, status))
    return samples


def stored(
    store: Store, campaign_id: int, samples: list[BarSample], end: dict[str, Any] | None, status: str = "complete"
) -> dict[str, Any]:
    run_id = store.runs.start(campaign_id, "r01", "ballbar_helix", "identify", start_doc())
    for number, at in enumerate(range(0, len(samples), 100)):
        part = samples[at : at + 100]
        store.chunks.append(run_id, "bar", number, len(part), BAR_CODEC, encode_bar(part), 0.0, 0.0, part[0].device_us, part[-1].device_us)
    if end is not None or status != "running":
        store.runs.finish(run_id, status, "", end)
    run, curve = load_run(store, run_id), load_run(store, run_id, full=False).columns
    for name in ("t_s", "deviation_mm", "valid"):
        assert np.array_equal(getattr(curve, name), getattr(run.columns, name)), "the same readings without positions"
    return run.to_document()


END = {"path_start_us": 8_000_000, "path_end_us": 8_000_000 + PATH_US}


@pytest.fixture
def store(file_store: Store) -> Store:
    return file_store


@pytest.mark.parametrize("phase_us", [0, 300, 999])
def test_position_is_right_within_half_a_period(store: Store, campaign_id: int, phase_us: int) -> None:
    run = stored(store, campaign_id, stream(phase_us), END)
    columns = run["columns"]
    true_s = np.array(columns["deviation_mm"])  # 1 us was written as 1 nm = 1e-6 mm
    assert np.abs(np.array(columns["t_s"]) - 3.0 - true_s).max() <= 0.5 / RATE_HZ + 1e-9
    arc_mm = true_s * FEED_MM_MIN / 60.0
    half_step_mm = FEED_MM_MIN / 60.0 * 0.5 / RATE_HZ
    assert np.abs(np.array(columns["x_mm"]) - np.clip(arc_mm, 0, 30)).max() <= half_step_mm + 1e-9
    assert np.abs(np.array(columns["y_mm"]) - np.clip(arc_mm - 30, 0, 40)).max() <= half_step_mm + 1e-9
    assert np.abs(np.array(columns["z_mm"]) - np.clip(arc_mm - 70, 0, 30)).max() <= half_step_mm + 1e-9


def test_document_is_complete(store: Store, campaign_id: int) -> None:
    run = stored(store, campaign_id, stream(), END)
    assert list(run) == ["format", "campaign", "run_id", "test", "role", "machine", "setup", "columns", "timing"]
    assert (run["format"], run["campaign"], run["run_id"], run["machine"]) == ("abbe-run/1", "c1", "r01", MACHINE)
    columns = run["columns"]
    assert {len(values) for values in columns.values()} == {1000}
    assert set(columns["direction"]) == {-1}
    assert set(columns["feed_mm_min"]) == {6000.0}
    assert (columns["device_seq"][0], columns["device_us"][0], columns["status"][0]) == (20, 10**9 + 20_000, SYNC)
    assert all(type(value) in {int, float} for values in columns.values() for value in values)


def test_flagged_readings_are_not_valid(store: Store, campaign_id: int) -> None:
    samples = stream()
    for bit, at in ((0, 100), (1, 200), (2, 300), (4, 400)):
        old = samples[at]
        samples[at] = BarSample(old.seq, old.device_us, old.reading_nm, old.status | 1 << bit)
    valid = stored(store, campaign_id, samples, END)["columns"]["valid"]
    assert [index + 20 for index, value in enumerate(valid) if not value] == [100, 300, 400]


def test_a_sample_in_between_without_the_sync_line_is_left_out(store: Store, campaign_id: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("abbe.service.runs.sample_columns.BLOCK", 64)
    samples = stream(phase_us=500)
    for at, status in ((400, 0), (500, SYNC | 1)):
        samples[at] = samples[at]._replace(status=status)
    columns = stored(store, campaign_id, samples, END)["columns"]
    assert columns["device_seq"] == [seq for seq in range(20, 1020) if seq != 400]
    assert [seq for seq, valid in zip(columns["device_seq"], columns["valid"], strict=True) if not valid] == [500]
    assert np.allclose(np.array(columns["t_s"]) - 3.0, columns["deviation_mm"], atol=1e-9)


def test_lost_samples_shift_nothing(store: Store, campaign_id: int) -> None:
    samples = stream(phase_us=500)
    kept = [sample for sample in samples if not 300 <= sample.seq < 320]
    columns = stored(store, campaign_id, kept, END)["columns"]
    assert np.allclose(np.array(columns["t_s"]) - 3.0, columns["deviation_mm"], atol=1e-9)
    assert len(columns["t_s"]) == 980


def test_lost_start_is_aligned_by_the_end(store: Store, campaign_id: int) -> None:
    kept = [sample for sample in stream(phase_us=500) if not 15 <= sample.seq < 25]
    columns = stored(store, campaign_id, kept, END)["columns"]
    assert np.allclose(np.array(columns["t_s"]) - 3.0, columns["deviation_mm"], atol=1e-9)


@pytest.mark.parametrize(
    ("samples", "end", "message"),
    [
        (stream(duration_us=900_000), END, "feed changed during the run, or its first or last samples were lost"),
        (
            stream(duration_us=2 * PATH_US),
            {"path_start_us": 0, "path_end_us": 2 * PATH_US},
            "feed changed during the run: the path takes 1.000 s",
        ),
        ([sample for sample in stream() if not sample.status], END, "no ball-bar sample has the sync input set"),
    ],
)
def test_contradicting_durations_are_a_fault(
    store: Store, campaign_id: int, samples: list[BarSample], end: dict[str, Any], message: str
) -> None:
    with pytest.raises(MeasurementFault, match=message):
        stored(store, campaign_id, samples, end)


def test_interrupted_run_gives_what_it_has(store: Store, campaign_id: int) -> None:
    columns = stored(store, campaign_id, stream()[:500], None, "running")["columns"]
    assert len(columns["t_s"]) == 480
    assert columns["t_s"][0] == pytest.approx(3.5 + 0.0005)
    assert columns["x_mm"][-1] == pytest.approx(30.0)


def test_aborted_run_keeps_its_clock(store: Store, campaign_id: int) -> None:
    columns = stored(store, campaign_id, stream()[:500], {"path_start_us": 8_000_000}, "aborted")["columns"]
    assert columns["t_s"][0] == pytest.approx(3.0 + 0.0005)


def test_run_without_samples_is_empty(store: Store, campaign_id: int) -> None:
    columns = stored(store, campaign_id, [], None, "failed")["columns"]
    assert all(values == [] for values in columns.values())


def laser_record(ctrl_us: int, x_mm: float, tenth_nm: int, status: int = 4) -> dict[str, Any]:
    record = {"host_s": 0.0, "ctrl_us": ctrl_us, "target_mm": [x_mm, 5.0, 0.0], "direction": 1, "displacement_tenth_nm": tenth_nm}
    return record | {"status": status, "signal_permille": 900, "air_temp_c": 20.5, "air_pressure_pa": 101325.0, "feed_mm_min": 1000.0}


def test_laser_columns(store: Store, campaign_id: int) -> None:
    start = {"setup": {"setup_id": "L", "t_set_s": 0.0, "nominal_beam": [1.0, 0.0, 0.0]}, "machine": MACHINE, "ctrl0_us": 1_000_000}
    run_id = store.runs.start(campaign_id, "r02", "laser_linear", "holdout", start)
    records = [laser_record(1_000_000, 10.0, 50), laser_record(2_000_000, 20.0, 100_000_060), laser_record(3_500_000, 30.0, 7, status=1)]
    store.chunks.append(run_id, "laser", 0, 2, JSON_CODEC, encode_json(records[:2]), 0.0, 0.0, 0, 0)
    store.chunks.append(run_id, "laser", 1, 1, JSON_CODEC, encode_json(records[2:]), 0.0, 0.0, 0, 0)
    store.runs.finish(run_id, "complete", "", {})
    columns = load_run(store, "r02").columns.to_document()
    assert columns["t_s"] == [0.0, 1.0, 2.5]
    assert columns["x_mm"] == [10.0, 20.0, 30.0]
    assert columns["deviation_mm"][:2] == pytest.approx([0.0, 1e-6])
    assert columns["valid"] == [1, 1, 0]
    assert columns["temp_air_C"] == [20.5] * 3
    assert columns["pressure_air_Pa"] == [101325.0] * 3


@pytest.mark.parametrize("key", ["air_temp_c", "air_pressure_pa", "feed_mm_min"])
def test_a_laser_record_without_a_number_is_refused_it_does_not_become_nan(store: Store, campaign_id: int, key: str) -> None:
    start = {"setup": {"setup_id": "L", "t_set_s": 0.0, "nominal_beam": [1.0, 0.0, 0.0]}, "machine": MACHINE, "ctrl0_us": 1_000_000}
    run_id = store.runs.start(campaign_id, "r02", "laser_linear", "holdout", start)
    damaged = encode_json([laser_record(1_000_000, 10.0, 50) | {key: None}])
    store.chunks.append(run_id, "laser", 0, 1, JSON_CODEC, damaged, 0.0, 0.0, 0, 0)
    store.runs.finish(run_id, "complete", "", {})
    with pytest.raises(StoreError, match="its documents have a missing or invalid field"):
        load_run(store, "r02")


def test_imported_run_comes_back_as_it_was(store: Store) -> None:
    columns = {"t_s": [0, 1.0], "x_mm": [0, 0], "y_mm": [0, 0], "z_mm": [1, 2.5], "feed_mm_min": [100, 100], "direction": [1, 1]}
    columns |= {"load_percent": [1e-05, 3], "temp_air_C": None, "deviation_mm": None}
    run = {"format": "abbe-run/1", "mystery": {"a": [1]}, "columns": None, "run_id": "r01", "zeta": None}
    run |= {"test": "laser_linear", "role": "sealed", "setup": {"setup_id": "L", "t_set_s": 0, "note": "by hand"}}
    packed = encode_json(pack_columns(columns))
    store.runs.import_campaign(
        ("m", {}), ("c9", {}), [ImportedRun("r01", "laser_linear", "sealed", {"imported": run}, 2, JSON_CODEC, packed)]
    )
    record = store.runs.find("c9/r01")
    read = load_run(store, "c9/r01")
    back = run_document(read, record, store.chunks.of_run(record.id))
    assert json.dumps(back) == json.dumps(run | {"columns": columns})
    assert read.is_sealed
    assert read.columns.further["load_percent"].tolist() == [1e-05, 3.0]
    assert read.setup.document == run["setup"]


def test_documents_of_strangers_give_one_error(store: Store, campaign_id: int) -> None:
    run_id = store.runs.start(campaign_id, "r01", "ballbar_helix", "identify", {"machine": {}})
    with pytest.raises(StoreError, match="c1/r01: its documents have a missing or invalid field: 'path'"):
        load_run(store, run_id)
    store.chunks.append(run_id, "bar", 0, 1, "bar/9", b"", 0.0, 0.0, 0, 0)
    with pytest.raises(StoreError, match="unknown codec 'bar/9'"):
        load_run(store, run_id)


@pytest.mark.parametrize("lost", ["rate_hz", "ctrl0_us", "machine", "setup"])
def test_a_start_document_that_lost_a_field_is_refused_not_read_with_a_default(store: Store, campaign_id: int, lost: str) -> None:
    doc = start_doc()
    del doc[lost]
    run_id = store.runs.start(campaign_id, "r01", "ballbar_helix", "identify", doc)
    part = stream()
    store.chunks.append(run_id, "bar", 0, len(part), BAR_CODEC, encode_bar(part), 0.0, 0.0, part[0].device_us, part[-1].device_us)
    store.runs.finish(run_id, "complete", "", END)
    with pytest.raises(StoreError, match="its documents have a missing or invalid field"):
        load_run(store, run_id)


def test_an_end_document_without_the_start_of_its_path_is_refused(store: Store, campaign_id: int) -> None:
    with pytest.raises(StoreError, match="missing or invalid field: 'path_start_us'"):
        stored(store, campaign_id, stream(), {"path_end_us": END["path_end_us"]})


def test_a_start_document_of_other_types_gives_one_error(store: Store, campaign_id: int) -> None:
    run_id = store.runs.start(campaign_id, "r01", "ballbar_helix", "identify", start_doc() | {"rate_hz": "fast"})
    with pytest.raises(StoreError, match="c1/r01: its documents have a missing or invalid field"):
        load_run(store, run_id)


def test_a_set_up_was_mounted_when_the_end_document_says(store: Store) -> None:
    campaign = store.campaigns.add(store.machines.add("m", MACHINE), "c", {})
    run = stored(store, campaign, stream(), END | {"mounted_us": 7_250_000})
    assert run["setup"] == SETUP | {"t_set_s": 2.25}
    other = store.campaigns.add(store.machines.add("m", MACHINE), "d", {})
    assert stored(store, other, stream(), END)["setup"]["t_set_s"] == 3.5  # it was mounted before, or nobody noted it
