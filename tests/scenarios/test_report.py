"""`abbe report` on what simulated devices measured: every kind of report, read back from the file by programs that know nothing of it."""

import asyncio
import csv
import io
import json
import os
import re
import shutil
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from datetime import UTC, datetime
from functools import cache
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pypdf
import pytest

from abbe.models.compensation.tables import NineTables, grid_positions, quantise
from abbe.service.cli import run
from abbe.service.compensation.pushing import Pushing, Questions, WantedTable
from abbe.service.config import load_machine
from abbe.service.devices.session import open_session
from abbe.service.domain.schedule import Schedule
from abbe.service.domain.verification import CheckResult
from abbe.service.push.operations import VerificationResult
from abbe.service.rendering.numbers import with_uncertainty
from abbe.service.runs.columns import load_run
from abbe.service.site import site_of
from abbe.service.storage.store import Store
from abbe.service.tables.nine_tables import read_base
from abbe.service.verification import verify
from abbe.service.verification.verify import figure_rows, figures
from tests.scenarios.conftest import simulated

pytestmark = [pytest.mark.scenario, pytest.mark.timeout(240)]

KINDS = {
    "run": ("small/cx",),
    "campaign": ("small",),
    "verification": ("verification", "1"),
    "push": ("push", "1"),
    "discovery": ("discovery", "1"),
}
FORMS = ("pdf", "html", "csv", "json")

AXIS = """
format = "abbe-recipe/1"
name = "axis"
[[test]]
kind = "line"
label = "lx"
setup = "LX"
axis = "X"
positions = 5
cycles = 3
overrun_mm = 2.0
at_share = [0.5, 0.5]
"""
SMALL = (
    AXIS.replace('"axis"', '"small"')
    + """
[[test]]
kind = "circle"
label = "cx"
setup = "cup"
centre_mm = [300.0, 250.0, 100.0]
radius_mm = 100.0
rate_hz = 20
plane = "XY"
[[test]]
kind = "circle"
label = "cy"
setup = "cup"
centre_mm = [300.0, 250.0, 100.0]
radius_mm = 100.0
rate_hz = 20
plane = "XY"
direction = -1
[[test]]
kind = "helix"
label = "h1"
setup = "cup2"
centre_mm = [300.0, 250.0, 100.0]
radius_mm = 80.0
rate_hz = 20
turns = 3.0
"""
    + "".join(
        f'[[test]]\nkind = "diagonal"\nlabel = "{d}"\nsetup = "D{d}"\ndiagonal = "{d}"\nsteps = 5\n' for d in ("ppp", "npp", "pnp", "ppn")
    )
)


def command(*words: str) -> None:
    assert run([str(w) for w in words]) == 0


async def pushed(machine_file: Path) -> None:
    """A small table on its real way into the simulated controller; the questions of the job are answered by hand."""
    site = site_of(load_machine(machine_file).machine)
    grids = grid_positions(site.machine, (5, 4, 3))
    curves = tuple((g - g[0])[:, None] * np.full(3, 1e-5) for g in grids)
    none = tuple(np.zeros_like(c) for c in curves)
    tables = quantise(NineTables(grids, (curves[0], curves[1], curves[2]), (none[0], none[1], none[2])), 1e-4)

    async def yes() -> VerificationResult:
        return VerificationResult(True, "seen by hand")

    with Store.open(f"sqlite:///{machine_file.parent / 'abbe.sqlite3'}") as store:
        async with open_session(site.urls) as session:
            wanted = WantedTable(tables, await read_base(session.controller), 100, None, {})
            done = await Pushing(session.controller, store, site).bring(wanted, Questions(list, "A. Metrologist", yes, yes))
        assert done.kept


def verified(folder: Path) -> None:
    """What a correction stores of its verification."""
    with Store.open(f"sqlite:///{folder / 'abbe.sqlite3'}") as store:
        campaign = store.campaigns.find("small")
        runs = [
            r for r in (load_run(store, one.id) for one in store.runs.all(campaign.id)) if r.test in {"laser_diagonal", "ballbar_helix"}
        ]
        rows = {k: {"value": v, "u": u} for k, (v, u) in figure_rows(figures(runs)).items()}
        store.verifications.add(campaign.machine_id, campaign.id, "pass", {"text": "better than before", "push": 1, "figures": rows})


@pytest.fixture(scope="module")
def stored(tmp_path_factory) -> Iterator[Path]:
    """A folder with a machine file and a database: two measured campaigns, solution, discovery, push, verification."""
    folder = tmp_path_factory.mktemp("report")
    with simulated(folder, "--speed", "100", "--seed", "5") as sims, pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        (folder / "axis.toml").write_text(AXIS)
        (folder / "small.toml").write_text(SMALL)
        for name in ("axis", "small"):
            command("measure", "-m", sims.machine_file, "--recipe", f"{name}.toml", "--name", name)
        command("solve", "small", "--model", "rigid6", "--machine", sims.machine_file)
        command("discover", "axis", "--machine", sims.machine_file)
        asyncio.run(pushed(sims.machine_file))
        verified(folder)
    return folder


class Words(HTMLParser):
    """Text of a page, without its styles; and every address it names."""

    def __init__(self) -> None:
        super().__init__()
        self.text: list[str] = []
        self.links: list[str] = []
        self.inside: list[str] = []

    def handle_starttag(self, tag, attrs) -> None:
        self.links += [str(v) for k, v in attrs if k in {"href", "src", "action"}]
        if tag in {"style", "script"}:
            self.inside.append(tag)

    def handle_endtag(self, tag) -> None:
        if tag in {"style", "script"}:
            self.inside.pop()

    def handle_data(self, data) -> None:
        if not self.inside:
            self.text.append(data)


def squeezed(text: str) -> str:
    """Without blanks and line ends: where a program breaks its lines does not count."""
    return re.sub(r"[\s\u200b\u00ad]+", "", text)


def text_of(path: Path) -> str:
    if path.suffix == ".pdf":
        return squeezed("".join(page.extract_text() for page in pypdf.PdfReader(path).pages))
    words = Words()
    words.feed(path.read_text())
    assert not words.links
    return squeezed("".join(words.text))


@cache
def reports(folder: Path, kind: str) -> dict[str, Path]:
    """Every form of a kind, made once: nothing in the folder changes."""
    files = {form: folder / f"{kind}-a.{form}" for form in FORMS}
    command("report", *KINDS[kind], "--machine", folder / "machine.toml", *(w for f in files.values() for w in ("--out", f)))
    return files


@pytest.mark.parametrize("kind", KINDS)
def test_every_form_of_every_kind_says_the_same(stored, kind):
    files = reports(stored, kind)
    doc = json.loads(files["json"].read_text())
    assert (doc["format"], doc["kind"]) == ("abbe-report/1", kind)
    assert doc["figures"]
    rows = list(csv.DictReader(io.StringIO(files["csv"].read_text())))
    assert len(rows) == len(doc["figures"])
    for row, figure in zip(rows, doc["figures"], strict=True):
        assert row["value"] == ("" if figure["value"] is None else repr(figure["value"]))
        assert row["expanded"] == ("" if figure["expanded"] is None else repr(figure["expanded"]))
    for form in ("pdf", "html"):
        text = text_of(files[form])
        for figure in doc["figures"]:
            u = None if figure["expanded"] is None else figure["expanded"] / figure["k"]
            value, expanded = with_uncertainty(figure["value"], u)
            line = figure["symbol"] + figure["name"] + (value + expanded if figure["unit"] else "")
            assert squeezed(line) in text, (form, line)
        whole = [doc["title"], doc["verdict"]["word"], doc["decision_rule"], doc["uncertainty"], doc["provenance"]["Data (SHA-256)"]]
        whole += [*doc["not_observable"], *doc["remarks"], *doc["statements"], *doc["signatures"]]
        assert [w for w in whole if squeezed(w) not in text] == []


def test_the_same_data_give_the_same_bytes_in_another_process_on_another_day(stored):
    first = {kind: {form: path.read_bytes() for form, path in reports(stored, kind).items()} for kind in KINDS}
    again = {kind: {form: stored / f"{kind}-c.{form}" for form in FORMS} for kind in KINDS}
    words = [
        ["report", *KINDS[kind], "--machine", str(stored / "machine.toml"), *(w for f in files.values() for w in ("--out", str(f)))]
        for kind, files in again.items()
    ]
    program = "import json, sys; from abbe.service.cli import run; sys.exit(sum(run(w) for w in json.loads(sys.argv[1])))"
    environment = os.environ | {"TZ": "Asia/Tokyo", "SOURCE_DATE_EPOCH": "86400", "LC_ALL": "C", "PYTHONHASHSEED": "7"}
    subprocess.run([sys.executable, "-c", program, json.dumps(words)], check=True, env=environment, capture_output=True)
    differ = [(kind, form) for kind, files in again.items() for form, path in files.items() if path.read_bytes() != first[kind][form]]
    assert differ == []
    made = [pypdf.PdfReader(files["pdf"]).metadata.creation_date for files in again.values()]
    assert {f"{one:%H:%M:%S}" for one in made if one is not None} == {"00:00:00"}  # the day of the measurement, not the time of the report


def test_the_campaign_report_holds_what_the_standards_ask_for(stored):
    doc = json.loads(reports(stored, "campaign")["json"].read_text())
    symbols = {f["symbol"] for f in doc["figures"]}
    assert {"A", "E", "M", "B", "R", "G_XY", "G_YX", "G(b)_XY", "H_XY", "E_d", "M_d", "B_d", "EXX", "C0Y", "helix rms"} <= symbols
    by = {f["symbol"]: f for f in doc["figures"]}
    assert by["diagonal, worst"]["limit"] == 20.0
    assert by["diagonal, worst"]["verdict"] == "fail"
    assert by["M_d"]["value"] == pytest.approx(by["diagonal, worst"]["value"], abs=1e-9)  # the same figure, found on two ways
    assert doc["verdict"]["word"] == "Out of limits then"  # a push brought another table since
    assert any(r.startswith("this report is about the table in force at that time") for r in doc["remarks"])
    assert {i["name"]: i["certificate"] for i in doc["instruments"]} == {
        "telescoping ball-bar": "valid to 2099-12-31", "laser displacement meter": "valid to 2099-12-31",
    }  # fmt: skip
    assert "Air temperature" in doc["conditions"]
    assert any("3 cycles; ISO 230-2 asks for 5" in r for r in doc["remarks"])
    assert not any("overrun" in r and r.startswith("axis X") for r in doc["remarks"])


def test_a_changed_reading_changes_the_hash(stored):
    one, other = (json.loads(reports(stored, kind)["json"].read_text())["provenance"] for kind in ("campaign", "run"))
    assert re.fullmatch("[0-9a-f]{64}", one["Data (SHA-256)"])
    assert one["Data (SHA-256)"] != other["Data (SHA-256)"]


def test_the_push_report_shows_who_pushed_and_every_entry_of_the_journal(stored):
    doc = json.loads(reports(stored, "push")["json"].read_text())
    assert doc["verdict"]["word"] == "Kept"
    assert "Approved by" not in doc["about"]
    assert (doc["about"]["Pushed by"], doc["about"]["Approval"]) == ("A. Metrologist", "no second person was asked for")
    journal = next(t for t in doc["tables"] if t["title"] == "Journal")["rows"]
    assert [r[1].split(" ")[0].rstrip(":") for r in journal][:3] == ["SNAPSHOT", "VALIDATED", "APPROVED"]
    assert not any("JOURNAL WAS CHANGED" in r for r in doc["remarks"])
    assert any(f["symbol"] == "diagonal, worst" for f in doc["figures"])  # of the verification that belongs to it


def test_a_journal_that_somebody_changed_is_told_on_the_report(stored, tmp_path):
    """On a copy of the database, past the program."""
    shutil.copy(stored / "abbe.sqlite3", tmp_path / "other.sqlite3")
    with sqlite3.connect(tmp_path / "other.sqlite3") as db:
        db.execute("UPDATE push_entries SET doc = replace(doc, 'A. Metrologist', 'Somebody else')")
    command("report", "push", "1", "--db", f"sqlite:///{tmp_path / 'other.sqlite3'}", "--out", tmp_path / "a.json")
    doc = json.loads((tmp_path / "a.json").read_text())
    assert any(r.startswith("THE JOURNAL WAS CHANGED") for r in doc["remarks"])


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("nothing-of-that-name",), "STO-002"),
        (("push",), "which push?"),
        (("push", "77"), "no push 77"),
        (("push", "1", "--of", "atlantis"), "no machine 'atlantis'"),
        (("discovery", "77"), "no discovery 77"),
        (("verification", "77"), "no verification 77"),
        (("small", "3"), "give one name"),
        (("small", "--out", "a.docx"), ".pdf, .html, .csv, .json"),
    ],
)
def test_bad_requests_are_one_line(stored, capsys, monkeypatch, words, told):
    monkeypatch.chdir(stored)
    assert run(["report", *words, "--machine", str(stored / "machine.toml")]) == 2
    err = capsys.readouterr().err
    assert told in err
    assert err.count("\n") == 1
    assert not (stored / "a.docx").exists()


def test_a_scheduled_check_is_reported_with_the_limits_it_was_judged_by(stored, tmp_path):
    """Stored by the scheduler, whose document differs from a correction's; here it had other limits than the machine file has now."""
    rows = {"body_diagonal_um": 12.0, "helix_rms_um": 3.0}
    when = datetime(2026, 11, 1, 6, tzinfo=UTC)
    limits = {"body_diagonal_um": 10.0, "helix_rms_um": 5.0}
    found = CheckResult(
        "cannot tell", rows, {"body_diagonal_um": 3.0, "helix_rms_um": 0.4}, limits, ["h1"], "small", when, 9.0, "too close"
    )
    doc = verify.check_doc(verify.Occasion("sim", Schedule("nightly", "0 6 * * *", "UTC", "quick-check", 600.0), when), found)
    copied = tmp_path / "other.sqlite3"
    shutil.copy(stored / "abbe.sqlite3", copied)
    with Store.open(f"sqlite:///{copied}") as store:
        campaign = store.campaigns.find("small")
        number = store.verifications.add(campaign.machine_id, campaign.id, doc["verdict"], doc)
    command(
        "report", "verification", number, "--db", f"sqlite:///{copied}", "--machine", stored / "machine.toml", "--out", tmp_path / "a.json"
    )
    told = json.loads((tmp_path / "a.json").read_text())
    judged = {f["symbol"]: (f["value"], f["expanded"], f["limit"], f["verdict"]) for f in told["figures"][:2]}
    assert judged == {"diagonal, worst": (12.0, 3.0, 10.0, "cannot tell"), "helix rms": (3.0, 0.4, 5.0, "pass")}
    assert told["verdict"]["word"] == "Cannot tell"
    assert (told["about"]["Schedule"], told["about"]["Campaign"]) == ("nightly", "small")


def test_without_a_file_name_a_pdf_is_written_here(stored, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    command("report", "small/lx", "--db", f"sqlite:///{stored / 'abbe.sqlite3'}")
    assert pypdf.PdfReader(tmp_path / "run-small-lx.pdf").pages
