"""Proposals on a simulated machine, on one identification: everything that refuses one writes no register; then one goes all the way."""

from __future__ import annotations

import asyncio
import json
import sqlite3
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from abbe.service.audit.book import login
from abbe.service.cli import run
from abbe.service.clock import SystemClock
from abbe.service.compensation.approved import ApprovedProposal, PushOrder, next_approved
from abbe.service.compensation.correct import Correction, push
from abbe.service.compensation.gate import PushContext, admit, precheck
from abbe.service.compensation.proposal_decisions import approve, proposal_status, status_of_proposal
from abbe.service.compensation.proposal_doc import digest_of_doc, load
from abbe.service.compensation.proposals import load_runs
from abbe.service.compensation.push_approved import push_approved
from abbe.service.config import load_machine
from abbe.service.devices.session import DeviceUrls, open_session
from abbe.service.domain.progress import ignore_progress
from abbe.service.domain.results import ProposalApproval
from abbe.service.domain.service_records import AlarmFacts, AlarmKind
from abbe.service.errors import StoreError, TableRefused
from abbe.service.sequences.control import Control, Watching
from abbe.service.site import Site, site_of
from abbe.service.storage.store import Store
from abbe.service.tables.push_journal import JournalView
from tests.scenarios.conftest import Sims, simulated
from tests.scenarios.identified import MACHINE, copy_identified
from tests.scenarios.world import position_and_counters, registers

pytestmark = [pytest.mark.scenario, pytest.mark.timeout(240), pytest.mark.usefixtures("solved_once")]
TWO = "[material]\ntemperature_c = 21.5\n[limits]\ntwo_people = true\n"


def controller_words(sims: Sims) -> tuple[int, ...]:
    """Boot id and generation; active bank, CRC and state of both banks, lease: read by hand."""
    return registers(sims, 5, 4) + registers(sims, 208, 11)


@dataclass
class Shop:
    """A machine with an identification, a verification, and proposal 1."""

    sims: Sims
    site: Site
    url: str
    untouched: tuple[int, ...]
    proposed: int

    @property
    def file(self) -> str:
        return str(self.sims.machine_file)

    def words(self) -> tuple[int, ...]:
        return controller_words(self.sims)

    def copy(self, store: Store) -> int:
        """The same proposal once more, without any approval."""
        one = store.proposals.get(1)
        return store.proposals.add(one.machine, one.solution_id, one.doc, one.digest)


@pytest.fixture(scope="module")
def shop(tmp_path_factory: pytest.TempPathFactory) -> Any:
    folder = tmp_path_factory.mktemp("proposals")
    copy_identified(tmp_path_factory, folder)
    with simulated(folder, *MACHINE, "--speed", "160", extra=TWO) as sims:
        loaded = load_machine(sims.machine_file)
        site = site_of(loaded.machine)
        before = controller_words(sims)
        code = run(["comp", "propose", "-m", str(sims.machine_file), "june"])
        yield Shop(sims, site, loaded.database_url, before, code)


@dataclass
class Later(SystemClock):
    """A clock that is some hours ahead of the computer's."""

    hours: float = 0.0

    def utc(self) -> datetime:
        return super().utc() + timedelta(hours=self.hours)


def try_push(shop: Shop, store: Store, number: int, *, site: Site | None = None, hours: float = 0.0) -> Correction:
    async def work() -> Correction:
        async with open_session((site or shop.site).urls) as session:
            ids = [r.id for r in store.runs.all("start")]
            runs = await load_runs(store, ids)
            context = PushContext(session, store, site or shop.site, clock=Later(hours))
            return await push(context, await admit(context, number), runs)

    return asyncio.run(work())


def test_proposing_writes_nothing_to_the_controller(shop):
    assert shop.proposed == 0
    assert shop.words() == shop.untouched


def test_a_proposal_says_at_which_temperature_it_holds(shop, capsys):
    assert run(["comp", "show", "1", "-m", shop.file]) == 0
    stated = ", ".join(f"{axis} 21.50 ± 0.40 °C (stated in the machine file)" for axis in "XYZ")
    assert f"holds at: {stated}" in capsys.readouterr().out
    with Store.open(shop.url) as store:
        assert store.solutions.get(store.proposals.get(1).solution_id).doc["holds_at"] == stated


CHANGED: dict[str, tuple[Callable[[Site], Site], float, str]] = {
    "another machine": (lambda s: replace(s, name="other", doc=s.doc | {"name": "other"}), 0.0, "MACHINE: the table is for 'sim'"),
    "another tool": (lambda s: replace(s, doc=s.doc | {"tool_mm": [0.0, 0.0, -90.0]}), 0.0, "MACHINE: the machine file has changed"),
    "another temperature window": (lambda s: replace(s, limits=replace(s.limits, temperature_c=(30.0, 32.0))), 0.0, "TEMPERATURE"),
    "a wider temperature window": (
        lambda s: replace(s, limits=replace(s.limits, temperature_c=(10.0, 40.0))),
        0.0,
        "LIMITS: .*temperature_c 18 to 24 then, 10 to 40 now",
    ),
    "another limit": (lambda s: replace(s, limits=replace(s.limits, value_mm=0.2)), 0.0, "LIMITS: .*value_mm 0.1 then, 0.2 now"),
    "an old measurement": (lambda s: s, 73.0, "STALE: measured 73"),
    "too few runs for these limits": (lambda s: replace(s, limits=replace(s.limits, runs=99)), 0.0, "RUNS"),
    "no approval": (lambda s: s, 0.0, "APPROVAL: not approved yet"),
}


@pytest.mark.parametrize("what", CHANGED)
def test_what_is_not_as_it_was_refuses_the_push_and_writes_nothing(shop, what):
    change, hours, reason = CHANGED[what]
    with Store.open(shop.url) as store:
        number = shop.copy(store)
        if what != "no approval":
            approve(store, number, "anna", 24.0, SystemClock())
        with pytest.raises(TableRefused, match=reason):
            try_push(shop, store, number, site=change(shop.site), hours=hours)
        assert store.pushes.entries("sim") == []
    assert shop.words() == shop.untouched


def test_where_nobody_is_there_more_is_asked_for(shop):
    """By the service: a control that was proved for it, an approval in any case, and no table that walks away."""

    async def unattended(site: Site, number: int) -> list[str]:
        async with open_session(site.urls) as session:
            return (await precheck(session.controller, store, site, number, load(store, number), SystemClock(), attended=False)).reasons()

    with Store.open(shop.url) as store:
        number = shop.copy(store)
        alone = replace(shop.site, limits=replace(shop.site.limits, walk_mm=0.001))
        against = asyncio.run(unattended(alone, number))
        assert any(reason.startswith("APPROVAL: not approved yet") for reason in against)
        assert any(reason.startswith("POLICY WALK: ") for reason in against)
        before = next_approved(store, "sim", [], SystemClock().utc().timestamp())
        assert before is None or before.proposal != number  # of this file's other tests
        row = approve(store, number, "anna", 24.0, SystemClock())
        found = next_approved(store, "sim", [], SystemClock().utc().timestamp())
        assert found == ApprovedProposal(number, row.id, 0)
        begun: list[int] = []

        async def tell_begun() -> None:
            begun.append(number)

        order = PushOrder(number, tell_begun, ignore_progress, Control())
        ended = asyncio.run(push_approved(shop.site, store, order, clock=SystemClock()))
        assert begun == [number]
        assert (ended.word, "a person who approves has to be at the machine" in ended.text) == ("refused", True)
        tried = store.alarms.append("sim", 0, 0, AlarmKind.PUSHING, AlarmFacts(proposal=number, approval=row.id))
        assert next_approved(store, "sim", [tried], SystemClock().utc().timestamp()) is None
        assert store.pushes.entries("sim") == []
    assert shop.words() == shop.untouched


def test_an_approval_ends_and_binds_who_and_what(shop):
    with Store.open(shop.url) as store:
        number = shop.copy(store)
        approve(store, number, "anna", 0.5, SystemClock())
        with pytest.raises(TableRefused, match="APPROVAL: the approval of anna expired"):
            try_push(shop, store, number, hours=1.0)

        own, good = shop.copy(store), store.proposals.approvals(number)[0]
        store.proposals.approve(replace(good, proposal_id=own, name=f" {login().upper()} "))  # past the check of the command
        with pytest.raises(TableRefused, match=r"APPROVAL: .* proposed it and cannot approve it"):
            try_push(shop, store, own)

        other = shop.copy(store)
        store.proposals.approve(
            ProposalApproval(proposal_id=other, name="anna", login="anna", digest=good.digest, expiry="2099-01-01T00:00:00.000000Z")
        )  # prolonged by hand
        with pytest.raises(TableRefused, match="APPROVAL: anna approved another table"):
            try_push(shop, store, other)
        assert store.pushes.entries("sim") == []
    assert shop.words() == shop.untouched


def change_row(url: str, number: int, change: Callable[[dict[str, Any]], None], *, sealed: bool) -> None:
    """Change a row behind the program's back; ``sealed``: with a new digest of the document."""
    with closing(sqlite3.connect(url.removeprefix("sqlite:///"))) as raw:
        doc = json.loads(raw.execute("SELECT doc FROM proposals WHERE id = ?", (number,)).fetchone()[0])
        change(doc)
        raw.execute("UPDATE proposals SET doc = ? WHERE id = ?", (json.dumps(doc), number))
        if sealed:
            raw.execute("UPDATE proposals SET digest = ? WHERE id = ?", (digest_of_doc(doc), number))
        raw.commit()


def bend(doc: dict[str, Any]) -> None:
    doc["candidate"]["columns"][4]["correction_mm"][5] += 0.0001


def test_a_changed_row_is_found_also_where_its_digest_was_made_anew(shop, capsys):
    with Store.open(shop.url) as store:
        plain, sealed = shop.copy(store), shop.copy(store)
        for number in (plain, sealed):
            approve(store, number, "anna", 24.0, SystemClock())
        change_row(shop.url, plain, bend, sealed=False)
        change_row(shop.url, sealed, bend, sealed=True)
        with pytest.raises(StoreError, match="was changed after it was stored"):
            try_push(shop, store, plain)
        with pytest.raises(TableRefused, match=r"(?s)HASH.*APPROVAL: anna approved another table"):
            try_push(shop, store, sealed)
        assert store.pushes.entries("sim") == []
    assert shop.words() == shop.untouched
    capsys.readouterr()
    assert run(["comp", "push", "-m", shop.file, str(plain), "--before", "start"]) == 2
    assert "error STO-001" in capsys.readouterr().err
    assert run(["comp", "show", "--machine", shop.file, "--json"]) == 0  # one bad row does not hide the others
    states = {p["number"]: p["state"] for p in json.loads(capsys.readouterr().out)["proposals"]}
    assert (states[plain], states[1]) == ("changed", "proposed")


def test_a_restarted_control_with_the_same_table_and_generation_is_refused(shop, tmp_path):
    with simulated(tmp_path, *MACHINE, "--boot-id", "0", "--speed", "160") as restarted, Store.open(shop.url) as store:
        number = shop.copy(store)
        approve(store, number, "anna", 24.0, SystemClock())
        before = controller_words(restarted)
        assert before[2:] == shop.untouched[2:]  # generation, banks
        assert before[:2] != shop.untouched[:2]  # boot id
        r = restarted.ready
        site = replace(shop.site, urls=DeviceUrls(r["cnc"], r["ballbar"], r["laser"], r["fixture"]))
        with pytest.raises(TableRefused, match=r"(?s)RESTART.*CHANGED"):
            try_push(shop, store, number, site=site)
        assert controller_words(restarted) == before
        assert store.pushes.entries("sim") == []


def test_a_proposal_with_reasons_is_kept_to_look_at_and_goes_nowhere(shop, capsys):
    strict = shop.sims.machine_file.with_name("strict.toml")
    strict.write_text(shop.sims.machine_file.read_text() + "table_value_um = 5\n")  # under [limits]
    capsys.readouterr()
    assert run(["comp", "propose", "-m", str(strict), "june", "--json"]) == 1
    doc = json.loads(capsys.readouterr().out)
    assert doc["state"] == "refused"
    assert any(reason.startswith("VALUE") for reason in doc["reasons"])
    number = str(doc["number"])
    assert run(["comp", "approve", number, "--as", "anna", "--machine", str(strict)]) == 1
    assert "reasons against it" in capsys.readouterr().out
    assert run(["comp", "push", "-m", str(strict), number, "--before", "start"]) == 1
    said = capsys.readouterr()
    assert "not pushed: VALUE" in said.out
    assert said.err.splitlines()[-1] == f"next: abbe comp show {number} -m {strict}"
    assert run(["comp", "push", "-m", shop.file, number, "--before", "start", "--json"]) == 1  # and not under wider limits either
    told = json.loads(capsys.readouterr().out)
    assert (told["kept"], told["text"].partition(":")[0]) == (False, "LIMITS")
    assert shop.words() == shop.untouched


def test_one_goes_all_the_way_and_back(shop, capsys, tmp_path: Path):
    def abbe(*words: str) -> tuple[int, str]:
        capsys.readouterr()
        code = run(["comp", *words])
        said = capsys.readouterr()
        assert code != 2, said.err
        return code, said.out

    def state() -> str:
        return str(json.loads(abbe("show", "1", "--machine", shop.file, "--json")[1])["state"])

    base = shop.words()[4:8]
    assert state() == "proposed"
    page = tmp_path / "diff.html"
    code, out = abbe("diff", "1", "--machine", shop.file, "--html", str(page))
    assert (code, out.count(" over ")) == (0, 10)  # nine rows and the largest
    text = page.read_text()
    assert text.count("<polyline") == 18
    assert text.count('class="band"') == 9
    assert "http" not in text.replace("http-equiv", "")
    assert abbe("diff", "1", "--with", "1", "--machine", shop.file)[1].count("+0.00") == 10

    # two people: the proposer cannot approve, nobody can push before somebody else has
    assert abbe("approve", "1", "--machine", shop.file)[0] == 1
    assert abbe("push", "-m", shop.file, "1", "--before", "start")[0] == 1
    assert shop.words() == shop.untouched
    assert abbe("approve", "1", "--as", "anna", "--machine", shop.file)[0] == 0
    assert state() == "approved"

    with Store.open(shop.url) as store:
        twin = shop.copy(store)
    with Store.open(shop.url) as store:
        # the work of `abbe comp push`, patient with a computer that others use, too
        kept = try_push(shop, store, 1, site=replace(shop.site, watching=Watching(unknown_s=5.0)))
        assert (kept.decision.keep, kept.proposal) == (True, 1), kept.decision.text
    assert state() == "kept"
    with Store.open(shop.url) as store:
        approved = next(e.doc for e in store.pushes.entries("sim") if e.state == "APPROVED")
        assert approved["approval"] == store.proposals.approvals(1)[0].digest  # the machine of the push checked the person's own yes
        assert approved["approved_by"].startswith("anna; pushed by ")
        journal, proposed = JournalView.read(store, "sim"), load(store, 1)
        now_s = SystemClock().utc().timestamp()
        assert proposal_status(store, twin, proposed, now_s).word == "superseded"  # of the same time: banks were written since
        count = len(journal.entries)
        for k, word in ((0, "proposed"), (1, "pushed"), (count - 1, "pushed"), (count, "kept")):
            assert status_of_proposal(1, proposed, [], [], replace(journal, entries=journal.entries[:k]), now_s).word == word
        assert status_of_proposal(1, proposed, [], [], JournalView(), proposed.valid_until_s).word == "expired"
    pushed = shop.words()
    code, out = abbe("push", "-m", shop.file, str(twin), "--before", "start")
    assert code == 1
    assert "not pushed: SAME" in out, "whatever else has changed came with that push"
    assert shop.words() == pushed
    stood = position_and_counters(shop.sims)
    assert run(["correct", "-m", shop.file, "june"]) == 2
    assert "was measured with table" in capsys.readouterr().err
    assert position_and_counters(shop.sims) == stood, "known before anything moves"

    assert abbe("rollback", "-m", shop.file, "--yes")[0] == 0
    assert active_crc(shop.sims) == base_crc(base)
    assert state() == "rolled back"

    # the base is in force again, byte for byte, but banks were written since: another generation
    before = shop.words()
    with Store.open(shop.url) as store:
        entries = len(store.pushes.entries("sim"))
        again = shop.copy(store)
        row = store.proposals.approvals(1)[0]
        store.proposals.approve(replace(row, proposal_id=again))
        with pytest.raises(TableRefused, match="GENERATION") as refused:
            try_push(shop, store, again)
        assert "BASE" not in str(refused.value)
        assert len(store.pushes.entries("sim")) == entries
    assert shop.words() == before
    code, out = abbe("approve", "1", "--as", "anna", "--machine", shop.file)
    assert (code, "rolled back" in out) == (1, True)


def active_crc(sims: Sims) -> int:
    words = registers(sims, 208, 5)
    high, low = words[1 + 2 * words[0] :][:2]
    return high << 16 | low


def base_crc(words: tuple[int, ...]) -> int:
    high, low = words[1 + 2 * words[0] :][:2]
    return high << 16 | low
