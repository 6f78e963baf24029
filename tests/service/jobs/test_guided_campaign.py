"""The full campaign that a page leads through: what can be gone on with, what a person is asked, and every way in which it ends.

Mutations that were seen to be caught: a stop that nobody hears while it is solved or asked, the proposer's name left out.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, nullcontext
from dataclasses import asdict, replace
from datetime import UTC, date, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from abbe.drivers.api import Condition
from abbe.service.campaigns.campaign_run import plan_hash
from abbe.service.cli.administration.serve import _campaigns
from abbe.service.clock import SystemClock
from abbe.service.domain.progress import JobOutcome, ignore_progress
from abbe.service.domain.service_records import AlarmEntryRecord, AlarmFacts, AlarmKind
from abbe.service.errors import Aborted, NotObservable, PreconditionsChanged, Stopped, TableMismatch, TableRefused
from abbe.service.jobs import guided_campaign as work
from abbe.service.jobs import investigate
from abbe.service.jobs.interrupted import InterruptedCampaign
from abbe.service.jobs.investigate import InvestigationContext
from abbe.service.sequences.control import Control, State, Watching
from abbe.service.sequences.recipes.campaigns import RecipeSource, campaign_source
from abbe.service.sequences.recipes.recipe import Helix, Linear
from abbe.service.sequences.recipes.recipe_file import recipe_text
from abbe.service.sequences.steps import CampaignPlan
from abbe.service.verification.alarm_states import Alarm, folded
from tests.pretended_status import controller_status
from tests.service.core.fakes import settle
from tests.service.web.pages.test_rehearsal import MACHINE


@pytest.mark.parametrize("recipe", ["identification at 500 Hz", "own.toml", "our own recipe"])
def test_what_was_broken_off_is_gone_on_with_by_the_command_line(recipe: str, tmp_path: Path) -> None:
    site: Any = SimpleNamespace(machine=MACHINE, max_feed_mm_min=6000.0)
    assert _campaigns("own.toml", site, tmp_path) == ("identification",), "a file that is not there cannot be started"
    for name in ("own.toml", "our own recipe"):
        (tmp_path / name).write_text(recipe_text("own", (Helix("h", "B1", "identify", (300.0, 250.0, 100.0), 100.0),)))
    assert _campaigns("own.toml", site, tmp_path) == ("identification", "own.toml")
    source = campaign_source(recipe, tmp_path)
    again = RecipeSource(**json.loads(json.dumps(asdict(source))))  # as the journal of the campaign keeps it
    assert plan_hash(source.plan(MACHINE)) == plan_hash(again.plan(MACHINE))


def pretended(**site: Any) -> Any:
    told = {"calibrated_until": {"laser": date(2099, 12, 31)}, "name": "mill-7", "watching": Watching()} | site
    return SimpleNamespace(
        plan=CampaignPlan("full 1", ()),
        site=SimpleNamespace(**told),
        control=Control(),
        store=None,
        progress=None,
        clock=SystemClock(),
    )


async def measured(bench: Any, source: Any, **_: object) -> None:
    """All of it, without a device."""


async def all_there(*_: object, **__: object) -> None:
    """Every device answers."""


async def test_after_the_last_day_of_a_certificate_nothing_is_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(work, "_measured")
    bench = pretended(calibrated_until={"laser": date(2020, 5, 31), "ballbar": date(2020, 4, 30)})
    line = Linear("l", "L1", "identify", 0, positions=5, at_share=(0.15, 0.15)).plan(MACHINE)
    bench.plan = CampaignPlan("full 1", (line,))
    led = await work.run_guided_campaign(bench, {}, "bob")
    assert (led.word, "certificate of the laser ended on 2020-05-31" in led.text, "ball-bar" in led.text) == ("ended", True, False)


async def test_without_certificates_nothing_is_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(work, "_measured")
    led = await work.run_guided_campaign(pretended(calibrated_until={}), {}, "bob")
    assert (led.word, "no calibration certificate" in led.text) == ("ended", True)


@pytest.mark.parametrize("how", ["stop", "abort"])
async def test_what_is_ended_before_it_begins_asks_no_device(how: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(work, "_measured")
    bench = pretended(calibrated_until={})
    getattr(bench.control, how)()
    with pytest.raises((Stopped, Aborted)):
        await work.run_guided_campaign(bench, {}, "bob")


async def test_a_stop_while_a_push_is_taken_back_begins_no_campaign(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = pretended(max_feed_mm_min=6000.0, urls=SimpleNamespace(cnc="cnc"))

    @asynccontextmanager
    async def session(*_: object, **__: object) -> AsyncIterator[Any]:
        bench.control.stop()
        yield SimpleNamespace(controller=None)

    for name, instead in (("lock_machine", lambda _: nullcontext()), ("recovered_session", session)):
        monkeypatch.setattr(work, name, instead)
    for name, instead in (("paced", lambda plan, _: plan), ("check_devices", all_there)):
        monkeypatch.setattr(work, name, instead)
    monkeypatch.delattr(work, "start_campaign")
    bench.live = None
    with pytest.raises(Stopped):
        await work.run_guided_campaign(bench, {}, "bob")


@pytest.mark.parametrize(
    ("tables", "conditions", "refused"),
    [
        (None, Condition(0), False),
        ("some", Condition(0), True),
        ("some", Condition.COMPENSATION_ON, False),
        ("some", Condition.PATH_RUNNING, True),
    ],
)
async def test_a_table_that_is_switched_off_is_told_before_anything_is_mounted(
    tables: str | None, conditions: Condition, refused: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def status() -> Any:
        return controller_status(conditions)

    async def base(_: object) -> Any:
        return SimpleNamespace(tables=tables, crc=0x5A)

    monkeypatch.setattr(work, "read_base", base)
    session: Any = SimpleNamespace(controller=SimpleNamespace(status=status))
    with pytest.raises(TableMismatch, match="0000005A has no effect") if refused else nullcontext():
        await work._check_table_acts(session)


@pytest.mark.parametrize("no", [TableRefused("too little", "stay"), NotObservable("E"), TableMismatch("F")])
async def test_an_answer_that_is_no_is_the_end_s_text(monkeypatch: pytest.MonkeyPatch, no: Exception) -> None:
    async def refuse(*_: object) -> Any:
        raise no

    monkeypatch.setattr(work, "_measured", measured)
    monkeypatch.setattr(work, "make_proposal", refuse)
    led = await work.run_guided_campaign(pretended(), {}, "bob")
    assert led == JobOutcome("ended", f"no proposal: {no}; campaign 'full 1' is kept; `abbe solve` shows its result")


async def test_what_speaks_against_a_proposal_and_who_proposes_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[str] = []

    async def made(bench: Any, campaign: str, agree: Any, by: str) -> Any:
        assert bench.control.no_pause_reason, "nothing could hold it: it cannot be paused"
        seen.append(f"{campaign} by {by}")
        return SimpleNamespace(number=3, proposed=SimpleNamespace(solution_id=2, reasons=("LIMITS: too much", "STALE")))

    monkeypatch.setattr(work, "_measured", measured)
    monkeypatch.setattr(work, "make_proposal", made)
    led = await work.run_guided_campaign(pretended(), {}, "bob")
    assert led == JobOutcome("ended", "proposal 3 cannot be approved: LIMITS: too much; STALE", 2, 3)
    assert seen == ["full 1 by bob"]


async def test_a_stop_while_it_is_solved_leaves_no_proposal(monkeypatch: pytest.MonkeyPatch) -> None:
    async def made(bench: Any, campaign: str, agree: Any, by: str) -> Any:
        bench.control.stop()
        agree(None)
        raise AssertionError

    monkeypatch.setattr(work, "_measured", measured)
    monkeypatch.setattr(work, "make_proposal", made)
    with pytest.raises(Stopped) as told:
        await work.run_guided_campaign(pretended(), {}, "bob")
    assert "abbe comp propose -m MACHINE.toml 'full 1'" in told.value.__notes__[0]


async def test_a_person_is_told_where_the_spindle_stands_and_a_stop_ends_the_wait() -> None:
    async def status() -> Any:
        return SimpleNamespace(position_mm=(300.04, -1.0, 99.96))

    control = Control()
    prompted = work._PromptedPerson(control)
    prompted.session = SimpleNamespace(controller=SimpleNamespace(status=status))  # type: ignore[assignment]
    control.now(State.RUNNING)
    for number, word in ((1, control.prompts.answer), (2, lambda _: control.stop())):
        asking = asyncio.create_task(prompted.ask("Hang in the bar. Done?"))
        await settle()
        assert control.prompts.now is not None
        assert (control.prompts.now.number, control.prompts.now.text) == (
            number,
            "Spindle at X 300.0 mm Y -1.0 mm Z 100.0 mm. Hang in the bar. Done?",
        )
        word(number)
        await asyncio.wait({asking}, timeout=10)
        assert control.prompts.now is None
        assert isinstance(asking.exception(), Stopped) == (number == 2)


@pytest.mark.parametrize("resumes", [False, True])
async def test_what_is_broken_off_tells_how_it_is_resumed_and_what_resumes_begins_no_campaign(
    resumes: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    told_by_resume = SimpleNamespace(campaign=(4, 0), messages=())
    begun: list[object] = []

    @asynccontextmanager
    async def session(*_: object, **__: object) -> AsyncIterator[Any]:
        yield SimpleNamespace(controller=None)

    async def stopped(*_: object, campaign: object, options: Any, **__: object) -> Any:
        begun.append((campaign, options.resumed))
        raise Stopped("by a person", "")

    async def started(*_: object, **__: object) -> tuple[int, int]:
        return 7, 0

    async def resumed(*given: object) -> Any:
        assert given[-2:] == ("full 1", None), "nobody is asked whether a set-up is untouched: it is mounted anew"
        return told_by_resume

    for name, instead in (
        ("lock_machine", lambda _: nullcontext()),
        ("recovered_session", session),
        ("paced", lambda plan, _: plan),
        ("check_devices", all_there),
        ("_check_table_acts", all_there),
        ("start_campaign", started),
        ("resume_campaign", resumed),
        ("measure", stopped),
    ):
        monkeypatch.setattr(work, name, instead)
    bench = pretended(max_feed_mm_min=6000.0, urls=SimpleNamespace(cnc="cnc"))
    bench.live = None
    bench.control.now(State.RUNNING)
    with pytest.raises(Stopped) as told:
        await work._measured(bench, RecipeSource(recipe="identification"), resumes=resumes)
    assert begun == [((4, 0), told_by_resume) if resumes else ((7, 0), None)]
    (note,) = told.value.__notes__
    assert "abbe measure -m MACHINE.toml --resume 'full 1'" in note
    assert "the screen of a new measurement resumes it" in note


class Lines:
    """An alarm and its lines, without a store."""

    def __init__(self) -> None:
        self.lines: list[AlarmEntryRecord] = []

    async def note(self, kind: AlarmKind, facts: AlarmFacts) -> Alarm:
        line = AlarmEntryRecord(machine="mill-7", alarm=1, seq=len(self.lines), kind=kind, facts=facts, utc="2026-11-22T00:00:00Z")
        self.lines.append(line)
        return folded(self.lines)[0]


async def test_the_cause_of_an_alarm_is_measured_with_a_person_and_its_lines_come_in_order(monkeypatch: pytest.MonkeyPatch) -> None:
    lines = Lines()
    await lines.note(AlarmKind.RAISED, AlarmFacts(text="too far off"))
    alarm = await lines.note(AlarmKind.ORDERED, AlarmFacts(name="petra"))

    async def led(context: Any, source: Any, begins: Any, *, resumes: bool) -> list[int]:
        assert not resumes
        assert [line.kind for line in lines.lines] == ["raised", "ordered"], "nothing has begun before the devices are checked"
        await begins()
        assert (lines.lines[-1].kind, context.plan.name) == ("begun", lines.lines[-1].facts.campaign)
        return [7, 8]

    async def nothing_found(context: Any, alarm: Alarm, note: Any) -> Alarm:
        raise NotObservable("scale of X")

    monkeypatch.setattr(work, "_measured", led)
    monkeypatch.setitem(investigate._STEPS, AlarmKind.DISCOVERED, nothing_found)
    bench: Any = InvestigationContext(pretended().site, None, CampaignPlan("", ()), SystemClock(), ignore_progress)  # type: ignore[arg-type]
    await work.investigate_guided(bench, {}, alarm, lines.note)  # type: ignore[arg-type]
    assert [line.kind for line in lines.lines[2:]] == ["begun", "measured", "ended"]
    assert lines.lines[3].facts.text.endswith("is measured: 2 runs")


NOON = InterruptedCampaign(
    name="of noon", recipe="identification", rate_hz=100, complete=3, until_utc=datetime(2026, 11, 28, 12, tzinfo=UTC), alarm=1
)  # fmt: skip


@pytest.mark.parametrize(
    ("found", "why"),
    [
        (NOON, ""),
        (None, "is complete, or is not the last one of its recipe"),
        (replace(NOON, name="of evening"), "is complete, or is not the last one of its recipe"),
        (replace(NOON, alarm=2), "looks for the cause of alarm 2"),
        (replace(NOON, alarm=0), "does not look for the cause of alarm 1 any more"),
    ],
)
async def test_a_stopped_search_resumes_its_own_campaign_and_no_other(
    found: InterruptedCampaign | None, why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    lines = Lines()
    alarm = await lines.note(AlarmKind.RAISED, AlarmFacts(text="too far off"))
    seen: list[tuple[str, bool]] = []

    async def led(context: Any, source: Any, begins: Any, *, resumes: bool) -> list[int]:
        seen.append((context.plan.name, resumes))
        raise Stopped("by a person", "")

    monkeypatch.setattr(work, "_measured", led)
    monkeypatch.setattr(work, "interrupted_campaign", lambda *_: found)
    bench: Any = InvestigationContext(pretended().site, None, CampaignPlan("", ()), SystemClock(), ignore_progress)  # type: ignore[arg-type]
    with pytest.raises(PreconditionsChanged, match=why) if why else pytest.raises(Stopped):
        await work.investigate_guided(bench, RecipeSource(recipe="identification"), alarm, lines.note, resume="of noon")
    assert seen == ([] if why else [("of noon", True)])


async def test_a_campaign_that_is_not_interrupted_is_not_resumed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(work, "_measured")
    monkeypatch.setattr(work, "interrupted_campaign", lambda *_: None)
    with pytest.raises(PreconditionsChanged, match="campaign 'full 1' is complete, or is not the last one of its recipe"):
        await work.run_guided_campaign(pretended(), RecipeSource(recipe="identification"), "bob", resumes=True)


async def test_without_certificates_no_cause_is_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(work, "_measured")
    lines = Lines()
    alarm = await lines.note(AlarmKind.RAISED, AlarmFacts(text="too far off"))
    bench: Any = InvestigationContext(pretended(calibrated_until={}).site, None, CampaignPlan("", ()), SystemClock(), ignore_progress)  # type: ignore[arg-type]
    await work.investigate_guided(bench, {}, alarm, lines.note)  # type: ignore[arg-type]
    assert (lines.lines[-1].kind, "no calibration certificate" in lines.lines[-1].facts.text) == ("ended", True)
