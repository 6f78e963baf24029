"""What the service's tests share: the shared material, a store on each database, a frozen clock."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from abbe.service.storage.store import Store

NOW = datetime(2026, 11, 21, 3, 34, tzinfo=UTC)


@pytest.fixture(params=["sqlite", "memory", "postgresql"])
def db_url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """An empty database of each kind."""
    if request.param == "postgresql":
        make: Callable[[], str] = request.getfixturevalue("postgres")
        return make()
    return "sqlite://" if request.param == "memory" else f"sqlite:///{tmp_path / 'abbe.sqlite3'}"


@pytest.fixture
def store(db_url: str) -> Iterator[Store]:
    """An open store whose clock stands still."""
    with Store.open(db_url, utcnow=lambda: NOW) as opened:
        yield opened


@pytest.fixture
def file_store(tmp_path: Path) -> Iterator[Store]:
    """An open store in a SQLite file."""
    with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}", utcnow=lambda: NOW) as opened:
        yield opened


@pytest.fixture
def campaign_id(store: Store) -> int:
    """A campaign of a machine."""
    return store.campaigns.add(store.machines.add("VMC-1", {"name": "VMC-1"}), "c1", {})


@pytest.fixture
def clean_environment(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """No variable of whoever runs the tests decides what they find."""
    for name in [name for name in os.environ if name.upper().startswith("ABBE_")]:
        monkeypatch.delenv(name)
    return monkeypatch


@pytest.fixture
def campaign_folder(tmp_path: Path) -> Path:
    """A good campaign folder with every kind of run, an errors file and unknown keys."""
    return write_campaign(tmp_path / "in")


MACHINE = {
    "name": "VMC-1",
    "chain": "w-X-Y-b-Z-t",
    "vertical_axis": "Z",
    "stroke_mm": {"X": [0, 600], "Y": [0, 500], "Z": [0, 450]},
    "pivots_mm": {"X": [300, 250, -150]},
    "colour": "green",
}
BAR_SETUP = {"setup_id": "A", "t_set_s": 600, "centre_mm": [300, 250, 100], "radius_mm": 150.0, "turns": 4}
LASER_SETUP = {"setup_id": "L", "t_set_s": 0.1, "axis": "X", "start_mm": [0, 0, 0], "end_mm": [600, 0, 0], "glass": None}


def run_file(run_id: str, **changes: Any) -> dict[str, Any]:
    """A small run file; ``changes`` replace keys."""
    columns: dict[str, Any] = {"t_s": [0.0, 1e-05, 2], "x_mm": [0, 0.1, 0.30000000000000004], "y_mm": [0.0] * 3, "z_mm": [0.0] * 3}
    columns |= {"feed_mm_min": [1000.0] * 3, "direction": [1, 1, -1], "deviation_mm": [0.0, -1e-4, 0.5], "load_percent": [1, 2, 3]}
    run = {"format": "abbe-run/1", "mystery": {"b": 1, "a": [None]}, "campaign": "c1", "run_id": run_id, "test": "ballbar_helix"}
    return run | {"role": "identify", "machine": MACHINE, "setup": BAR_SETUP, "columns": columns} | changes


def campaign_file(entries: list[dict[str, Any]], **changes: Any) -> dict[str, Any]:
    """A campaign file; ``changes`` replace keys."""
    head = {
        "format": "abbe-campaign/1",
        "campaign": "c1",
        "machine": MACHINE,
        "current_model": {"includes": ["rigid6"], "errors": "errors.json"},
    }
    setups = {"A": {"kind": "ballbar", "t_set_s": 600}, "L": {"kind": "laser", "t_set_s": 0.1, "by": "Ü"}}
    return (
        head
        | {"instruments": {"ballbar": {"resolution_mm": 1e-4}}, "setups": setups, "temperature_sensors": False, "runs": entries}
        | changes
    )


ERRORS = {
    "format": "abbe-errors/1",
    "squareness_rad": {"C0Y": 2.1e-5, "B0Z": 0, "A0Z": -1e-5},
    "motions": {
        "EXX": {"kind": "polynomial", "coefficients": [0, -8.6e-5], "origin_mm": 0},
        "EYX@reverse": {"kind": "table", "position_mm": [0, 600], "value": [0, 1e-3], "interpolation": "linear"},
    },
    "covariance": None,
    "not_observable": [{"combination": {"ECY.1": 1.0}, "why": "no second tool"}],
}


def write_campaign(folder: Path) -> Path:
    """Write a good campaign folder."""
    folder.mkdir()
    sealed = run_file("r02", role="sealed")
    sealed["columns"] = sealed["columns"] | {"deviation_mm": None}
    runs = [run_file("r01"), sealed, run_file("r03", test="laser_linear", setup=LASER_SETUP)]
    entries = [{"run_id": run["run_id"], "test": run["test"], "role": run["role"], "file": f"{run['run_id']}-x.json"} for run in runs]
    for entry, run in zip(entries, runs, strict=True):
        write_json(folder / str(entry["file"]), run)
    write_json(folder / "campaign.json", campaign_file(entries))
    write_json(folder / "errors.json", ERRORS)
    return folder


def write_json(path: Path, document: object) -> None:
    """Write JSON, NaN included: a test may want it."""
    path.write_text(json.dumps(document), encoding="utf-8")


@pytest.fixture(params=["sqlite", "postgresql"])
def url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """An empty database that several connections can share: once as a file, once on a PostgreSQL."""
    if request.param == "sqlite":
        return f"sqlite:///{tmp_path / 'abbe.sqlite3'}"
    make: Callable[[], str] = request.getfixturevalue("postgres")
    return make()
