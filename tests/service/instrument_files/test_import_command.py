"""`abbe import FILE...`: a preview first, then a campaign that reports evaluate; what a file does not say is asked or widens U."""

from __future__ import annotations

import json
import os
import pty
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import pytest

from tests.service.cli.test_cli import MACHINE_FILE, Abbe, abbe
from tests.service.instrument_files.examples import B5R, COLUMNS, ENVIRONMENT, POS, TABLE, renishaw, rtx

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


def test_times_that_no_file_states_are_neither_judged_nor_printed(abbe: Abbe) -> None:
    """With a feed the numbers of the readings would look like minutes: 110 readings on 5 m at 20 mm/min."""
    targets = [50.0 * k for k in range(11)]
    runs = [[round(-0.02 * t + 0.1 * ((7 * k + t / 50) % 5), 1) for t in targets] for k in range(10)]
    Path("x.rtl").write_text(renishaw(runs, targets))
    assert abbe("import", "x.rtl", "--yes", "--feed", "20").code == 0
    found, run = report(abbe, "x"), report(abbe, "x/r01")
    assert not {"Time in the runs"} & {*found["conditions"], *run["conditions"]}
    told = abbe("solve", "x", "--model", "rigid6")
    assert told.code == 0, told.err
    assert "t_s" not in told.out + told.err


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


def test_a_solution_counts_it_too(abbe: Abbe) -> None:
    targets = [50.0 * k for k in range(11)]
    runs = [[round(-0.02 * t + 2.5 * (k % 2) + 0.1 * ((7 * k + t / 50) % 5), 1) for t in targets] for k in range(10)]
    Path("long.rtl").write_text(renishaw(runs, targets))
    given = ("--scale-temperature", "20", "--air-temperature", "20", "--air-pressure", "1013")
    length, scales = {}, {}
    for name, options in (("unknown", ()), ("known", given)):
        assert abbe("import", "long.rtl", "--yes", "--name", name, *options).code == 0
        solved = json.loads(abbe("solve", name, "--model", "rigid6", "--json").out)
        length[name] = solved["mean_over_volume"]["EXX"]["u"]
        (scales[name],) = [one["u_um"] for one in solved["uncertainty"]["budget"] if one["source"] == "scale_temperature"]
    assert length["unknown"] > 5e-6
    assert length["known"] < 1e-6
    assert scales["unknown"] == pytest.approx(scales["known"] * 10.0 / 12.0**0.5 / 0.2)


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


def test_a_reading_far_from_the_others_is_named_and_imported(abbe: Abbe) -> None:
    """490 typed as 590: the import and the report name it, and no figure leaves it out."""
    runs = [[2.5 * (k % 2) + 0.1 * ((7 * k + t) % 5) for t in range(5)] for k in range(6)]
    runs[3][2] = 100000.0
    Path("typed.rtl").write_text(renishaw(runs, [100.0 * t for t in range(5)]))
    done = abbe("import", "typed.rtl", "--yes")
    assert done.code == 0, done.err
    assert done.err.startswith("warning: run r01, the reading at X 200 mm, moving in -, lies 100000 µm")
    assert done.err.count("warning:") == 1
    found = report(abbe, "typed")
    assert (figures(found)["A"][0] or 0.0) > 1e5
    assert done.err.partition(": ")[2].splitlines()[0] in found["remarks"]
    assert "warning" not in abbe("import", "x.rtl", "--yes").err


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
    assert "copy.rtl: it is a copy of x.rtl" in abbe.fails("import", "x.rtl", "copy.rtl", "--yes")
    assert "the file does not say which axis was measured - give --axis VALUE (X, Y, Z)" in abbe.fails("import", "u.rtl", "--yes")
    assert "--axis is 'Q' - give one of X, Y, Z" in abbe.fails("import", "u.rtl", "--yes", "--axis", "Q")
    assert "--axis is Y, the file says X" in abbe.fails("import", "x.rtl", "--yes", "--axis", "Y")
    assert "targets are closer than 0.1 mm" in abbe.fails("import", "fine.rtl", "--yes")
    assert "can be imported, and folders with campaign.json" in abbe.fails("import", "x.doc", "--yes")
    for name in ("none.rtl", "none.csv"):
        assert f"{name}: no such file" in abbe.fails("import", name, "--yes")
    assert not Path("abbe.sqlite3").exists()


def test_a_campaign_of_files_survives_export_and_import(abbe: Abbe) -> None:
    Path("x.rta").write_text(renishaw(kind="rta"))
    abbe("import", "x.rtl", "x.rta", "--yes", "--name", "c")
    assert abbe("export", "c", "folder").code == 0
    assert abbe("import", "folder", "--db", "sqlite:///other.sqlite3").code == 0
    first, second = report(abbe, "c"), report(abbe, "c", "--db", "sqlite:///other.sqlite3")
    assert first["figures"] == second["figures"]
    assert [line for line in first["remarks"] if "does not say" in line] == [line for line in second["remarks"] if "does not say" in line]


def test_results_of_a_ball_bar_are_reported_without_an_uncertainty(abbe: Abbe) -> None:
    Path("xy.b5r").write_text(B5R.format(encoding="utf-8", machine="VMC-1"))
    done = abbe("import", "xy.b5r", "x.rtl", "--yes", "--name", "both")
    assert "imported campaign 'both' with 1 runs and 4 tests and figures beside them" in done.out
    found = report(abbe, "both")
    (circularity,) = [one for one in found["figures"] if one["symbol"] == "AF_CIRCULARITY"]
    assert (circularity["value"], circularity["expanded"], circularity["unit"]) == (11.4, None, "µm")
    assert any("the file holds no uncertainty" in line for line in found["not_observable"])


def test_a_sign_that_a_file_does_not_say_is_asked(abbe: Abbe) -> None:
    Path("y.pos").write_text(POS)
    assert "y.pos: the file does not say what the values are" in abbe.fails("import", "y.pos", "--yes")
    assert abbe("import", "y.pos", "--yes", "--sign", "nominal-measured").code == 0
    found = figures(report(abbe, "y"))
    assert found["E"][0] == pytest.approx(14.0)
    assert found["R"] == (None, None)
    only = POS[: POS.index("Position   \tForward")]
    Path("both.pos").write_text(only)
    abbe("import", "both.pos", "--yes", "--sign", "measured-nominal")
    assert figures(report(abbe, "both"))["M"] == (pytest.approx(11.0), None)


def test_a_trace_asks_for_its_unit_and_place(abbe: Abbe) -> None:
    Path("d.rtx").write_bytes(rtx())
    assert "the file does not say the unit of the readings - give --unit VALUE" in abbe.fails("import", "d.rtx", "--yes", "--axis", "X")
    assert abbe("import", "d.rtx", "--yes", "--axis", "X", "--unit", "um", "--at", "100").code == 0
    assert abbe("report", "d", "--out", "d.json").code == 0
    assert "the axis stood still: its readings over time hold no geometry" in abbe("discover", "d").err


def test_a_table_is_read_by_its_column_file(abbe: Abbe) -> None:
    Path("t.csv").write_text(TABLE)
    Path("c.toml").write_text(COLUMNS)
    assert "t.csv: what are the columns? - give --columns FILE" in abbe.fails("import", "t.csv", "--yes")
    assert abbe("import", "t.csv", "--yes", "--columns", "c.toml").code == 0
    assert figures(report(abbe, "t"))["E"][0] == pytest.approx(14.0)


def test_readings_written_as_csv_are_read_again(abbe: Abbe) -> None:
    abbe("import", "x.rtl", "--yes")
    assert abbe("export", "x", "folder", "--csv").code == 0
    assert Path("folder/r01.csv").read_text().splitlines()[:2] == [
        "t_s,x_mm,y_mm,z_mm,feed_mm_min,direction,deviation_mm",
        "0.0,0.0,0.0,0.0,0.0,1,0.0",
    ]
    columns = 'axis = "X"\n[target]\ncolumn = "x_mm"\nunit = "mm"\n[deviation]\ncolumn = "deviation_mm"\nunit = "mm"\n'
    Path("c.toml").write_text(columns + '[direction]\ncolumn = "direction"\nplus = "1"\nminus = "-1"\n')
    assert abbe("import", "folder/r01.csv", "--yes", "--columns", "c.toml", "--name", "again").code == 0
    first, again = figures(report(abbe, "x")), figures(report(abbe, "again"))
    assert {name: value for name, (value, _) in first.items()} == {name: value for name, (value, _) in again.items()}


def test_a_laser_file_becomes_a_certificate_and_a_file_for_statistics(abbe: Abbe) -> None:
    issuer = '[issuer]\nlaboratory = "Plant 2"\ncity = "Bonn"\ncountry = "DE"\nperson = "A. B."\n'
    Path("mill.toml").write_text(MACHINE_FILE + issuer)
    abbe("import", "x.rtl", "--yes", "--machine", "mill.toml")
    assert "the days of the measurement, which are not on record" in abbe.fails("report", "x", "--machine", "mill.toml", "--out", "x.xml")
    assert "--measured-on is '22.11.2026', expected a day" in abbe.fails(
        "report", "x", "--machine", "mill.toml", "--measured-on", "22.11.2026"
    )
    done = abbe("report", "x", "--machine", "mill.toml", "--measured-on", "2026-11-22", "--out", "x.xml", "--out", "x.dfq")
    assert done.code == 0, done.err
    root = ET.parse("x.xml").getroot()
    assert root.findtext(".//{*}beginPerformanceDate") == "2026-11-22"
    values = {(one.findtext(".//{*}content") or ""): one.findtext(".//{*}value") for one in root.iter("{https://ptb.de/dcc}quantity")}
    assert float(values["E: systematic deviation, both directions"] or "nan") == pytest.approx(14.0)
    assert "K2001/4 E" in Path("x.dfq").read_text(encoding="utf-8-sig")


def test_a_person_is_asked_at_the_terminal(tmp_path: Path) -> None:
    """Decimal sign, columns, units, axis and whether to store; the answers are kept beside the table, so that the next one needs none."""
    Path("t.csv").write_text(TABLE)
    answers = ["2", "y", "X", "y", "Target", "mm", "measured", "Reading", "mm", "y", "+", "-", "Dir", "y"]
    master, slave = pty.openpty()
    os.write(master, "".join(f"{one}\n" for one in answers).encode())
    command = [str(Path(sys.executable).with_name("abbe")), "import", "t.csv"]
    done = subprocess.run(command, stdin=slave, capture_output=True, text=True, check=False)
    os.close(master)
    os.close(slave)
    assert done.returncode == 0, done.stderr
    assert "your answers are in t.csv.columns.toml" in done.stderr
    assert "imported campaign 't' with 1 runs" in done.stdout
    again = subprocess.run(
        [*command, "--yes", "--name", "u"], stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=60, check=False
    )
    assert "imported campaign 'u' with 1 runs" in again.stdout, again.stderr
