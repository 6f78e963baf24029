"""The discovery workflow: which states follow, what is stored, and that a killed one goes on where it was."""

from __future__ import annotations

import importlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from abbe.models.discovery.answer import Agreement, BlindSpot, Discovery, Gap, NextTest, Unjudged
from abbe.service.campaign_data.campaign_folder import from_folder
from abbe.service.discovery.discover import DiscoveryJob, DiscoveryJournal, discover, prepare
from abbe.service.discovery.discovery_answer import answer_doc
from abbe.service.discovery.discovery_states import entering, judge, not_entered
from abbe.service.discovery.discovery_store import StoredJournal, journal_of, stored_steps
from abbe.service.discovery.discovery_text import lines_of, next_of, rival_lines, verdict_of
from abbe.service.discovery.simulate import simulate, simulated_finding
from abbe.service.domain.discovery import DiscoveryStep
from abbe.service.domain.discovery_file import DiscoveryFile
from abbe.service.domain.document import document, record
from abbe.service.domain.finding import EffectFound, Finding, GapUm, Unnamed
from abbe.service.domain.progress import ignore_progress
from abbe.service.effects.effect_catalogue import catalogue
from abbe.service.effects.model_book import current
from abbe.service.errors import CampaignRefused, NotObservable, StoreError, Unusable
from abbe.service.rendering.document_data import shown
from abbe.service.report.report_discovery import found_report, gap_table
from abbe.service.storage.store import Store
from tests.artefact_campaign import campaign as artefact_campaign
from tests.service.discovery.discovery_bench import Search, write_case

ALL = ["FITTED", "SUSPICIOUS", "PROPOSED", "TESTING", "EXPLAINED"]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_case(tmp_path / "c1")


@pytest.fixture
def book(tmp_path: Path) -> Iterator[Store]:
    with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as opened:
        yield opened


def job_of(folder: Path, store: Store | None = None) -> DiscoveryJob:
    campaign = from_folder(folder)
    return prepare(campaign, catalogue(), None if store is None else current(store, campaign.site.name))


@pytest.mark.parametrize(
    ("search", "states"),
    [
        (Search("named"), ALL),
        (Search("none"), ["FITTED", "EXPLAINED"]),
        (Search("unknown"), ["FITTED", "SUSPICIOUS", "UNEXPLAINED"]),
        (Search("named", holds=False), [*ALL[:4], "UNEXPLAINED"]),
    ],
)
def test_states_follow_from_the_finding(folder: Path, book: Store, search: Search, states: list[str]) -> None:
    job = job_of(folder)
    journal = journal_of(book, job)
    discover(job, journal, search, ignore_progress)
    assert [step.state for step in journal.steps] == states
    stored = stored_steps(book, journal.id or 0)
    assert [s.state for s in stored] == [s.state for s in book.discoveries.steps(journal.id or 0)] == states
    assert all(s.decided_by == "abbe discover" and s.why for s in stored)
    assert stored[0].start is not None
    source = stored[0].start.source
    assert source.runs.keys() == {"r01", "r02", "r03", "r04"}
    assert source.versions["abbe"]
    model = current(book, "VMC-1")
    if states == ALL:
        assert model is not None
        assert (model.version, model.discovery_id, journal.version) == (1, journal.id, 1)
        assert [e.label for e in model.book.effects] == ["backlash:X"]
        assert model.book.provenance is not None
        assert model.book.provenance.runs == source.runs
    else:
        assert model is None


def test_a_wrong_name_that_only_fits_is_not_proved(folder: Path) -> None:
    job = job_of(folder)
    good = judge(discover(job, DiscoveryJournal(), Search(), ignore_progress))
    bad = judge(discover(job, DiscoveryJournal(), Search(holds=False), ignore_progress))
    assert (good.proved, bad.proved) == (True, False)
    assert good.closed is not None
    assert good.closed > 0.9
    assert bad.closed == pytest.approx(0.0, abs=1e-9)


def one_effect(kind: Any = "mean") -> EffectFound:
    size = {"strength": 8.0, "u_strength": 0.1, "unit": "um"}
    return EffectFound(label="a:X", name="a", key="X", title="an effect", family="drive", kind=kind, remedy="table", **size)


def gap_um(before: float, after: float, floor: float) -> GapUm:
    return GapUm(before_um=before, after_um=after, floor_um=floor)


def judged(role: str, gap: GapUm, *effects: EffectFound) -> Any:
    return judge(Finding(verdict="named", gaps={role: gap}, effects=effects))


def test_runs_judge_only_where_the_gap_shows_in_them() -> None:
    assert judge(Finding(verdict="none")).proved is None
    assert judged("holdout", gap_um(0.31, 0.3, 0.3)).proved is None
    assert judged("holdout", gap_um(0.9, 0.9, 0.3), one_effect("variance")).proved is None  # noise that is named stays noise
    assert judged("holdout", gap_um(0.9, 0.9, 0.3), one_effect()).proved is False
    assert judged("holdout", gap_um(0.43, 0.415, 0.39), one_effect()).proved is None  # the prediction errs by as much as what is left
    assert judged("holdout", gap_um(0.43, 0.43, 0.39), one_effect()).proved is False
    unfelt = judged("holdout", gap_um(0.43, 0.43, 0.39), replace(one_effect(), needed=1.003))
    assert (unfelt.proved, unfelt.rule) == (None, "the effect hardly changes the readings of the holdout runs")
    assert judged("holdout", gap_um(0.43, 0.43, 0.39), replace(one_effect(), needed=0.97)).proved is False
    assert judged("holdout", gap_um(0.9, 0.9, 0.3), replace(one_effect(), needed=1.003)).proved is False  # what is left has another cause
    run_away = judged("identify", gap_um(2.0, 90.0, 1.0), one_effect())
    assert (run_away.proved, run_away.rule) == (False, "the identify runs agree worse with the effect than without it")
    assert gap_um(0.29, 0.29, 0.3).closed is None


def test_a_name_that_is_taken_back_is_a_suspect_in_text_answer_and_page(folder: Path) -> None:
    """What the text takes back no script may read as a name."""
    job = job_of(folder)
    bad = discover(job, DiscoveryJournal(), Search(holds=False), ignore_progress)
    answer = DiscoveryFile.model_validate_json(json.dumps(answer_doc(bad)))
    for told in (bad, answer):
        assert (told.verdict, list(told.effects), told.proved) == ("unknown", [], False)
        assert [e.name for e in told.suspects] == ["backlash"]
        assert [e.proved for e in told.suspects] == [False]
    assert "Something is missing that the catalogue does not explain" in verdict_of(bad)[1]
    assert "Suspected: backlash" in verdict_of(bad)[2]
    assert not any("enter the width" in line for line in lines_of(bad))  # no remedy for what is not confirmed
    page = shown(found_report(job, DiscoveryJournal(), bad, "now"))
    assert not any("What to do" in str(section) for section in page["sections"])
    rejected = next(t for t in page["tables"] if t["title"].startswith("What was tried and why not"))
    assert rejected["rows"][0][0] == "backlash:X"


def test_a_name_of_little_evidence_that_the_judges_refute_leaves_nothing_missing(folder: Path) -> None:
    """If the present model explains all runs without it; otherwise it stays a suspect."""

    def search(*given: Any) -> Discovery:
        return replace(Search(holds=False)(*given), alone=Search("none")(*given))

    found = discover(job_of(folder), DiscoveryJournal(), search, ignore_progress)
    assert (found.verdict, found.effects, found.suspects) == ("none", (), ())
    assert found.rejected[0][0] == "backlash:X"
    assert found.gaps["holdout"].after_um == found.gaps["holdout"].before_um


def test_the_answer_says_what_is_proved_and_by_which_rule(folder: Path) -> None:
    answer = answer_doc(discover(job_of(folder), DiscoveryJournal(), Search(), ignore_progress))
    assert (answer["verdict"], answer["proved"]) == ("named", True)
    assert answer["proof"] == "at least 50% of the gap closes on the holdout runs"
    assert [e["proved"] for e in answer["effects"]] == [True]
    assert answer_doc(discover(job_of(folder), DiscoveryJournal(), Search("none"), ignore_progress))["proved"] is False


def variant(finding: Finding, **changes: Any) -> Finding:
    """A finding with a second effect that is noise, beside its first one."""
    names = finding.effects or finding.suspects
    names = (*names, replace(names[0], kind="variance", label="stick_slip:X", **changes))
    return replace(finding, effects=names) if finding.effects else replace(finding, suspects=names)


def test_noise_that_is_named_does_not_excuse_a_name_beside_it(folder: Path) -> None:
    wrong = discover(job_of(folder), DiscoveryJournal(), Search(holds=False), ignore_progress)
    assert judge(wrong).proved is judge(variant(wrong)).proved is False
    right = variant(discover(job_of(folder), DiscoveryJournal(), Search(), ignore_progress))
    assert judge(right).proved is True
    assert [e.label for e in entering(right)] == ["backlash:X"]


def test_each_effect_has_to_be_needed_and_nothing_nameless_may_share_in_what_closes(folder: Path) -> None:
    found = discover(job_of(folder), DiscoveryJournal(), Search(), ignore_progress)
    assert not_entered(found, judge(found)) is None
    second = replace(found.effects[0], label="cyclic_error:Y", alternatives=())
    for needed, why in ((1.3, None), (1.0, "the holdout runs do not need cyclic_error:Y"), (None, None)):
        both = replace(found, effects=(*found.effects, replace(second, needed=needed)))
        assert not_entered(both, judge(both)) == why
    nameless = replace(found, beside=(Unnamed(label="unnamed_step:Z", evidence=144.0),))
    assert (
        not_entered(nameless, judge(nameless))
        == "part of the gap is closed by a structure that the catalogue does not name (unnamed step:Z)"
    )
    sign, word, text = verdict_of(nameless)
    assert (sign, word) == ("open", "Found, but a part has no name")
    assert "(unnamed step:Z): what is named here may be a part of the same effect." in text
    assert verdict_of(found)[1] == "Found"


def test_scatter_is_told_without_a_gap_that_it_cannot_close(folder: Path) -> None:
    finding = discover(job_of(folder), DiscoveryJournal(), Search(), ignore_progress)
    scatter = variant(finding, alternatives=()).effects[1:]
    alone = replace(finding, effects=scatter, next_test=None, confounded_with=())
    told = "\n".join(lines_of(alone))
    assert "closed" not in verdict_of(alone)[2]
    assert "no model can remove scatter" in told
    assert "what else it could be: no rival was tried" in told
    assert {row[4] for row in gap_table(alone).rows} == {"n/a"}
    assert "fits these runs as well" in rival_lines(replace(finding.effects[0], alternatives=()))[0]
    closed = {row[0]: row[4] for row in gap_table(finding).rows}
    assert closed["identify"] == "n/a"  # fitted runs flatter
    assert closed["holdout"].endswith(" %")


def gapped(search: Search, **gaps: Gap) -> Any:
    """A search whose runs miss the noise by so much."""
    return lambda *words: replace(search(*words), gaps=gaps)


def changed(search: Search, **changes: Any) -> Any:
    """A search that finds something else besides."""
    return lambda *words: replace(search(*words), **changes)


@pytest.mark.parametrize(
    ("agreement", "unjudged", "sign", "words"),
    [
        (
            (Agreement("r03", 1.82, 3e-7),),
            (),
            "open",
            "the fitted runs to their noise; runs that were never fitted deviate by more than noise and the uncertainty of the prediction "
            "allow: r03 1.8 times the allowed rms (by chance",
        ),
        ((Agreement("r03", 1.12, 0.03),), (), "ok", "explains all runs to their noise"),
        ((), (Unjudged("r03", "nobody knows"),), "ok", "explains the fitted runs to their noise; not judged, for nobody knows: r03"),
        (
            (Agreement("r03", 1.82, 3e-7),),
            tuple(Unjudged(label, why) for label, why in (("a", "one"), ("b", "two"), *((f"c{k}", "one") for k in range(5)))),
            "open",
            "of such campaigns); not judged, for one: a, c0, c1, c2 and 2 more; not judged, for two: b",
        ),
        ((), (), "ok", "explains all runs to their noise"),  # the repeats of one axis judge themselves
    ],
)
def test_runs_that_were_never_fitted_are_asked_before_nothing_is_said_to_be_missing(
    folder: Path, agreement: tuple[Agreement, ...], unjudged: tuple[Unjudged, ...], sign: str, words: str
) -> None:
    journal = DiscoveryJournal()
    finding = discover(job_of(folder), journal, changed(Search("none"), agreement=agreement, unjudged=unjudged), ignore_progress)
    told = verdict_of(finding)
    assert told[0] == sign
    assert words in told[2]
    assert words in journal.steps[-1].why
    assert ("measure next: repeat the runs" in "\n".join(next_of(finding))) is (sign == "open")
    assert [a["run"] for a in answer_doc(finding).get("agreement", [])] == [a.run for a in agreement]


def test_what_could_not_be_seen_is_told_where_nothing_is_missing(folder: Path) -> None:
    slow = BlindSpot("what grows with the feed looks like geometry", "all ball-bar runs have one feed", "second_feed")
    finding = discover(job_of(folder), DiscoveryJournal(), changed(Search("none"), unseen=(slow,)), ignore_progress)
    (line,) = next_of(finding)
    assert line.startswith("could not be seen: what grows with the feed looks like geometry, because all ball-bar runs have one feed")
    assert line.endswith("what would show it: the same path at a second feed")
    assert line in lines_of(finding)
    assert answer_doc(finding)["unseen"] == [{"what": slow.what, "because": slow.because, "adds": "second_feed"}]


def test_what_has_no_name_gets_a_proposal_like_a_name(folder: Path) -> None:
    test = NextTest(("longer_session",), ("something of the machine", "something of that session"), None, 150.0, "run r02 again, later")
    finding = discover(job_of(folder), DiscoveryJournal(), changed(Search("unknown"), next_test=test), ignore_progress)
    first, why = next_of(finding)
    assert first == (
        "measure next: a repeat late in the session to tell something of the machine from something of that session (about 150 min)"
    )
    assert why == "  run r02 again, later"
    assert answer_doc(finding)["next_test"]["adds"] == ["longer_session"]


def test_kin_that_explains_nearly_all_but_costs_more_is_listed_with_its_odds(folder: Path) -> None:
    """It lies 25 behind by its price: no headline, but no reader may miss it."""
    finding = discover(job_of(folder), DiscoveryJournal(), Search(ahead=25.0), ignore_progress)
    assert finding.confounded_with == ()
    (line,) = rival_lines(finding.effects[0])
    assert line.endswith("(10^11 times less likely, but a slightly different form of it would look the same)")
    assert any(line in told for told in lines_of(finding))
    card = shown(found_report(job_of(folder), DiscoveryJournal(), finding, "now"))["sections"][0]["blocks"][0]
    assert {"name": "What else it could be", "value": line} in card["items"]
    near = discover(job_of(folder), DiscoveryJournal(), Search(ahead=4.2), ignore_progress)
    assert rival_lines(near.effects[0])[0].endswith("(67 times less likely)")


def test_runs_whose_readings_are_all_flagged_judge_nothing(folder: Path) -> None:
    gaps = {"identify": Gap(3e-3, 3e-4, 3e-4), "holdout": Gap(float("nan"), float("nan"), 3e-4)}
    finding = discover(job_of(folder), DiscoveryJournal(), gapped(Search(), **gaps), ignore_progress)
    assert list(finding.gaps) == ["identify"]
    assert judge(finding).rule == "no holdout run of this campaign can judge"
    for run in folder.glob("r03.json"):
        doc = json.loads(run.read_text())
        doc["columns"]["valid"] = [0] * len(doc["columns"]["t_s"])
        run.write_text(json.dumps(doc))
    job = job_of(folder)
    assert list(simulated_finding(job, simulate(job)).gaps) == ["identify"]


def test_an_instrument_that_no_fitted_run_has_is_judged_by_the_noise_of_the_others(folder: Path) -> None:
    job = job_of(folder)
    found = simulated_finding(job, replace(simulate(job), noise_mm={"laser": 1e-3, "probe": 2e-3}))
    assert {g.floor_um for g in found.gaps.values()} == {r.floor_um for r in found.runs.values()} == {2.0}


@pytest.mark.parametrize(
    ("roles", "ahead", "why"),
    [
        (("identify", "identify", "sealed"), 4.2, "it is not proved: no holdout run of this campaign can judge"),
        (("identify", "identify", "holdout"), 2.9, "these runs hardly separate backlash:X from lateral_play:EYX"),
        (("identify", "identify", "holdout"), 3.1, None),
    ],
    ids=["nobody judges", "a rival is nearly as likely", "proved and alone"],
)
def test_only_what_was_proved_and_has_no_rival_enters_the_book(
    tmp_path: Path, book: Store, roles: tuple[str, ...], ahead: float, why: str | None
) -> None:
    job = job_of(write_case(tmp_path / "c", roles=roles))
    journal = journal_of(book, job)
    finding = discover(job, journal, Search(ahead=ahead), ignore_progress)
    step = journal.steps[-1]
    assert (step.state, step.not_added) == ("EXPLAINED", why)
    assert len(book.models.all("VMC-1")) == (1 if why is None else 0)
    told = [line for line in lines_of(finding) if line.startswith("not added to the model book: ")]
    assert told == ([] if why is None else [f"not added to the model book: {why}"])
    assert (why is None) or step.why.endswith(told[0])


def test_the_same_search_is_found_again_and_not_done_twice(folder: Path, book: Store) -> None:
    search = Search()
    job = job_of(folder, book)
    first = discover(job, journal_of(book, job), search, ignore_progress)
    again = job_of(folder, book)
    assert again.base is not None
    assert again.known == ("backlash:X",)
    journal = journal_of(book, again)
    assert journal.ended
    assert discover(again, journal, search, ignore_progress) == first
    assert search.calls == 1
    assert len(book.discoveries.all()) == len(book.models.all()) == 1


def edited(folder: Path, name: str, change: Callable[[dict[str, Any]], Any]) -> DiscoveryJob:
    """The campaign with one of its files changed."""
    doc = json.loads((folder / name).read_text())
    change(doc)
    (folder / name).write_text(json.dumps(doc))
    return job_of(folder)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("campaign.json", lambda d: d["instruments"]["ballbar"].update(resolution_mm=1e-3)),
        ("campaign.json", lambda d: d["machine"].update(vertical_axis="Y")),
        ("campaign.json", lambda d: d["current_model"].update(includes=["rigid6"])),
        ("r01.json", lambda d: d["columns"].update(feed_mm_min=[500.0] * 120)),
        ("r01.json", lambda d: d["columns"].update(direction=[-v for v in d["columns"]["direction"]])),
        ("r01.json", lambda d: d["columns"].update(temp_air_C=[21.0] * 120)),
        ("r01.json", lambda d: d["columns"].update(pressure_air_Pa=[1e5] * 120)),
    ],
    ids=["instrument", "vertical axis", "present model", "feed", "direction", "temperature", "pressure"],
)
def test_another_question_is_another_search(folder: Path, name: str, change: Callable[[dict[str, Any]], Any]) -> None:
    before = job_of(folder).digest
    assert edited(folder, name, lambda d: None).digest == before
    assert edited(folder, name, change).digest != before


def test_an_empty_list_says_that_the_simulation_knows_nothing(folder: Path) -> None:
    assert edited(folder, "campaign.json", lambda d: d["current_model"].update(includes=[])).case.includes == frozenset()


def test_another_code_under_the_same_name_is_another_search(folder: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "a_plug_in.py").write_text("def signal(paths, key, values): return []")
    monkeypatch.syspath_prepend(str(tmp_path))
    plug_in = importlib.import_module("a_plug_in")
    job = job_of(folder)
    job = replace(job, effects=(replace(job.effects[0], signal=plug_in.signal), *job.effects[1:]))
    before = job.digest
    (tmp_path / "a_plug_in.py").write_text("def signal(paths, key, values): return [0]")
    assert job.digest != before
    assert len({before, job.digest, job_of(folder).digest}) == 3


def test_states_keep_their_order(folder: Path, book: Store) -> None:
    with pytest.raises(ValueError, match="TESTING cannot follow None"):
        DiscoveryJournal().write(DiscoveryStep(state="TESTING", why="a test"))
    job = job_of(folder)
    one, other = journal_of(book, job), journal_of(book, job)
    assert one.id == other.id
    one.write(DiscoveryStep(state="FITTED", why="first", decided_by="a test"))
    with pytest.raises(StoreError, match="another process works on it"):
        other.write(DiscoveryStep(state="FITTED", why="second", decided_by="a test"))


KILLED = """
import os, signal, sys
from pathlib import Path
from abbe.service.domain.progress import ignore_progress
from abbe.service.storage.repositories.results import Discoveries
from abbe.service.storage.store import Store
from abbe.service.discovery.discover import discover
from abbe.service.discovery.discovery_store import journal_of
from tests.service.discovery.discovery_bench import Search
from tests.service.discovery.test_discovery_workflow import job_of

class Doomed(Discoveries):
    def add_step(self, discovery_id, seq, *rest):
        if seq == int(sys.argv[3]):
            os.kill(os.getpid(), signal.SIGKILL)
        return super().add_step(discovery_id, seq, *rest)

store = Store.open(sys.argv[2])
store.discoveries = Doomed(store)
job = job_of(Path(sys.argv[1]))
discover(job, journal_of(store, job), Search(), ignore_progress)
"""


@pytest.mark.parametrize(("step", "searches"), [(1, 1), (4, 0)])
def test_killed_anywhere_it_goes_on_there(folder: Path, tmp_path: Path, step: int, searches: int) -> None:
    url = f"sqlite:///{tmp_path / 'abbe.sqlite3'}"
    words = [sys.executable, "-c", KILLED, str(folder), url, str(step)]
    done = subprocess.run(words, capture_output=True, text=True, env=os.environ | {"PYTHONPATH": os.getcwd()}, check=False)
    assert done.returncode == -signal.SIGKILL, done.stderr
    search = Search()
    with Store.open(url) as store:
        number = store.discoveries.all()[0].id
        assert [s.state for s in store.discoveries.steps(number)] == ALL[:step]
        assert store.models.all() == []
        job = job_of(folder, store)
        journal = journal_of(store, job)
        assert journal.id == number
        finding = discover(job, journal, search, ignore_progress)
        assert search.calls == searches
        assert [s.state for s in store.discoveries.steps(number)] == ALL
        assert journal.version == 1
        assert finding.effects[0].label == "backlash:X"
        assert StoredJournal(store, number, "VMC-1").finding == finding


def test_what_is_no_campaign_is_refused(tmp_path: Path) -> None:
    with pytest.raises(NotObservable, match="no run of this campaign has the role identify"):
        job_of(write_case(tmp_path / "sealed", roles=("holdout", "sealed")))
    folder = write_case(tmp_path / "twice")
    run = json.loads((folder / "r01.json").read_text())
    (folder / "r02.json").write_text(json.dumps(run | {"run_id": "r02"}))
    with pytest.raises(CampaignRefused, match="r02"):
        job_of(folder)


@pytest.mark.parametrize("search", [Search(), Search("none"), Search("unknown"), Search(holds=False)])
def test_a_finding_comes_back_from_json_as_it_was(folder: Path, search: Search) -> None:
    finding = discover(job_of(folder), DiscoveryJournal(), search, ignore_progress)
    text = json.dumps(document(finding), allow_nan=False)
    assert record(Finding, json.loads(text), "a finding") == finding


def test_points_of_artefacts_are_not_searched(tmp_path: Path) -> None:
    with pytest.raises(NotObservable, match=r"only points of artefacts.*`abbe discover plate` separates errors of the part"):
        job_of(artefact_campaign(tmp_path))


def test_a_stored_document_of_another_form_is_refused_with_its_place() -> None:
    with pytest.raises(Unusable, match=r"a finding does not have the expected content: gaps\.holdout\.after_um"):
        record(Finding, {"verdict": "none", "gaps": {"holdout": {"before_um": 1.0, "floor_um": 1.0}}}, "a finding")
