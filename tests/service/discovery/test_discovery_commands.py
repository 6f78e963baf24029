"""`abbe discover`, `abbe model`, `abbe effects` around the search: what is printed, written, stored, compared and taken back."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from abbe.models.effects.catalogue import CATALOGUE
from abbe.service import cli
from abbe.service.campaign_data.campaign_folder import from_folder, from_store
from abbe.service.discovery.discover import prepare
from abbe.service.domain.discovery_file import DiscoveryFile
from abbe.service.effects.effect_catalogue import catalogue
from abbe.service.effects.model_book import current, no_table_lines
from abbe.service.identification.removal import NO_TABLE, remove_effects
from abbe.service.storage.store import Store
from tests.service.discovery.discovery_bench import WIDTH_MM, Search, write_case

DB = "sqlite:///book.sqlite3"
Call = Callable[..., tuple[int, str, str]]


@pytest.fixture
def abbe(capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, clean_environment: object) -> Call:
    monkeypatch.chdir(tmp_path)

    def call(*words: object) -> tuple[int, str, str]:
        code = cli.run([str(w) for w in words])
        out, err = capsys.readouterr()
        return code, " ".join(out.split()), err

    return call


@pytest.fixture
def finds(monkeypatch: pytest.MonkeyPatch) -> Callable[[Search], Search]:
    def use(search: Search) -> Search:
        monkeypatch.setattr("abbe.service.discovery.discover.search", search)
        return search

    return use


def test_a_named_effect_is_told_written_drawn_and_stored(abbe: Call, finds: Callable[[Search], Search], tmp_path: Path) -> None:
    finds(Search())
    folder = write_case(tmp_path / "c1")
    assert abbe("discover", folder, "--json", "--out", "a.json")[:2] == (0, "")
    code, out, _ = abbe("discover", folder, "--db", DB, "--report", "a.html")
    assert code == 0
    for words in (
        "backlash (lost motion) X: 8.00 ± 0.20 µm",
        "what to do: enter the width as backlash compensation of the axis",
        "(a parameter of the control)",
        "what else it could be: ",
        "67 times less likely",
        "measure next: the same path at a second feed to tell backlash:X from lateral_play:EYX (about 12 min",
        "never fitted",
        "stored: discovery 1, EXPLAINED, model version 1 of VMC-1",
    ):
        assert words in out
    answer = json.loads((tmp_path / "a.json").read_text())
    DiscoveryFile.model_validate_json((tmp_path / "a.json").read_text())
    assert (answer["format"], answer["verdict"], list(answer["predictions"])) == ("abbe-discovery/1", "named", ["r04"])
    assert answer["effects"][0]["parameters"]["strength"] == 8.0
    page = (tmp_path / "a.html").read_text()
    for words in (
        "What to do",
        "What else it could be",
        "Noise floor",
        "never fitted",
        "EXPLAINED",
        "runs predicted",
        "explains less than",
    ):
        assert words in page
    assert page.count("<svg") >= 4
    assert not re.search(r"<script|https?://|@import|url\(", page)
    again = abbe("discover", "c1", "--db", DB, "--report", "b.html")  # from the store: nothing is computed, the page is the same
    assert again[0] == 0
    made = r"<dt>Made</dt><dd>[^<]+"
    assert re.sub(made, "", (tmp_path / "b.html").read_text()) == re.sub(made, "", page)


@pytest.mark.parametrize(
    ("verdict", "told", "sign"),
    [
        ("none", "Nothing is missing. The present model explains all runs to their noise", "verdict ok"),
        ("unknown", "Something is missing that the catalogue does not explain.", "verdict bad"),
    ],
)
def test_every_verdict_has_words_a_page_and_exit_code_0(
    abbe: Call, finds: Callable[[Search], Search], tmp_path: Path, verdict: str, told: str, sign: str
) -> None:
    finds(Search(verdict))  # type: ignore[arg-type]
    folder = write_case(tmp_path / "c1", width_mm=0.0 if verdict == "none" else WIDTH_MM)
    code, out, _ = abbe("discover", folder, "--report", "a.html")
    assert code == 0
    assert told in out
    assert "stored" not in out
    if verdict == "unknown":
        assert "about X 310, Y 240, Z 100 mm, within 30" in out
        assert "measure next: repeat the measurement where the gap appears (seen in ballbar circle; axis X; about X 310" in out
    page = (tmp_path / "a.html").read_text()
    assert sign in page
    assert "No further measurement is needed" not in page
    assert ("What to measure next" in page) == (verdict == "unknown")
    assert ("Gap closed by a structure without a name" in page) == (verdict == "unknown")
    assert "with what was found" not in page
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.html", "c1"]


def test_ctrl_c_keeps_what_is_there_and_the_same_command_goes_on(abbe: Call, finds: Callable[[Search], Search], tmp_path: Path) -> None:
    class Stopped(Search):
        def __call__(self, *_: object) -> object:  # type: ignore[override]
            raise KeyboardInterrupt

    finds(Stopped())
    folder = write_case(tmp_path / "c1")
    code, _, stopped = abbe("discover", folder, "--db", DB)
    assert code == 130
    finds(Search())
    code, out, err = abbe("discover", folder, "--db", DB)
    assert "stopped: discovery 1 is in state FITTED; the same command resumes there" in stopped
    assert (code, err.count("stopped")) == (0, 0)
    assert "stored: discovery 1, EXPLAINED" in out


def test_the_book_is_used_compared_and_taken_back(abbe: Call, finds: Callable[[Search], Search], tmp_path: Path) -> None:
    finds(Search())
    abbe("discover", write_case(tmp_path / "june"), "--db", DB)
    july = write_case(tmp_path / "july", campaign="july", width_mm=10e-3)
    with Store.open(DB) as store:
        book = current(store, "VMC-1")
    job = prepare(from_folder(july), catalogue(), book)
    assert job.known == ("backlash:X",)
    plain = prepare(from_folder(july), catalogue())
    taken = [a.deviation_mm - b.deviation_mm for a, b in zip(plain.case.runs[:3], job.case.runs[:3], strict=True)]  # type: ignore[operator]
    assert np.allclose(np.abs(np.concatenate(taken)).max(), 0.5 * WIDTH_MM, atol=1e-5)  # the centre has no sign
    assert no_table_lines(book)[0].startswith("backlash (lost motion) X (model version 1) needs a parameter of the control, not tables: ")
    finds(Search(width_um=2.0))
    assert "model version 2" in abbe("discover", july, "--db", DB)[1]
    out = abbe("model", "diff", "--of", "VMC-1", 1, "--db", DB)[1]
    assert "backlash:X changed 8.00 ± 0.20 10.00 ± 0.28 µm" in out
    finds(Search(width_um=-9.95))  # somebody mended it
    assert "model version 3" in abbe("discover", write_case(tmp_path / "august", campaign="august", width_mm=5e-5), "--db", DB)[1]
    out = abbe("model", "show", "--of", "VMC-1", "--db", DB)[1]
    assert "removed: backlash:X" in out
    assert abbe("model", "revert", "--of", "VMC-1", 1, "--db", DB)[1] == "machine VMC-1: version 4 is current; it equals version 1"
    listed = json.loads(abbe("model", "list", "--of", "VMC-1", "--db", DB, "--json")[1])
    assert [(m["version"], [e["label"] for e in m["effects"]]) for m in listed] == [
        (1, ["backlash:X"]),
        (2, ["backlash:X", "backlash:X"]),
        (3, []),
        (4, ["backlash:X"]),
    ]
    assert "hold the same effects" in abbe("model", "diff", "--of", "VMC-1", 1, 4, "--db", DB)[1]


def test_tables_are_made_without_what_they_cannot_take_out(abbe: Call, finds: Callable[[Search], Search], tmp_path: Path) -> None:
    finds(Search())
    abbe("discover", write_case(tmp_path / "june"), "--db", DB)
    abbe("import", write_case(tmp_path / "july", campaign="july"), "--db", DB)
    with Store.open(DB) as store:
        told = remove_effects(store, from_store(store, "july"), NO_TABLE)
        raw = from_store(store, "july")
    assert (told.labels, told.version) == (("backlash:X",), 1)
    assert told.doc["machine_model"]["not_for_tables"] == list(told.lines)
    assert "needs a parameter of the control, not tables: enter the width as backlash compensation" in told.lines[0]
    known = prepare(raw, catalogue(), None).case.runs[0].path
    expected = catalogue()[0].signal((known,), "X", {})[0][:, 0] * 8.0
    before, after = (c.runs[0].columns.readings_mm for c in (raw, told.campaign))
    assert np.allclose(before - after, expected, atol=1e-12)
    assert np.ptp(expected) > 0.9 * WIDTH_MM
    assert told.campaign.runs[3].is_sealed


def test_a_model_of_another_geometry_is_not_used(abbe: Call, finds: Callable[[Search], Search], tmp_path: Path) -> None:
    finds(Search())
    abbe("discover", write_case(tmp_path / "june"), "--db", DB)
    other = write_case(tmp_path / "july", campaign="july")
    for path in other.glob("*.json"):
        path.write_text(path.read_text().replace("w-X-Y-b-Z-t", "w-Y-X-b-Z-t"))
    with Store.open(DB) as store:
        job = prepare(from_folder(other), catalogue(), current(store, "VMC-1"))
    assert job.known == ()
    assert "another geometry" in job.flags[-1]
    abbe("import", other, "--db", DB)
    with Store.open(DB) as store:
        raw = from_store(store, "july")
        told = remove_effects(store, raw, NO_TABLE)
    line = "model version 1 of VMC-1 is for another geometry and was not used"
    assert (told.lines, told.labels, told.campaign.runs) == ((line,), (), raw.runs)
    assert told.doc["machine_model"]["not_for_tables"] == [line]


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (("discover", "nowhere"), "error STO-001: nowhere is neither a folder with campaign.json nor a campaign"),
        (("simulate", "nowhere"), "error STO-001: nowhere is neither a folder with campaign.json nor a campaign"),
        (("effects", "backlsh"), "error DIS-002: the catalogue has no effect 'backlsh' - did you mean backlash"),
        (("model", "show", "--of", "M", "--db", "sqlite://"), "error DIS-001: machine 'M' has no version 0: it has no model"),
        (("model", "revert", "--of", "M", "3", "--db", "sqlite://"), "error DIS-001: machine 'M' has no version 3"),
    ],
)
def test_bad_input_is_one_line(abbe: Call, words: tuple[str, ...], line: str) -> None:
    code, out, err = abbe(*words)
    assert (code, out) == (2, "")
    assert err.startswith(line)
    assert err.count("\n") == 1


def test_the_catalogue_is_a_table_and_every_effect_a_page(abbe: Call) -> None:
    out = abbe("effects")[1]
    for effect in CATALOGUE:
        assert effect.name in out
        code, page, _ = abbe("effects", effect.name)
        assert code == 0
        for text in (effect.title, effect.signature, effect.needs, effect.remedy_text, effect.source):
            assert " ".join(text.split()) in page
    assert {e["name"] for e in json.loads(abbe("effects", "--json")[1])} == {e.name for e in CATALOGUE} | {"slow_drift"}


def test_a_simulation_shows_the_gap_and_predicts_sealed_runs(abbe: Call, tmp_path: Path) -> None:
    folder = write_case(tmp_path / "c1")
    doc = json.loads(abbe("simulate", folder, "--json", "--report", "s.html")[1])
    assert doc["runs"]["r01"]["rms_before_um"] > 2.0 * doc["runs"]["r01"]["floor_um"]  # backlash is in no rigid model
    assert "rms_before_um" not in doc["runs"]["r04"]
    assert len(doc["predictions"]["r04"]) == 120
    assert "Measured and simulated differ" in abbe("simulate", folder)[1]
    assert "measured against simulated" in (tmp_path / "s.html").read_text()
