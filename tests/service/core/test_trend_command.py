"""`abbe trend` on a stored history."""

from __future__ import annotations

import json
from datetime import timedelta
from pathlib import Path

import numpy as np
import pytest

from abbe.service.cli import run
from abbe.service.domain.schedule import Schedule
from abbe.service.storage.store import Store
from abbe.service.verification import verify
from tests.service.core.fakes import Result, utc

START = utc(2026, 3, 1, 5)
FILE = """
name = "mill-7"
chain = "w-X-Y-b-Z-t"
[stroke_mm]
X = [0.0, 600.0]
Y = [0.0, 500.0]
Z = [0.0, 450.0]
[store]
url = "sqlite:///abbe.sqlite3"
"""


@pytest.fixture
def machine(tmp_path: Path) -> Path:
    """A check a day: 40 quiet days, then the diagonal grows by 0.3 um a day towards 20 um; the helix stays."""
    path = tmp_path / "machine.toml"
    path.write_text(FILE)
    rng = np.random.default_rng(7)
    with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as store:
        machine_id = store.machines.add("mill-7", {})
        schedule = Schedule("daily", "0 5 * * *", "UTC", "quick-check")
        for day in range(60):
            at = START + timedelta(days=day)
            diagonal = 9.0 + 0.3 * max(day - 40, 0) + 0.5 * rng.normal()
            result = Result(
                values={"body_diagonal_um": diagonal, "helix_rms_um": 1.4 + 0.1 * rng.normal()},
                uncertainties={"body_diagonal_um": 1.0, "helix_rms_um": 0.2},
                limits={"body_diagonal_um": 20.0, "helix_rms_um": 5.0},
                started_utc=at,
            )
            store.verifications.add_with_messages(machine_id, verify.check_doc(verify.Occasion("mill-7", schedule, at), result), [])
        gone = verify.failed_doc(verify.Occasion("mill-7", schedule, at), OSError("cable"), at, 1.0)
        store.verifications.add_with_messages(machine_id, gone, [])
    return path


def test_the_drift_is_told_with_its_days(machine: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["trend", "-m", str(machine), "--json"]) == 0
    doc = json.loads(capsys.readouterr().out)
    diagonal, helix = doc["figures"]
    assert (diagonal["figure"], diagonal["checks"], diagonal["state"], diagonal["direction"]) == ("body_diagonal_um", 60, "drifting", 1)
    # From 2026-04-10 on. The sum dates it to where it last was nothing, which may be some checks early.
    assert "2026-03-20" <= diagonal["since_utc"] <= "2026-04-17"
    low, high = diagonal["days_until_limit_95"]
    true_days = (20.0 - 9.0) / 0.3 - 19
    assert low < true_days < high
    assert low < diagonal["days_until_limit"] < high
    assert (helix["state"], helix["days_until_limit"], helix["reason"]) == ("in control", None, "not known: the slope is not significant")
    assert doc["chart"]["checks_to_a_false_alarm"] == 465


def test_the_table_and_a_new_series(machine: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["trend", "-m", str(machine)]) == 0
    out = capsys.readouterr().out
    assert "drifting up" in out
    assert "not known: the slope is not significant" in out
    assert run(["trend", "-m", str(machine), "--after", "2026-04-26T12:00:00Z"]) == 0
    assert "too few checks" in capsys.readouterr().out


def test_nothing_to_tell_and_bad_input(tmp_path: Path, machine: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["trend", "-m", str(machine), "--after", "yesterday"]) == 2
    assert "error CFG-001: --after 'yesterday' is not a date" in capsys.readouterr().err
    assert run(["trend", "-m", str(machine), "--after", "2027-01-01"]) == 0
    assert "no check of mill-7 has figures yet" in capsys.readouterr().out
    (tmp_path / "abbe.sqlite3").unlink()
    assert run(["trend", "-m", str(machine)]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not (tmp_path / "abbe.sqlite3").exists()
