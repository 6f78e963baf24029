"""`abbe import FILE...`: a preview first, then a campaign that reports evaluate; what a file does not say is asked or widens U."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from tests.service.cli.test_cli import MACHINE_FILE, Abbe, abbe
from tests.service.instrument_files.examples import ENVIRONMENT, renishaw

__all__ = ["abbe"]  # the fixture
pytestmark = pytest.mark.usefixtures("clean_environment")


@pytest.fixture(autouse=True)
def _folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("x.rtl").write_text(renishaw())


def report(abbe: Abbe, *arguments: object) -> dict[str, Any]:
    done = abbe("report", *arguments, "--out", "out.json")
    assert done.code == 0, done.err
    found: dict[str, Any] = json.loads(Path("out.json").read_text())
    return found


def figures(found: dict[str, Any]) -> dict[str, tuple[float | None, float | None]]:
    return {one["symbol"]: (one["value"], one["expanded"]) for one in found["figures"]}


def test_a_file_becomes_figures_of_iso_230_2(abbe: Abbe) -> None:
    done = abbe("import", "x.rtl", "--yes", "--name", "first")
    assert done.code == 0, done.err
    assert "imported campaign 'first' with 1 runs" in done.out
    found = figures(report(abbe, "first"))
    assert {name: found[name][0] for name in ("E", "B", "R", "B mean")} == pytest.approx(
        {"E": 14.0, "B": 3.0, "R": 3.0, "B mean": -8.5 / 3}
    )


def test_nothing_is_stored_before_somebody_has_seen_it(abbe: Abbe) -> None:
    done = abbe("import", "x.rtl")
    assert done.code == 1
    assert "12 from -11 to 3 µm" in done.out
    assert done.out.endswith("nothing was stored: --yes stores it\n")
    assert not Path("abbe.sqlite3").exists()


def test_what_is_unknown_widens_u_and_is_said(abbe: Abbe) -> None:
    Path("known.rtl").write_text(renishaw(environment=ENVIRONMENT))
    for name in ("x", "known"):
        abbe("import", f"{name}.rtl", "--yes")
    unknown, known = report(abbe, "x"), report(abbe, "known")
    assert figures(unknown)["E"][0] == figures(known)["E"][0]
    assert (figures(unknown)["E"][1] or 0.0) > 10.0 * (figures(known)["E"][1] or 1e9)
    assert any("does not say: temperature of the scale of X: U assumes 15 to 25 °C" in line for line in unknown["remarks"])
    assert not any("does not say: temperature" in line for line in known["remarks"])
    assert known["conditions"]["Temperature of X"] == "21.10 to 21.50 °C"


def test_an_answer_takes_the_place_of_what_the_file_lacks(abbe: Abbe) -> None:
    given = ("--scale-temperature", "21", "--air-temperature", "20.5", "--air-pressure", "1012", "--feed", "1000")
    abbe("import", "x.rtl", "--yes", *given)
    found = report(abbe, "x")
    assert (figures(found)["E"][1] or 1e9) < 1.0
    assert found["conditions"]["Feed"] == "1000 mm/min"
    assert not any("feed" in line for line in found["remarks"])


def test_a_machine_file_gives_chain_strokes_and_reduction_to_20_degrees(abbe: Abbe) -> None:
    material = "[material]\ntemperature_c = 24.0\n[material.scale_per_k]\nX = 11.5e-6\n[material.u_scale_per_k]\nX = 0.5e-6\n"
    Path("mill.toml").write_text(MACHINE_FILE + material)
    assert abbe("import", "x.rtl", "--yes", "--machine", "mill.toml").code == 0
    found = report(abbe, "x", "--machine", "mill.toml")
    assert found["about"]["Chain"] == "w-X-Y-b-Z-t"
    assert any("at 20 °C" in one["group"] for one in found["figures"])
    assert not any("chain" in line for line in found["remarks"])


def test_several_files_of_one_machine_are_one_campaign(abbe: Abbe) -> None:
    Path("y.rtl").write_text(renishaw(user="Machine:VMC-1\nAxis:Y axis"))
    assert "2 runs" in abbe("import", "x.rtl", "y.rtl", "--yes", "--name", "both").out
    groups = {one["group"].partition(":")[0] for one in report(abbe, "both")["figures"]}
    assert groups == {"Axis X, set-up L1", "Axis Y, set-up L2"}


def test_angles_are_evaluated_beside(abbe: Abbe) -> None:
    Path("x.rta").write_text(renishaw(kind="rta", runs=[(0.0, 0.010, 0.004), (0.001, 0.012, 0.005)]))
    abbe("import", "x.rta", "--yes", "--name", "pitch")
    found = report(abbe, "pitch")
    assert figures(found)["E"][0] == pytest.approx(12.0)
    assert figures(found)["B"][0] == pytest.approx(2.0)
    assert {one["unit"] for one in found["figures"]} == {"µrad"}
    assert any("does not say which angle" in line for line in found["remarks"])


def test_an_import_that_cannot_be_is_one_line(abbe: Abbe) -> None:
    Path("other.rtl").write_text(renishaw(user="Machine:VMC-2\nAxis:X"))
    Path("copy.rtl").write_text(renishaw())
    Path("u.rtl").write_text(renishaw(user="Machine:VMC-1\nAxis:A"))
    Path("fine.rtl").write_text(renishaw(targets=(0, 0.02, 0.04)))
    Path("x.doc").write_text("x")
    assert "the files name different machines: 'VMC-1' (x.rtl), 'VMC-2' (other.rtl)" in abbe.fails("import", "x.rtl", "other.rtl", "--yes")
    assert "copy.rtl: its bytes are those of x.rtl" in abbe.fails("import", "x.rtl", "copy.rtl", "--yes")
    assert "the file does not say which axis was measured - give --axis VALUE (X, Y, Z)" in abbe.fails("import", "u.rtl", "--yes")
    assert "--axis is 'Q' - give one of X, Y, Z" in abbe.fails("import", "u.rtl", "--yes", "--axis", "Q")
    assert "--axis is Y, the file says X" in abbe.fails("import", "x.rtl", "--yes", "--axis", "Y")
    assert "targets are closer than 0.1 mm" in abbe.fails("import", "fine.rtl", "--yes")
    assert "can be imported, and folders with campaign.json" in abbe.fails("import", "x.doc", "--yes")
    assert "none.rtl: no such file" in abbe.fails("import", "none.rtl", "--yes")
    assert not Path("abbe.sqlite3").exists()


def test_a_campaign_of_files_survives_export_and_import(abbe: Abbe) -> None:
    Path("x.rta").write_text(renishaw(kind="rta"))
    abbe("import", "x.rtl", "x.rta", "--yes", "--name", "c")
    assert abbe("export", "c", "folder").code == 0
    assert abbe("import", "folder", "--db", "sqlite:///other.sqlite3").code == 0
    first, second = report(abbe, "c"), report(abbe, "c", "--db", "sqlite:///other.sqlite3")
    assert first["figures"] == second["figures"]
    assert [line for line in first["remarks"] if "does not say" in line] == [line for line in second["remarks"] if "does not say" in line]
