"""What the lost motion made of a table's moves leaves the readings, with the right sign; everything else stays in them."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

import abbe
from abbe.drivers.tables import crc32, encode
from abbe.models.compensation.tables import NineTables
from abbe.models.solvers.applied_tables import AppliedTables
from abbe.service import cli
from abbe.service.campaign_data.campaign_folder import from_folder, from_store
from abbe.service.compensation.proposals import check_same_table
from abbe.service.discovery.discover import prepare
from abbe.service.discovery.simulate import simulate
from abbe.service.domain.measured import RunTable
from abbe.service.domain.solution_file import SolutionFile
from abbe.service.effects.effect_catalogue import catalogue
from abbe.service.errors import TableMismatch
from abbe.service.identification.removal import (
    IN_U,
    NO_TABLE,
    NOT_REMOVED,
    RemovedTable,
    campaign_table,
    remove_table,
    subtract_table,
    table_line,
)
from abbe.service.storage.store import Store
from abbe.service.tables.nine_tables import Base, table_image
from tests.run_documents import run_of
from tests.service.discovery.discovery_bench import WIDTH_MM, write_case

pytestmark = pytest.mark.usefixtures("solved_once")
DB = "sqlite:///book.sqlite3"
LOST = np.array([6e-3, 4e-3, 0.0])
BEAM = np.ones(3) / np.sqrt(3.0)


def correction(axes_mm: np.ndarray) -> np.ndarray:
    """Corrections that change along each axis by some micrometres per step, and turn round."""
    return 4e-3 * np.sin(axes_mm[:, [1, 2, 0]] / 15.0)


def steps() -> np.ndarray:
    """One axis after the other, as on a step diagonal."""
    moves = np.eye(3)[np.arange(60) % 3] * 10.0
    return np.vstack([np.zeros(3), np.cumsum(moves, axis=0)])


OUT = RemovedTable(AppliedTables(correction, LOST), AppliedTables(correction))


def run(axes: np.ndarray, reading: np.ndarray, kind: str, **setup: Any) -> dict[str, Any]:
    columns = {f"{c}_mm": axes[:, a].tolist() for a, c in enumerate("xyz")} | {"deviation_mm": reading.tolist()}
    return {"run_id": "r", "role": "identify", "test": kind, "setup": setup, "columns": columns}


def drives(axes: np.ndarray) -> np.ndarray:
    """Where axes with lost motion stand, each following its drive at the last possible moment; approached from below."""
    at = np.empty_like(axes)
    for a in range(3):
        half, axis = LOST[a] / 2, -np.inf
        for n, drive in enumerate(axes[:, a]):
            axis = drive - half if n == 0 else min(max(axis, drive - half), drive + half)
            at[n, a] = axis
    return at


def test_the_play_leaves_and_the_correction_stays() -> None:
    axes, own = steps(), 1e-3 * np.linspace(0.0, 5.0, 61)
    commanded, corrected = drives(axes), drives(axes + correction(axes))
    table = correction(axes) @ BEAM - correction(axes[:1]) @ BEAM
    moved = (corrected - commanded) @ BEAM
    read = own + moved - moved[0]
    there = run(axes, read, "laser_step_diagonal", start_mm=axes[0].tolist(), end_mm=axes[-1].tolist(), order="XYZ")
    told = subtract_table([run_of(there)], OUT)[0].columns.readings_mm
    assert np.abs(read - own - table).max() > 2e-3
    assert np.abs(told - own - table).max() < 1e-4  # the beam of the set-up and BEAM are one line


def test_a_run_without_readings_stays() -> None:
    there = replace(run_of(run(steps(), np.zeros(61), "laser_step_diagonal")), columns=run_of({"columns": {"x_mm": [0.0]}}).columns)
    assert there.is_sealed
    assert subtract_table([there], OUT) == [there]


@pytest.mark.parametrize("acting", [False, None, True])
def test_runs_of_a_table_that_did_not_act_are_refused(acting: bool | None) -> None:
    base = cast("Base", SimpleNamespace(crc=5, tables="some"))
    one = run_of({"table": {"crc": 5} | ({} if acting is None else {"acting": acting})})
    if acting is False:
        with pytest.raises(TableMismatch, match="did not act"):
            check_same_table(base, [one])
    else:
        check_same_table(base, [one])


def kinked() -> NineTables:
    """Corrections of X by X that change by 0.4 µm from point to point: kinks that are not error of a machine."""
    at = np.linspace(0.0, 600.0, 25), np.linspace(0.0, 500.0, 21), np.linspace(0.0, 450.0, 19)
    values = [np.zeros((a.size, 3)) for a in at]
    values[0][1::2, 0] = 4e-4
    none = [np.full_like(v, np.nan) for v in values]
    return NineTables(at, (values[0], values[1], values[2]), (none[0], none[1], none[2]))


def measured_with(image: bytes, folder: Path) -> Path:
    """The campaign `july`, whose runs state this table as acting."""
    write_case(folder, campaign="july")
    for path in folder.glob("r*.json"):
        path.write_text(json.dumps(json.loads(path.read_text()) | {"table": {"crc": crc32(image), "acting": True}}))
    return folder


def test_every_command_takes_the_table_out_that_the_database_knows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], clean_environment: object
) -> None:
    """Solved or searched, by a command or by the service: one and the same readings, else one machine would get two models."""
    monkeypatch.chdir(tmp_path)
    image = encode(table_image(kinked(), 100, 7))
    folder = measured_with(image, tmp_path / "files")
    assert cli.run(["import", str(folder), "--db", DB]) == 0
    with Store.open(DB) as store:
        before = from_store(store, "july")
        then = campaign_table(store, before)
        assert (then.table, then.why) == (None, f"measured with table {crc32(image):08X}, which is not in this database: {NOT_REMOVED}")
        assert prepare(before, catalogue(), None, table=then).flags[-1] == then.why
        store.tables.add(store.campaigns.find("july").machine_id, None, image, crc32(image), {})
        then = campaign_table(store, before)
        left = remove_table(before, then.table)
        job = prepare(before, catalogue(), None, table=then)
        assert left.removed is not None
        assert job.flags[-1] == table_line(left.removed)
        assert all(a.columns.equals(b.columns) for a, b in zip(job.runs, left.runs, strict=True))
        assert job.campaign is before
        gap = before.runs[0].columns.readings_mm - left.runs[0].columns.readings_mm
        assert np.abs(gap).max() > 1e-4
        # What is predicted is what the instrument reads: with the table, whose part was taken out of the readings only to be solved.
        plain = prepare(left, catalogue(), None)
        added = simulate(job).predicted_mm["r01"] - simulate(plain).predicted_mm["r01"]
        assert np.allclose(added, gap, atol=1e-9)
        # The digest of a search is that of what was measured: a solver's last digit makes no other search.
        moved = [run if run.is_sealed else run.with_readings(run.columns.readings_mm + 1e-12) for run in job.runs]
        assert replace(job, runs=moved).digest == job.digest
        assert prepare(before, catalogue(), None).digest != job.digest
    capsys.readouterr()
    assert cli.run(["solve", "july", "--db", DB, "--model", "rigid6", "--json"]) == 0
    told = SolutionFile.model_validate_json(capsys.readouterr().out).table_removal
    assert told is not None
    assert told.crc == crc32(image)
    assert told.lost_motion_mm == left.removed.lost_motion_mm
    x = told.lost_motion_mm["X"]
    assert abs(x.value - WIDTH_MM) < 4.0 * x.u + 1e-3
    assert cli.run(["solve", "july", "--db", DB, "--model", "rigid6"]) == 0
    assert f"table {crc32(image):08X} was in force: its side effects (beyond smooth corrections) are subtracted" in " ".join(
        capsys.readouterr().out.split()
    )


def solved(capsys: pytest.CaptureFixture[str], *words: str) -> SolutionFile:
    capsys.readouterr()
    assert cli.run(["solve", *words, "--model", "rigid6", "--json"]) == 0
    return SolutionFile.model_validate_json(capsys.readouterr().out)


def digests(report: Any) -> list[str]:
    """SHA-256 of all data that a report names."""
    return re.findall(r"\b[0-9a-f]{64}\b", json.dumps(report))


def test_an_exported_folder_gives_the_same_answer_as_the_database(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], clean_environment: object
) -> None:
    """It holds the table that was in force; without that file the answer says so, and a damaged file is refused."""
    monkeypatch.chdir(tmp_path)
    image = encode(table_image(kinked(), 100, 7))
    folder = measured_with(image, tmp_path / "files")
    file = f"table-{crc32(image):08X}.bin"
    (folder / file).write_bytes(image)
    assert cli.run(["import", str(folder), "--db", DB]) == 0
    assert cli.run(["export", "july", "out", "--db", DB]) == 0
    assert (tmp_path / "out" / file).read_bytes() == image
    stored, read = solved(capsys, "july", "--db", DB), solved(capsys, "out")
    assert read.table_removal == stored.table_removal
    assert read.table_removal is not None
    assert read.parameters == stored.parameters
    assert abbe.solve(abbe.read_campaign(tmp_path / "out"), model="rigid6").table.startswith(f"table {crc32(image):08X} was in force")
    assert cli.run(["solve", "out", "--model", "rigid6", "--report", "report.json"]) == 0
    assert cli.run(["solve", "july", "--db", DB, "--model", "rigid6", "--report", "stored.json"]) == 0
    reports = [json.loads((tmp_path / name).read_text()) for name in ("report.json", "stored.json")]
    assert digests(reports[0]) == digests(reports[1])  # of the readings as measured
    assert digests(reports[0])
    assert cli.run(["solve", "out", "--model", "rigid6", "--db", "sqlite:///new.sqlite3"]) == 0
    with Store.open("sqlite:///new.sqlite3") as store:
        assert [table.crc for table in store.tables.all()] == [crc32(image)]
    (tmp_path / "out" / file).rename(tmp_path / file)
    without = solved(capsys, "out")
    assert without.table_removal is None
    missing = f"measured with table {crc32(image):08X}, which is not in this folder"
    assert without.table_not_removed == f"{missing}: {NOT_REMOVED}; {IN_U}"
    assert "table" in {line.source for line in without.uncertainty.budget}
    assert "table" not in {line.source for line in read.uncertainty.budget}
    assert abbe.solve(abbe.read_campaign(tmp_path / "out"), model="rigid6").table == without.table_not_removed
    for where in ("", " or this database"):  # the first command makes the database
        assert f"{missing}{where}: " in str(solved(capsys, "out", "--db", "sqlite:///empty.sqlite3").table_not_removed)
    known = solved(capsys, "out", "--db", DB)  # which has the table
    assert (known.table_removal, known.parameters) == (stored.table_removal, stored.parameters)
    (tmp_path / "out" / file).write_bytes(image[:-1])
    assert cli.run(["solve", "out"]) == 2
    assert "the CRC of this table is" in capsys.readouterr().err


def test_a_table_of_a_kind_that_nobody_reads_is_not_known(tmp_path: Path) -> None:
    folder = write_case(tmp_path / "files", campaign="july")
    with Store.open(f"sqlite:///{tmp_path / 'a.sqlite3'}") as store:
        read = from_folder(folder)
        before = replace(read, runs=[replace(run, table=RunTable(crc=5)) for run in read.runs])
        store.tables.add(store.machines.add("VMC-1", {}), None, b"someone else's", 5, {})
        then = campaign_table(store, before)
        assert (then.table, then.why) == (None, f"measured with table 00000005, of a kind that cannot be read: {NOT_REMOVED}")


def test_runs_of_another_table_or_of_none_keep_their_readings(tmp_path: Path) -> None:
    read = from_folder(write_case(tmp_path / "files", campaign="july"))
    tables = (RunTable(crc=5, acting=True), RunTable(crc=5), RunTable(crc=5, acting=False), RunTable(crc=6))
    before = replace(read, runs=[replace(run, table=table) for run, table in zip(read.runs, tables, strict=True)])
    left = remove_table(before, kinked())
    same = [a.columns.equals(b.columns) for a, b in zip(before.runs, left.runs, strict=True)]
    assert same == [False, False, True, True]  # the third is held out, and was measured with the compensation switched off
    with Store.open(f"sqlite:///{tmp_path / 'a.sqlite3'}") as store:
        before.runs[1] = replace(before.runs[1], table=RunTable(crc=6))
        assert campaign_table(store, before).why.startswith("the runs were measured with different compensation tables")
        off = replace(before, runs=[replace(run, table=RunTable(crc=6, acting=False)) for run in before.runs])
        assert campaign_table(store, off) == NO_TABLE
