"""A machine that is measured again is compared with its last solution: what has changed is named, a table in between is not a change."""

from __future__ import annotations

import hashlib
import json
import os
import pickle
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from abbe.drivers.tables import crc32, encode
from abbe.models.compensation.tables import NineTables
from abbe.models.discovery import changed_since as changed
from abbe.service.campaign_data.campaign_folder import from_store, store_solution
from abbe.service.discovery.changed_since import reference_solution
from abbe.service.discovery.changed_text import changed_lines, changed_text, proved
from abbe.service.discovery.discover import DiscoveryJournal, discover, prepare
from abbe.service.domain.discovery import FindingSource
from abbe.service.domain.document import document, record
from abbe.service.domain.finding import ChangedSince, EffectFound, Finding
from abbe.service.domain.results import NewVersion
from abbe.service.effects.effect_catalogue import catalogue
from abbe.service.effects.model_book import extended_book
from abbe.service.identification.solve import solve_runs
from abbe.service.identification.solve_report import solution_doc
from abbe.service.runs.exchange import import_folder
from abbe.service.storage.store import Store
from abbe.service.tables.nine_tables import table_image
from tests.run_documents import runs_of
from tests.scenarios.campaign_files import measured, write_folder
from tests.service.discovery.discovery_bench import Search

Doc = dict[str, Any]
SEED, GROWN = 1, 60e-6


@cache
def june() -> tuple[Doc, str, Doc]:
    """Machine, runs of June as text, and their solution."""
    site, runs = measured(SEED, "joint")
    return site.doc, json.dumps(runs), solution_doc(solve_runs(site, runs_of(runs)))


def moved(runs: list[Doc], per_mm: np.ndarray, seed: int) -> list[Doc]:
    """The same runs on a machine whose axes move farther by a share, read with other noise."""
    rng = np.random.default_rng(seed)
    for run in runs:
        columns, setup = run["columns"], run["setup"]
        axes = np.column_stack([columns[f"{c}_mm"] for c in "xyz"])
        if run["test"].startswith("laser"):
            added = ((axes - axes[0]) * per_mm) @ np.array(setup["nominal_beam"])
        else:
            away = axes - np.array(setup["centre_mm"])
            added = np.sum(away / np.linalg.norm(away, axis=1, keepdims=True) * away * per_mm, axis=1)
        columns["deviation_mm"] = (np.array(columns["deviation_mm"]) + added + rng.normal(0.0, 5e-5, len(added))).tolist()
    return runs


def growing(machine: Doc, per_mm: np.ndarray) -> NineTables:
    """A table that makes the axes move farther by a share."""
    at = tuple(np.linspace(*machine["stroke_mm"][axis], 21) for axis in "XYZ")
    values = [np.zeros((21, 3)) for _ in at]
    for a in range(3):
        values[a][:, a] = per_mm[a] * (at[a] - at[a][0])
    none = [np.full((21, 3), np.nan) for _ in at]
    return NineTables((at[0], at[1], at[2]), (values[0], values[1], values[2]), (none[0], none[1], none[2]))


@pytest.fixture(scope="module")
def book(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A database with the campaign of June and its solution."""
    folder = tmp_path_factory.mktemp("june")
    _, text, doc = june()
    with Store.open(f"sqlite:///{folder / 'book.sqlite3'}") as opened:
        put(opened, folder, "june", json.loads(text))
        store_solution(opened, from_store(opened, "june"), doc)
    return folder / "book.sqlite3"


@pytest.fixture
def store(tmp_path: Path, book: Path) -> Iterator[Store]:
    """A copy of it."""
    shutil.copy(book, tmp_path / "book.sqlite3")
    with Store.open(f"sqlite:///{tmp_path / 'book.sqlite3'}") as opened:
        yield opened


@pytest.fixture(scope="module", autouse=True)
def _same_readings_compared_once() -> Iterator[None]:
    """Several tests compare the same readings with the same solution: what comes of them is computed once."""
    compute, found = changed.changed_since, dict[bytes, changed.Changed]()

    def changed_since(*given: Any) -> changed.Changed:
        key = hashlib.sha256(pickle.dumps(given)).digest()
        if key not in found:
            found[key] = compute(*given)
        return found[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("abbe.service.discovery.changed_since.changed_since", changed_since)
        yield


def put(store: Store, place: Path, name: str, runs: list[Doc]) -> None:
    folder = write_folder(place / name, june()[0], [run | {"campaign": name} for run in runs])
    head = json.loads((folder / "campaign.json").read_text()) | {"campaign": name}
    (folder / "campaign.json").write_text(json.dumps(head))
    import_folder(store, folder)


def compared(store: Store, name: str, found: Sequence[EffectFound] = ()) -> ChangedSince | None:
    campaign = from_store(store, name)
    since = reference_solution(store, campaign)
    return None if since is None else since.compare(campaign, found)


def test_an_axis_that_grows_is_named_and_proved_by_runs_that_did_not_choose_it(store: Store, tmp_path: Path) -> None:
    put(store, tmp_path, "july", moved(json.loads(june()[1]), np.array([GROWN, 0.0, 0.0]), 1))
    found = compared(store, "july")
    assert found is not None
    (change,) = found.changes
    assert (change.motion, change.part, change.unit, change.halves) == ("EXX", "linear", "um/m", 2)
    assert abs(change.value - GROWN * 1e6) <= 2.0 * change.u < 6.0
    assert changed_text(found).startswith("changed since solution 1: scale of X +")
    assert "proved" not in changed_text(found)
    gap = found.gap
    assert gap is not None
    assert gap.after_um < gap.floor_um + 0.1 * (gap.before_um - gap.floor_um)
    assert any("on runs that were not used to find the change, the gap shrinks from" in line for line in changed_lines(found))


def test_without_a_change_what_could_hide_is_told(store: Store, tmp_path: Path) -> None:
    put(store, tmp_path, "july", moved(json.loads(june()[1]), np.zeros(3), 2))
    found = compared(store, "july")
    assert found is not None
    assert found.changes == ()
    assert changed_text(found) == "these runs show no change since solution 1"
    assert "scale of Z" in changed_lines(found)[1]


def test_a_table_that_was_put_in_force_is_no_change_of_the_machine(store: Store, tmp_path: Path) -> None:
    """X and Y are corrected after June; in July Z has grown, and the corrections are in the readings."""
    runs = moved(json.loads(june()[1]), np.array([-GROWN, 0.5 * GROWN, GROWN]), 3)
    image = encode(table_image(growing(june()[0], np.array([-GROWN, 0.5 * GROWN, 0.0])), 100, 7))
    put(store, tmp_path, "july", [run | {"table": {"crc": crc32(image), "acting": True}} for run in runs])
    assert compared(store, "july") is None, "a table that nobody knows cannot be taken out"
    store.tables.add(store.campaigns.find("july").machine_id, None, image, crc32(image), {})
    found = compared(store, "july")
    assert found is not None
    assert [c.motion for c in found.changes] == ["EZZ"]
    assert abs(found.changes[0].value - GROWN * 1e6) <= 2.0 * found.changes[0].u


@pytest.mark.parametrize(
    ("tables", "is_compared"),
    [
        ([{"crc": 12345}], False),  # of an older version, which did not say whether it acts
        ([{"crc": 12345, "acting": True}], False),
        ([{"crc": 12345, "acting": False}], True),
        ([{"crc": 12345, "acting": False}, {}], True),
        ([{"crc": 12345, "acting": True}, {"crc": 12345, "acting": False}], False),
        ([{"crc": 12345, "acting": True}, {}], False),
    ],
)
def test_a_table_that_nobody_knows_is_compared_only_where_it_did_nothing(
    store: Store, tmp_path: Path, tables: list[Doc], is_compared: bool
) -> None:
    runs = moved(json.loads(june()[1]), np.zeros(3), 4)
    put(store, tmp_path, "july", [run | {"table": tables[k % len(tables)]} for k, run in enumerate(runs)])
    assert (reference_solution(store, from_store(store, "july")) is not None) is is_compared


@pytest.mark.skipif(os.environ.get("ABBE_TEST_LONG") != "1", reason="one more whole comparison of tables: ABBE_TEST_LONG=1 makes it")
def test_a_table_that_was_switched_on_in_between_is_another_table(tmp_path: Path) -> None:
    _, text, doc = june()
    image = encode(table_image(growing(june()[0], np.array([GROWN, 0.0, 0.0])), 100, 7))
    crc = crc32(image)
    with Store.open(f"sqlite:///{tmp_path / 'other.sqlite3'}") as store:
        put(store, tmp_path, "june", [run | {"table": {"crc": crc, "acting": False}} for run in json.loads(text)])
        store_solution(store, from_store(store, "june"), doc)
        store.tables.add(store.campaigns.find("june").machine_id, None, image, crc, {})
        runs = moved(json.loads(text), np.array([GROWN, 0.0, 0.0]), 6)
        put(store, tmp_path, "july", [run | {"table": {"crc": crc, "acting": True}} for run in runs])
        found = compared(store, "july")
    assert found is not None
    assert found.changes == ()


def test_with_the_same_table_both_times_it_need_not_be_known(tmp_path: Path) -> None:
    _, text, doc = june()
    told = {"crc": 12345, "acting": True}
    with Store.open(f"sqlite:///{tmp_path / 'other.sqlite3'}") as store:
        put(store, tmp_path, "june", [run | {"table": told} for run in json.loads(text)])
        store_solution(store, from_store(store, "june"), doc | {"inputs": doc["inputs"] | {"tables": [told]}})
        put(store, tmp_path, "july", [run | {"table": told} for run in moved(json.loads(text), np.array([GROWN, 0.0, 0.0]), 1)])
        found = compared(store, "july")
    assert found is not None
    assert [c.motion for c in found.changes] == ["EXX"]


def entry(name: str, key: str, family: str, coefficient: float) -> EffectFound:
    """An effect as a finding has it."""
    size = {"strength": 8.0, "u_strength": 0.1, "unit": "um", "coefficients": (coefficient,)}
    head = {"label": f"{name}:{key}", "name": name, "key": key, "title": name, "kind": "mean", "remedy": "control parameter"}
    return EffectFound(**head, family=family, **size)


def test_what_was_taken_out_of_the_readings_then_is_taken_out_now(store: Store, tmp_path: Path) -> None:
    """Lost motion of X by the model book of June: in July it is taken out by that same version, whatever the book says today."""
    machine, text, doc = june()
    source = FindingSource(campaign="june", machine_digest=doc["inputs"]["machine"])
    book = extended_book(None, Finding(verdict="named", effects=(entry("backlash", "X", "drive", 4.0),)), source, 1)
    store.models.add(NewVersion(machine["name"], None, document(book)))
    store_solution(
        store, from_store(store, "june"), doc | {"machine_model": {"version": 1, "taken_out": ["backlash:X"], "not_for_tables": []}}
    )
    put(store, tmp_path, "july", moved(json.loads(text), np.array([GROWN, 0.0, 0.0]), 1))
    found = compared(store, "july")
    assert found is not None
    assert found.since == 2
    assert [c.motion for c in found.changes] == ["EXX"]
    store.models.add(NewVersion(machine["name"], 1, document(replace(book, effects=()))))
    again = compared(store, "july")
    assert again is not None
    assert again == found


def test_a_lasting_effect_that_was_found_beside_leaves_a_change_unproved(store: Store, tmp_path: Path) -> None:
    put(store, tmp_path, "july", moved(json.loads(june()[1]), np.array([GROWN, 0.0, 0.0]), 1))
    own = compared(store, "july", [entry("backlash", "X", "drive", 0.0)])
    assert own is not None
    assert (own.beside, "not proved" in changed_text(own)) == ((), False)
    other = compared(store, "july", [entry("lateral_play", "EYX", "structure", 0.0)])
    assert other is not None
    assert changed_text(other).endswith("(not proved)")
    assert "lateral_play EYX was found in the same runs" in changed_lines(other)[1]


def test_what_heat_did_in_these_runs_is_taken_out_first(store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    put(store, tmp_path, "july", moved(json.loads(june()[1]), np.zeros(3), 2))
    taken: list[str] = []
    monkeypatch.setattr(
        "abbe.service.discovery.changed_since.subtract_effects", lambda c, entries, origin: taken.extend(e.label for e in entries) or c
    )
    compared(store, "july", [entry("spindle_growth", "Z", "thermal", 1.0), entry("backlash", "X", "drive", 1.0)])
    assert taken == ["spindle_growth:Z"]


def test_the_first_campaign_is_compared_with_nothing_and_none_with_a_later_one(store: Store, tmp_path: Path) -> None:
    assert compared(store, "june") is None
    assert changed_lines(None) == []
    assert changed_text(None) == ""


def test_a_discovery_keeps_what_has_changed_and_asks_once(store: Store, tmp_path: Path) -> None:
    put(store, tmp_path, "july", moved(json.loads(june()[1]), np.array([GROWN, 0.0, 0.0]), 1))
    campaign = from_store(store, "july")
    job = prepare(campaign, catalogue(), None, since=reference_solution(store, campaign))
    assert job.digest == prepare(campaign, catalogue(), None).digest, "a solution that comes later makes no other search of it"
    journal = DiscoveryJournal()
    search = Search("none")
    finding = discover(job, journal, search, lambda _: None)
    assert finding.changed is not None
    assert finding.changed.since == 1
    assert record(ChangedSince, json.loads(json.dumps(document(finding.changed))), "a change") == finding.changed
    assert discover(job, journal, search, lambda _: None) is finding


def test_what_cannot_be_compared_is_a_line_and_costs_no_finding(store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    put(store, tmp_path, "july", moved(json.loads(june()[1]), np.zeros(3), 2))
    monkeypatch.setattr("abbe.service.discovery.changed_since.changed_since", lambda *_: np.linalg.cholesky(-np.eye(2)))
    found = compared(store, "july")
    assert found is not None
    assert changed_lines(found) == [changed_text(found)]
    assert changed_text(found).startswith("the changes since solution 1 could not be determined: ")


GAP = {"before_um": 10.0, "after_um": 1.0, "floor_um": 1.0}


@pytest.mark.parametrize(
    ("told", "change", "proof", "says"),
    [
        ({}, {}, True, "100% closed"),
        ({}, {"halves": 1}, False, "not chosen by each half of the runs alone: scale of X"),
        ({"gap": GAP | {"after_um": 8.0}}, {}, False, "more than noise is left"),
        ({"gap": GAP | {"before_um": 1.02}}, {}, True, "the fitted set-ups absorb nearly all of the change"),
        (
            {"gap": GAP | {"before_um": 1.02}, "judged": -1.0},
            {},
            False,
            "the change does not explain the runs that were kept out of the search for it",
        ),
        ({"gap": None, "judged": None}, {"halves": 0}, False, "too few set-ups"),
        ({}, {"rivals": [{"name": "C0Y", "less_evidence": 1.0}]}, False, "cannot tell it from squareness of X and Y"),
        ({}, {"u": 7.0}, False, "zero is within its uncertainty"),
        ({"hidden_um_m": {"EYY": 3.2}}, {}, True, "at most (k = 2): scale of Y 3.2 µm/m"),
        ({}, {}, True, "not seen by these runs: scale of Y, scale of Z"),
        ({"gap": GAP | {"after_um": 12.0}}, {}, False, "the gap goes from 10.0 to 12.0 µm rms (noise alone: 1.00 µm)"),
    ],
)
def test_a_change_that_is_not_proved_says_so(told: Doc, change: Doc, proof: bool, says: str) -> None:
    one = {"motion": "EXX", "part": "linear", "value": 12.0, "u": 1.0, "unit": "um/m", "rivals": [], "halves": 2} | change
    found = record(ChangedSince, {"since": 4, "changes": [one], "gap": GAP, "judged": 50.0, "hidden_um_m": {}} | told, "a change")
    found = replace(found, proved=proved(found))
    assert changed_text(found).endswith("(not proved)") is not proof
    assert any(says in line for line in changed_lines(found)), changed_lines(found)
