"""Runs at standstill from tables to `abbe discover`: text, JSON, runs that only judge, refusals; and 18 days of somebody else's lathe."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from abbe.service.domain.discovery_file import StandstillFile
from tests.models.evaluation.heated_machine import heated_days
from tests.service.cli.test_cli import Abbe, abbe

__all__ = ["abbe"]  # the fixture
pytestmark = pytest.mark.usefixtures("clean_environment")

HEAD = 'axis = "X"\nat_mm = 0.0\nevery_s = 60.0\n[deviation]\ncolumn = "um"\nunit = "um"\n'
SENSOR = '[temperatures.{name}]\ncolumn = "{name}"\nunit = "C"\n'


@pytest.fixture(autouse=True)
def _folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def import_days(abbe: Abbe, sensors: tuple[str, ...], days: list[tuple[Any, Any]], name: str) -> None:
    Path("columns.toml").write_text(HEAD + "".join(SENSOR.format(name=s) for s in sensors))
    files = []
    for k, (temperatures, um) in enumerate(days, start=1):
        rows = [",".join((*sensors, "um")), *(",".join(map(str, (*t, y))) for t, y in zip(temperatures.tolist(), um.tolist(), strict=True))]
        files.append(f"day{k:02d}.csv")
        Path(files[-1]).write_text("\n".join(rows) + "\n")
    done = abbe("import", *files, "--columns", "columns.toml", "--name", name, "--yes")
    assert done.code == 0, done.err


def synthetic(count: int = 8, **how: Any) -> list[tuple[Any, Any]]:
    return [(d.temperatures_c, d.displacement_um.round(2)) for d in heated_days(count=count, **how)]


def test_days_of_a_standing_axis_show_its_thermal_response(abbe: Abbe) -> None:
    import_days(abbe, ("ambient", "spindle", "bed"), synthetic(), "heat")
    done = abbe("discover", "heat")
    assert done.code == 0, done.err
    assert "campaign heat: 8 runs at standstill (ISO 230-3), temperatures ambient, spindle, bed" in done.out
    assert "Heat explains it in part." in done.out
    assert done.err.endswith("next: abbe report heat\n")
    assert "shift of several runs: none beyond chance (p > 0.01)" in done.out
    told = abbe("discover", "heat", "--json").out
    StandstillFile.model_validate_json(told)
    doc = json.loads(told)
    assert doc["rms_um"]["response"] < 0.5 * doc["rms_um"]["static"]
    assert [s["sensor"] for s in doc["sensitivities"]] == ["ambient", "spindle", "bed"]
    assert {len(one["predicted_mm"]) for one in doc["left_out"]} == {200}


def test_a_run_that_only_judges_is_predicted_with_u(abbe: Abbe) -> None:
    import_days(abbe, ("ambient", "spindle", "bed"), synthetic(), "heat")
    abbe("export", "heat", "out")
    for path, entries in ((Path("out/campaign.json"), True), (Path("out/r08.json"), False)):
        doc = json.loads(path.read_text())
        (doc["runs"][-1] if entries else doc)["role"] = "holdout"
        path.write_text(json.dumps(doc))
    done = abbe("discover", "out")
    assert done.code == 0, done.err
    assert "7 runs at standstill" in done.out
    assert "run r08 was never fitted: " in done.out
    found = json.loads(abbe("discover", "out", "--json").out)["predictions"]["r08"]
    off = np.abs(np.array(json.loads(Path("out/r08.json").read_text())["columns"]["deviation_mm"]) - found["predicted_mm"])
    assert np.mean(off <= 2.0 * np.array(found["u_mm"])) > 0.8


def test_too_few_days_and_a_report_are_refused(abbe: Abbe) -> None:
    import_days(abbe, ("ambient", "spindle", "bed"), synthetic(count=3), "few")
    assert "3 runs at standstill, expected 5 or more" in abbe.fails("discover", "few")
    assert "--report and --live are not for runs at standstill" in abbe.fails("discover", "few", "--report", "few.html")


def test_a_sensor_with_a_strange_name_or_unit_is_refused(abbe: Abbe) -> None:
    Path("d.csv").write_text("bed,um\n20,0\n21,1\n")
    for wrong, words in (
        ('[temperatures."Bed 1"]\ncolumn = "bed"\nunit = "C"\n', "temperatures"),
        (SENSOR.format(name="bed").replace('"C"', '"F"'), "'F'"),
    ):
        Path("c.toml").write_text(HEAD + wrong)
        assert words in abbe.fails("import", "d.csv", "--columns", "c.toml", "--yes")


SENSORS = ("ambient", "bed", "spindle_rear", "coolant_wall", "transformer_bed", "spindle_front")


def test_eighteen_days_of_a_lathe(abbe: Abbe, shared: Path) -> None:
    """Each day counts alike: 17.4 um raw, 8.7 with temperatures at once, 7.2 with a lagged ridge; on the last days the coolant differs."""
    calamine = pytest.importorskip("python_calamine")
    folder = shared / "data" / "foreign" / "thermal-lathe"
    books = [folder / "ACE_X.xlsx", folder / "ACE_Y.xlsx"]
    missing = [book.name for book in books if not book.is_file()]
    if missing:
        pytest.skip(f"thermal-lathe lacks {', '.join(missing)}: temperatures are in ACE_X.xlsx, displacements in ACE_Y.xlsx")
    x, y = (calamine.CalamineWorkbook.from_path(book) for book in books)
    days = [tuple(np.array(book.get_sheet_by_index(k).to_python()[1:], dtype=float) for book in (x, y)) for k in range(18)]
    import_days(abbe, SENSORS, [(t, um[:, 0]) for t, um in days], "lathe")
    doc = json.loads(abbe("discover", "lathe", "--json").out)
    assert doc["rms_um"]["raw"] == pytest.approx(17.4, abs=0.05)
    assert doc["rms_um"]["static"] == pytest.approx(8.7, abs=0.05)
    assert doc["rms_um"]["response"] < 7.2
    assert 0.90 < doc["covered"] < 0.98
    (shift,) = [one for one in doc["shifts"] if one["model"] == "absolute"]
    assert (shift["first"], shift["last"]) == ("r15", "r18")
    assert shift["p"] < 0.01
    assert "from run r15 on the displacement differs by +13" in abbe("discover", "lathe").out
