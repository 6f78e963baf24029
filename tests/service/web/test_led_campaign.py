"""The full campaign at the page and over HTTP: its start, what it asks for, the word that it is done, how it ended."""

from __future__ import annotations

import asyncio
import re
import socket
from collections.abc import AsyncIterator
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from typing import Any

import httpx
import pytest

from abbe.service.channel.messages import Answer, ConfirmPrompt, Jobs, Outcome, Snapshot, StartJob, Wire, from_web
from abbe.service.clock import SystemClock
from abbe.service.domain.people import ALLOWED, Permission, Role
from abbe.service.domain.progress import JobState
from abbe.service.domain.service_records import AlarmFacts, AlarmKind
from abbe.service.queries.reader import Reader
from abbe.service.queries.status import StatusReader
from abbe.service.sequences import journal
from abbe.service.web.api.sources import Sources
from abbe.service.web.app import Parts, create_app
from abbe.service.web.core_link.core_line import CoreLine
from abbe.service.web.pages.rehearsal import CAMPAIGN, Rehearsals
from abbe.service.web.problems import MEDIA_TYPE
from tests.service.core.test_channel import MOMENT
from tests.service.web.api_bench import NAME, Plant
from tests.service.web.pages.test_rehearsal import TOLD

BASE, NUMBER = "http://127.0.0.1:8080", "0123456789ab"
DONE = f"/api/v1/jobs/{NUMBER}/prompts/3/done"
ASK = "Spindle at X 1.0 Y 2.0 Z 3.0. <b>hang in</b> the 150 mm bar. Done?"
BEGUN = datetime(2026, 11, 22, tzinfo=UTC)
JOB = JobState(
    id=NUMBER, kind="campaign", recipe=CAMPAIGN, schedule="", who="user:a", state="asking", text="", begun_utc=BEGUN, prompt=3, ask=ASK
)
ENDED = replace(JOB, state="done: proposed", text="proposal 1 waits", ended_utc=BEGUN, prompt=0, ask="", solution=7, proposal=1)


@dataclass
class Desk:
    """The application with a core that asks for something, answers as it is told to, and ends its job when it is told to."""

    client: httpx.AsyncClient
    far: Wire
    core: CoreLine
    asked: list[Any] = field(default_factory=list)
    answer: tuple[Outcome, str, str] = ("done", "", NUMBER)

    async def says(self, job: JobState, moment: Snapshot) -> None:
        self.far.send(Jobs("jobs", (job,)))
        with self.core.listener() as moments:
            assert moments is not None
            self.far.send(moment)
            async for heard in moments():
                if heard == moment:
                    return

    async def serve(self) -> None:
        while (body := await self.far.receive()) is not None:
            message = from_web(body)
            self.asked.append(message)
            outcome, text, job = self.answer
            self.far.send(Answer("answer", message.request, outcome, text, job))  # type: ignore[union-attr]

    async def page(self, path: str, who: dict[str, str]) -> str:
        return (await self.client.get(path, headers=who)).text


def asking(prompt: int) -> Snapshot:
    check = replace(MOMENT.check, id=NUMBER, state="asking", prompt=prompt, ask=ASK if prompt else "")  # type: ignore[type-var]
    return replace(MOMENT, check=check, changes=100 + prompt)


@pytest.fixture
async def desk(plant: Plant) -> AsyncIterator[Desk]:
    ours, theirs = socket.socketpair()
    near, far = await Wire.over(ours), await Wire.over(theirs)
    core = CoreLine(near, SystemClock())
    view = StatusReader(Reader(plant.store, NAME, plant.clock), "0.1.0", core, core.next_due, "")
    names = ("quick-check", CAMPAIGN)
    parts = Parts(core, plant.store, NAME, names, Rehearsals(TOLD, names), (CAMPAIGN,))
    app = create_app(view, version="0.1.0", auth=plant.auth, parts=parts, api=Sources(reader=view.reader))
    async with httpx.AsyncClient(transport=httpx.ASGITransport(app, False), base_url=BASE, headers={"Origin": BASE}) as client:
        made = Desk(client, far, core)
        tasks = [asyncio.create_task(core.listen()), asyncio.create_task(made.serve())]
        await made.says(JOB, asking(3))
        yield made
        near.close()
        far.close()
        for task in tasks:
            task.cancel()


async def test_only_who_measures_says_that_it_is_done(desk: Desk, plant: Plant) -> None:
    assert (await desk.client.post(DONE)).status_code == 401
    for role in Role:
        may = Permission.MEASURE in ALLOWED[role]
        for who in (plant.session(role), plant.token(role)):
            before = len(desk.asked)
            answer = await desk.client.post(DONE, headers=who)
            assert (answer.status_code, len(desk.asked) - before) == ((202, 1) if may else (403, 0)), role
    last = desk.asked[-1]
    assert isinstance(last, ConfirmPrompt)
    assert (last.job, last.prompt, last.who.split("/")[0]) == (NUMBER, 3, "token:a-metrologist")
    assert (await desk.client.post(DONE, headers=plant.session("operator") | {"X-CSRF-Token": "x"})).status_code == 403


async def test_the_answer_is_the_core_s_and_stands_in_the_audit(desk: Desk, plant: Plant) -> None:
    who = plant.token("operator")
    answer = (await desk.client.post(DONE, headers=who)).json()
    assert (answer["kind"], answer["state"], answer["prompt"], answer["ask"], answer["proposal"]) == ("campaign", "asking", 3, ASK, None)
    record = plant.store.audit.events(1)[0]
    assert (record.target, record.outcome) == (f"job {NUMBER}, prompt 3", "done 202")
    desk.answer = ("conflict", "this job does not wait for prompt 3", "")
    late = await desk.client.post(DONE, headers=who)
    assert (late.status_code, late.headers["content-type"]) == (409, MEDIA_TYPE)
    assert "does not wait for prompt 3" in late.json()["detail"]
    before = len(desk.asked)
    for wrong in ("0", "-1", "x", "1e3", "9999999"):
        assert (await desk.client.post(DONE.replace("/3/", f"/{wrong}/"), headers=who)).status_code == 404
    assert len(desk.asked) == before


async def test_what_is_to_be_done_stands_on_both_screens(desk: Desk, plant: Plant) -> None:
    for path in ("/", "/live"):
        looking, measuring = await desk.page(path, plant.session("viewer")), await desk.page(path, plant.session("operator"))
        for shown in (looking, measuring):
            assert "&lt;b&gt;hang in&lt;/b&gt;" in shown
            assert "<b>" not in shown
        assert re.findall(r'data-job="(\w+)" data-prompt="(\d+)"', measuring) == [(NUMBER, "3")]
        assert "data-prompt" not in looking
    revision = (await desk.client.get("/api/v1/status", headers=plant.session("viewer"))).json()["revision"]
    await desk.says(JOB, replace(asking(3), check=replace(asking(3).check, prompt=4)))  # type: ignore[type-var]
    other = (await desk.client.get("/api/v1/status", headers=plant.session("viewer"))).json()
    assert (other["revision"] != revision, other["job"]["prompt"]) == (True, 4), "an open page is told"


async def test_a_prompt_is_told_in_the_reader_s_language(desk: Desk, plant: Plant) -> None:
    """On the screens, in the state of the job and in the status that keeps an open page fresh; a program gets English."""
    text, german = "Take bar, cup, mirror or artefact away. Done?", "Stab, Pfanne, Spiegel oder Normal wegnehmen. Fertig?"
    check = replace(asking(3).check, ask=text)  # type: ignore[type-var]
    await desk.says(replace(JOB, ask=text), replace(asking(3), check=check, changes=200))
    for told, lang in ((german, "de"), (text, "en")):
        who = plant.session("operator") | {"Accept-Language": lang}
        for path in ("/", "/live"):
            assert told in await desk.page(path, who)
        assert (await desk.client.get("/api/v1/status", headers=who)).json()["job"]["ask"] == told
        assert (await desk.client.get(f"/api/v1/jobs/{NUMBER}", headers=who)).json()["ask"] == told


async def test_it_is_started_from_the_checklist(desk: Desk, plant: Plant) -> None:
    who = plant.session("metrologist")
    await desk.says(ENDED, replace(MOMENT, check=None, changes=7))
    shown = await desk.page(f"/new?recipe={CAMPAIGN}", who)
    assert f'data-recipe="{CAMPAIGN}"' in shown
    assert shown.count('type="checkbox"') == 4, "nineteen set-ups are told, not ticked off beforehand"
    assert len(re.findall(r"<li>(Bar|Laser)", shown)) == 19
    assert 'id="start"' not in await desk.page(f"/new?recipe={CAMPAIGN}", plant.session("viewer"))
    assert 'data-alarm="0"' in shown
    sent = await desk.client.post("/api/v1/jobs", json={"recipe": CAMPAIGN, "rate_hz": 500}, headers=who | {"Idempotency-Key": "k"})
    assert sent.status_code == 202
    assert desk.asked[-1] == StartJob(
        request=desk.asked[-1].request, recipe=f"{CAMPAIGN} at 500 Hz", key="k", who="user:a-metrologist", alarm=0, resume=""
    )


async def test_the_cause_of_an_alarm_is_searched_from_the_same_checklist(desk: Desk, plant: Plant) -> None:
    who = plant.session("metrologist")
    await desk.says(ENDED, replace(MOMENT, check=None, changes=7))
    shown = await desk.page(f"/new?recipe={CAMPAIGN}&alarm=3", who)
    assert 'data-alarm="3"' in shown
    assert "looks for the cause of alarm 3" in shown
    assert 'data-alarm="0"' in await desk.page("/new?recipe=quick-check&alarm=3", who), "a check finds no cause"
    sent = await desk.client.post("/api/v1/jobs", json={"recipe": CAMPAIGN, "alarm": 3}, headers=who)
    assert sent.status_code == 202
    assert desk.asked[-1] == StartJob(request=desk.asked[-1].request, recipe=CAMPAIGN, key="", who="user:a-metrologist", alarm=3, resume="")
    assert plant.store.audit.events(1)[0].target == f"job {NUMBER}, recipe {CAMPAIGN}, alarm 3"


async def test_an_interrupted_campaign_is_resumed_once_somebody_says_that_nothing_was_changed(desk: Desk, plant: Plant) -> None:
    who, store = plant.session("metrologist"), plant.store
    await desk.says(ENDED, replace(MOMENT, check=None, changes=7))
    assert 'data-resume=""' in await desk.page(f"/new?recipe={CAMPAIGN}&resume=noon", who), "there is nothing to resume"
    machine = next(one for one in store.machines.all() if one.name == NAME)
    number = store.campaigns.add(machine.id, "noon & after", {})
    store.checkpoints.add(
        number, journal.BEGUN, {"plan": "h", "source": {"recipe": CAMPAIGN, "rate_hz": 500}, "boot_id": 1, "table_crc": 2}
    )
    store.runs.finish(store.runs.start(number, "r1", "laser_linear", "identify", {}), "complete", "", None)
    store.checkpoints.add(number, journal.ENDED, {"how": "stopped"})
    offered = await desk.page(f"/new?recipe={CAMPAIGN}", who)
    assert "Complete runs: 1." in offered
    assert offered.count('type="checkbox"') == 4, "a new campaign asks nothing more"
    (link,) = re.findall(r'href="(/new[^"]*resume=[^"]*)"', offered)
    shown = await desk.page(link.replace("&amp;", "&"), who)
    assert ('data-resume="noon &amp; after"' in shown, 'data-rate="500"' in shown, shown.count('type="checkbox"')) == (True, True, 5)
    assert "nobody has repaired, adjusted or moved anything at the machine" in shown
    sent = await desk.client.post("/api/v1/jobs", json={"recipe": CAMPAIGN, "resume": "noon & after"}, headers=who)
    assert sent.status_code == 202
    assert desk.asked[-1].resume == "noon & after"  # type: ignore[union-attr]
    assert store.audit.events(1)[0].target == f"job {NUMBER}, recipe {CAMPAIGN}, resumes noon & after"


async def test_before_the_start_the_screen_says_what_comes_first_and_asks_for_no_set_up_where_nothing_is_mounted(
    desk: Desk, plant: Plant
) -> None:
    who = plant.session("metrologist")
    await desk.says(ENDED, replace(MOMENT, check=None, changes=7))
    facts = AlarmFacts(recipe="quick-check", schedule="yearly", verification=1, text="too far off", campaign="c")
    number, shown = 0, dict[str, tuple[int, int]]()
    for seq, kind in enumerate((AlarmKind.RAISED, AlarmKind.MEASURED, AlarmKind.DISCOVERED)):
        number = plant.store.alarms.append(NAME, number or None, seq, kind, facts).alarm
        page = await desk.page(f"/new?recipe={CAMPAIGN}&alarm={number}", who)
        words = ("from the first set-up", "search uses its runs", "proposal is computed")
        (said,) = (word for word in words if word in page)
        assert 'id="start"' in page
        shown[said] = page.count('type="checkbox"'), len(re.findall(r"<li>(Bar|Laser)", page))
    assert shown == {"from the first set-up": (4, 19), "search uses its runs": (0, 0), "proposal is computed": (0, 0)}


@pytest.mark.parametrize(("found", "label"), [(False, "Search for the cause"), (True, "Compute a proposal")])
async def test_the_button_says_what_the_search_begins_with(desk: Desk, plant: Plant, found: bool, label: str) -> None:
    facts = AlarmFacts(recipe="quick-check", schedule="yearly", verification=1, text="too far off", campaign="c", name="petra")
    number = plant.store.alarms.append(NAME, None, 0, AlarmKind.RAISED, facts).alarm
    kinds = (AlarmKind.ACKNOWLEDGED, *((AlarmKind.MEASURED, AlarmKind.DISCOVERED) if found else ()))
    for seq, kind in enumerate(kinds, start=1):
        plant.store.alarms.append(NAME, number, seq, kind, facts)
    page = await desk.page(f"/alarm?id={number}", plant.session("metrologist"))
    assert re.findall(r'<a class="go main" href="/new[^>]*>([^<]*)<', page) == [label]


async def test_who_may_not_propose_starts_checks_only(desk: Desk, plant: Plant) -> None:
    scopes = [Permission.READ, Permission.MEASURE]
    narrow = {"Authorization": f"Bearer {plant.people.add_token('a-metrologist', 'narrow', scopes, 5.0)}"}
    for who in (plant.session("operator"), plant.token("operator"), narrow):
        for rate in (100, 500):
            sent = await desk.client.post("/api/v1/jobs", json={"recipe": CAMPAIGN, "rate_hz": rate}, headers=who)
            assert (sent.status_code, "needs 'propose'" in sent.json()["detail"], desk.asked) == (403, True, [])
    record = plant.store.audit.events(1)[0]
    assert (record.target, record.outcome) == (f"recipe {CAMPAIGN} at 500 Hz", "refused 403")
    await desk.says(ENDED, replace(MOMENT, check=None, changes=7))
    shown = await desk.page(f"/new?recipe={CAMPAIGN}", plant.session("operator"))
    assert ('id="start"' in shown, "the right to propose tables as well" in shown) == (False, True)
    assert 'id="start"' in await desk.page("/new?recipe=quick-check", plant.session("operator"))
    for k, who in enumerate((plant.session("operator"), narrow), start=1):
        assert (await desk.client.post("/api/v1/jobs", json={"recipe": "quick-check"}, headers=who)).status_code == 202
        assert len(desk.asked) == k
    assert (await desk.client.post("/api/v1/jobs", json={"recipe": CAMPAIGN}, headers=plant.token("metrologist"))).status_code == 202


async def test_how_it_ended_is_told_with_its_proposal_and_its_own_alarm(desk: Desk, plant: Plant) -> None:
    await desk.says(replace(ENDED, alarm=5), replace(MOMENT, check=None, changes=7))
    told = (await desk.client.get(f"/api/v1/jobs/{NUMBER}", headers=plant.token("viewer"))).json()
    assert (told["state"], told["solution"], told["proposal"], told["alarm"], told["prompt"]) == ("done: proposed", 7, 1, 5, 0)
    shown = await desk.page("/live", plant.session("viewer"))
    assert "proposal 1 waits" in shown
    assert 'href="/proposal?id=1"' in shown
    assert 'href="/alarm?id=5"' in shown
