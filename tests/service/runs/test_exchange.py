"""Exchange files: what is good goes in and comes out again; what is not gets one line and changes nothing."""

from __future__ import annotations

import json
import math
import tarfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from abbe.drivers.api import BarSample
from abbe.service.errors import FileFormatError, StoreError
from abbe.service.runs.checks import UNITS, read_json
from abbe.service.runs.chunks import BAR_CODEC, encode_bar
from abbe.service.runs.columns import load_run, run_document
from abbe.service.runs.exchange import export_folder, import_folder, read_folder
from abbe.service.storage.store import Store

Change = Callable[[dict[str, Any]], object]


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def assert_round_trip(source: Path, tmp_path: Path) -> None:
    name = read_folder(source).campaign["campaign"]
    with Store.open("sqlite://") as store:
        import_folder(store, source)
        first = export_folder(store, name, tmp_path / "first")
        assert {path.name: read_json(path) for path in first.iterdir()} == {path.name: read_json(path) for path in source.iterdir()}
    with Store.open("sqlite://") as store:
        import_folder(store, first)
        second = export_folder(store, name, tmp_path / "second")
    assert contents(first) == contents(second)


def test_round_trip_is_exact(campaign_folder: Path, tmp_path: Path) -> None:
    assert_round_trip(campaign_folder, tmp_path)
    text = (tmp_path / "first" / "r01-x.json").read_text(encoding="utf-8")
    assert text == json.dumps(json.loads((campaign_folder / "r01-x.json").read_text()), ensure_ascii=False)


def test_import_keeps_everything_in_every_database(store: Store, campaign_folder: Path, tmp_path: Path) -> None:
    import_folder(store, campaign_folder)
    assert [run.visible_status for run in store.runs.all("c1")] == ["complete"] * 3
    assert load_run(store, "c1/r02").is_sealed
    record = store.runs.find("r01")
    read = run_document(load_run(store, "r01"), record, store.chunks.of_run(record.id))
    assert read == read_json(campaign_folder / "r01-x.json")
    exported = export_folder(store, "c1", tmp_path / "out")
    assert read_json(exported / "campaign.json") == read_json(campaign_folder / "campaign.json")
    with pytest.raises(StoreError, match="campaign 'c1' is in the database already"):
        import_folder(store, campaign_folder)


@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_real_axis_tests(shared: Path, tmp_path: Path, axis: str) -> None:
    assert_round_trip(shared / "data" / "axis-tests" / f"week42-{axis}", tmp_path)


def test_practice_cases(shared: Path, tmp_path: Path) -> None:
    wanted = {"case0053", "case0041"}
    with tarfile.open(shared / "data" / "blind-practice.tar.xz") as archive:
        for member in archive:
            parts = Path(member.name).parts
            if len(parts) > 2 and parts[1] in wanted and parts[0] == "public":
                archive.extract(member, tmp_path, filter="data")
    for case in sorted(wanted):
        (tmp_path / f"out-{case}").mkdir()
        assert_round_trip(tmp_path / "public" / case, tmp_path / f"out-{case}")


def set_at(*path: str | int, value: Any) -> Change:
    def change(document: dict[str, Any]) -> None:
        for part in path[:-1]:
            document = document[part]  # type: ignore[index]
        document[path[-1]] = value  # type: ignore[index]

    return change


def drop(*path: str) -> Change:
    def change(document: dict[str, Any]) -> None:
        for part in path[:-1]:
            document = document[part]
        del document[path[-1]]

    return change


def rename(*path: str, to: str) -> Change:
    def change(document: dict[str, Any]) -> None:
        for part in path[:-1]:
            document = document[part]
        document[to] = document.pop(path[-1])

    return change


BAD_RUNS = [
    (set_at("format", value="abbe-run/2"), "format: expected 'abbe-run/1', got 'abbe-run/2'"),
    (set_at("test", value="ballbar_spiral"), "test: expected 'ballbar_helix', 'ballbar_circle'"),
    (set_at("role", value="judge"), "role: expected 'identify', 'holdout' or 'sealed', got 'judge'"),
    (drop("columns", "x_mm"), "key 'columns.x_mm' is missing"),
    (drop("columns"), "key 'columns' is missing"),
    (drop("machine", "chain"), "key 'machine.chain' is missing"),
    (drop("setup", "t_set_s"), "key 'setup.t_set_s' is missing"),
    (drop("setup", "radius_mm"), "key 'setup.radius_mm' is missing, expected for a run of test 'ballbar_helix'"),
    (set_at("setup", "radius_mm", value="150"), "setup.radius_mm: expected a number, got '150'"),
    (set_at("setup", "centre_mm", value=[1, 2]), r"setup.centre_mm\[3\]"),
    (set_at("machine", "chain", value="w-X-Y-Z-t"), "machine.chain: expected a chain from w to t"),
    (set_at("machine", "stroke_mm", "X", value=[600, 0]), r"machine.stroke_mm.X: expected \[smaller, larger\], got \[600.0, 0.0\]"),
    (set_at("columns", "deviation_mm", 1, value=math.nan), "columns.deviation_mm, row 2: expected a finite number"),
    (set_at("columns", "t_s", 2, value=math.inf), "columns.t_s, row 3: expected a finite number"),
    (set_at("columns", "load_percent", 0, value=-math.inf), "columns.load_percent, row 1: expected a finite number"),
    (set_at("columns", "z_mm", 1, value="0"), "columns.z_mm, row 2: expected a number, got '0'"),
    (set_at("columns", "z_mm", 1, value=True), "columns.z_mm, row 2: expected a number, got True"),
    (set_at("columns", "direction", 2, value=0), "columns.direction, row 3: expected 1 or -1, got 0"),
    (set_at("columns", "valid", value=[1, 1, 2]), "columns.valid, row 3: expected 0 or 1, got 2"),
    (set_at("columns", "y_mm", value=[0.0, 0.0]), "columns.y_mm: expected 3 rows as in t_s, got 2"),
    (set_at("columns", "load_percent", value=[1]), "columns.load_percent: expected 3 rows as in t_s, got 1"),
    (set_at("columns", "t_s", value=[0.0, 2.0, 1.0]), "columns.t_s, row 3: expected at least 2.0, got 1.0"),
    (set_at("columns", "deviation_mm", value=None), "columns.deviation_mm: expected a list of numbers, got null"),
    (rename("columns", "deviation_mm", to="deviation_um"), "unknown unit suffix in 'deviation_um', expected 'deviation_mm'"),
    (rename("columns", "t_s", to="t_ms"), "unknown unit suffix in 't_ms', expected 't_s'"),
    (rename("columns", "feed_mm_min", to="feed_mm_s"), "unknown unit suffix in 'feed_mm_s', expected 'feed_mm_min'"),
    (rename("columns", "x_mm", to="x"), "unknown unit suffix in 'x', expected 'x_mm'"),
    (set_at("columns", "temp_x_F", value=[1.0] * 3), "unknown unit suffix in 'temp_x_F', expected 'temp_x_C'"),
    (rename("setup", "radius_mm", to="radius_in"), "unknown unit suffix in 'radius_in', expected 'radius_mm'"),
    (set_at("columns", "load_furlong", value=[1, 2, 3]), "columns.load_furlong: unknown unit suffix 'furlong'"),
    (set_at("columns", value=[]), "columns: expected an object"),
    (set_at("run_id", value="r77"), "run_id: expected 'r01' as in campaign.json"),
    (set_at("table", value={"crc": "B1"}), "r01-x.json: run c1/r01: its document has a missing or invalid field"),
    (set_at("setup", "span_deg", value="half"), "r01-x.json: run c1/r01: its document has a missing or invalid field"),
    (set_at("campaign", value="c2"), "campaign: expected 'c1' as in campaign.json"),
]


@pytest.mark.parametrize(("change", "message"), BAD_RUNS, ids=[message[:40] for _, message in BAD_RUNS])
def test_bad_run_file(file_store: Store, campaign_folder: Path, change: Change, message: str) -> None:
    assert_refused(file_store, campaign_folder, "r01-x.json", change, message)


BAD_CAMPAIGNS = [
    (set_at("format", value="abbe-run/1"), "format: expected 'abbe-campaign/1'"),
    (drop("machine"), "key 'machine' is missing"),
    (set_at("temperature_sensors", value="no"), "temperature_sensors: expected a boolean, got 'no'"),
    (set_at("runs", 0, "file", value="../r01.json"), r"runs\[1\].file: "),
    (set_at("runs", 0, "file", value="r99.json"), "r99.json: no such file"),
    (set_at("runs", 1, "run_id", value="r01"), "run_id 'r01' appears twice"),
    (set_at("runs", 1, "file", value="campaign.json"), "a file is named 'campaign.json'"),
    (set_at("current_model", "errors", value="none.json"), "none.json: no such file"),
    (
        set_at("current_model", "includes", value=["rigid_21"]),
        r"current_model.includes\[1\]: expected 'rigid6', 'rigid21', .*got 'rigid_21'",
    ),
    (set_at("current_model", "includes", value="rigid21"), "current_model.includes: expected a.* got 'rigid21'"),
    (set_at("setups", "A", value={"kind": "ballbar"}), "key 'setups.A.t_set_s' is missing"),
    (set_at("instruments", "ballbar", "resolution_mm", value=math.nan), "finite number"),
]


@pytest.mark.parametrize(("change", "message"), BAD_CAMPAIGNS, ids=[message[:40] for _, message in BAD_CAMPAIGNS])
def test_bad_campaign_file(file_store: Store, campaign_folder: Path, change: Change, message: str) -> None:
    assert_refused(file_store, campaign_folder, "campaign.json", change, message)


BAD_ERRORS = [
    (set_at("motions", "EXX", "kind", value="spline"), "motions.EXX"),
    (set_at("motions", "EQX", value={"kind": "polynomial", "coefficients": [0], "origin_mm": 0}), "EQX"),
    (set_at("motions", "EYX@reverse", "value", value=[0]), "expected as many values as positions"),
    (drop("squareness_rad", "C0Y"), "key 'squareness_rad.C0Y' is missing"),
]


@pytest.mark.parametrize(("change", "message"), BAD_ERRORS, ids=[message[:40] for _, message in BAD_ERRORS])
def test_bad_errors_file(file_store: Store, campaign_folder: Path, change: Change, message: str) -> None:
    assert_refused(file_store, campaign_folder, "errors.json", change, message)


def test_a_run_without_a_mounting_time_is_not_exported_as_a_folder_that_no_import_takes(file_store: Store, tmp_path: Path) -> None:
    start = {"setup": {"setup_id": "L", "nominal_beam": [1.0, 0.0, 0.0]}, "machine": {"name": "m"}, "ctrl0_us": 0}
    campaign = file_store.campaigns.add(file_store.machines.add("m", {"name": "m"}), "c", {})
    file_store.runs.finish(file_store.runs.start(campaign, "r1", "laser_linear", "identify", start), "complete", "", {})
    with pytest.raises(StoreError, match="run c/r1: its set-up has no t_set_s"):
        export_folder(file_store, "c", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def assert_refused(store: Store, folder: Path, name: str, change: Change, message: str) -> None:
    document = json.loads((folder / name).read_text(encoding="utf-8"))
    change(document)
    (folder / name).write_text(json.dumps(document), encoding="utf-8")
    with pytest.raises(FileFormatError, match=message) as caught:
        import_folder(store, folder)
    assert ".json" in str(caught.value)
    assert "\n" not in str(caught.value)
    assert store.campaigns.all() == store.machines.all() == store.runs.all() == []


@pytest.mark.parametrize(
    ("raw", "message"),
    [
        (b"{", "line 1, column 2: not JSON"),
        (b"[1]", r"expected a JSON object, got \[1\]"),
        (b'{"a": "\xff"}', "byte 7 is not UTF-8"),
        (b"[" * 100_000, "nested too deeply"),
        (b"", "not JSON"),
    ],
)
def test_file_that_is_no_json_object(campaign_folder: Path, raw: bytes, message: str) -> None:
    (campaign_folder / "r01-x.json").write_bytes(raw)
    with pytest.raises(FileFormatError, match=message):
        read_folder(campaign_folder)


def test_folder_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="no such file"):
        read_folder(tmp_path / "none")


def test_equal_times_are_in_order(campaign_folder: Path) -> None:
    document = read_json(campaign_folder / "r01-x.json")
    document["columns"]["t_s"] = [1.0, 1.0, 1.0]
    (campaign_folder / "r01-x.json").write_text(json.dumps(document))
    read_folder(campaign_folder)


def test_every_unit_of_the_format_is_known() -> None:
    assert {"s", "mm", "mm_min", "C", "Pa", "rad"} <= UNITS


def test_export_never_overwrites(file_store: Store, campaign_folder: Path, tmp_path: Path) -> None:
    import_folder(file_store, campaign_folder)
    target = tmp_path / "out"
    target.mkdir()
    (target / "precious").write_text("x")
    with pytest.raises(FileFormatError, match="not an empty folder: nothing was written"):
        export_folder(file_store, "c1", target)
    assert [path.name for path in target.iterdir()] == ["precious"]
    (target / "precious").unlink()
    export_folder(file_store, "c1", target)
    with pytest.raises(FileFormatError, match="nothing was written"):
        export_folder(file_store, "c1", target / "campaign.json")


def test_failed_export_leaves_nothing(file_store: Store, campaign_folder: Path, tmp_path: Path) -> None:
    import_folder(file_store, campaign_folder)
    before = sorted(path.name for path in tmp_path.iterdir())
    broken = file_store.runs.start(1, "r09", "ballbar_helix", "identify", {})
    with pytest.raises(StoreError, match="c1/r09"):
        export_folder(file_store, "c1", tmp_path / "out")
    assert sorted(path.name for path in tmp_path.iterdir()) == before
    assert broken == 4


MACHINE = {"name": "VMC-1", "chain": "w-X-Y-b-Z-t", "vertical_axis": "Z", "stroke_mm": {"X": [0, 600], "Y": [0, 500], "Z": [0, 450]}}


def test_measured_campaign_is_a_good_folder(file_store: Store, tmp_path: Path) -> None:
    campaign = file_store.campaigns.add(
        file_store.machines.add("VMC-1", MACHINE), "monday", {"instruments": {"ballbar": {"resolution_mm": 1e-6}}}
    )
    setup = {"setup_id": "A", "t_set_s": 1.0, "centre_mm": [1, 2, 3], "radius_mm": 150.0, "turns": 1}
    path = {"feed_mm_min": 60.0, "direction": 1, "points_mm": [[0, 0, 0], [1, 0, 0]]}
    run_id = file_store.runs.start(
        campaign,
        "helix 1/2",
        "ballbar_helix",
        "identify",
        {"setup": setup, "machine": MACHINE, "ctrl0_us": 0, "path": path, "rate_hz": 100},
    )
    samples = [BarSample(seq, 10_000 * seq, seq, 8 if 5 <= seq < 105 else 0) for seq in range(110)]
    file_store.chunks.append(run_id, "bar", 0, 110, BAR_CODEC, encode_bar(samples), 0.0, 1.1, 0, 1_090_000)
    file_store.runs.finish(run_id, "complete", "", {"path_start_us": 2_000_000, "path_end_us": 3_000_000})
    folder = export_folder(file_store, "monday", tmp_path / "out")
    assert sorted(path.name for path in folder.iterdir()) == ["campaign.json", "helix_1_2.json"]
    assert_round_trip(folder, tmp_path)
    assert read_json(folder / "campaign.json")["setups"] == {"A": {"kind": "ballbar", "t_set_s": 1.0}}
    assert read_json(folder / "helix_1_2.json") == load_run(file_store, run_id).to_document()
