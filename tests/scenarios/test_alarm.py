"""The service by itself on a simulated machine: checks, the machine drifts, it warns, looks for the cause, proposes; a person says yes."""

from __future__ import annotations

import asyncio
import json
import os
import re
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, closing, suppress
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest

from abbe.service.audit.book import AuditBook
from abbe.service.cli import run
from abbe.service.cli.administration.serve import duties_on
from abbe.service.clock import SystemClock
from abbe.service.compensation.proposal_decisions import approve, proposal_status
from abbe.service.compensation.proposal_doc import load
from abbe.service.config import load_machine
from abbe.service.config_schema import AlarmSection
from abbe.service.core.board import Board
from abbe.service.devices.session import open_session
from abbe.service.domain.progress import ProgressSink
from abbe.service.domain.schedule import Schedule
from abbe.service.domain.service_records import AlarmKind
from abbe.service.domain.verification import CheckResult
from abbe.service.errors import StoreError
from abbe.service.jobs.check import run_check
from abbe.service.push.validate import PushLimits
from abbe.service.queries.reader import Reader
from abbe.service.queries.status import StatusReader
from abbe.service.scheduler.alarm_manager import AlarmChannels, AlarmManager
from abbe.service.scheduler.job import CheckJobs, Job, carry_out
from abbe.service.scheduler.loop import LoopTerms, Scheduler
from abbe.service.scheduler.ports import SlotState
from abbe.service.scheduler.retrying_store import StoreLedger, StoreShelf
from abbe.service.sequences.control import Control, Watching
from abbe.service.sequences.recipes.campaigns import identification
from abbe.service.sequences.steps import CampaignPlan
from abbe.service.site import Site, site_of
from abbe.service.storage.store import Store
from abbe.service.verification.alarm_states import Alarm
from abbe.service.verification.alarms import acknowledge, alarms_of
from tests.pretended import as_if_commissioned, as_if_proved_for_nobody_there
from tests.scenarios.conftest import Sims
from tests.system.serve_bench import Broker, Process, payload

pytestmark = [pytest.mark.scenario, pytest.mark.timeout(600)]
RATE_HZ = 50
TOPICS = ("abbe/sim/verification", "abbe/sim/alarm")
OFTEN = Schedule("often", "*/10 * * * * *", "UTC", "quick-check", on_alarm="propose")
# The machine as it is made, with all its errors, is what the limits allow; what drifts is not.
LIMITS = "[verify]\nbody_diagonal_um = 90\nhelix_rms_um = 7\n"


@dataclass
class Shop:
    sims: Sims
    site: Site
    store: Store
    config: Any
    url: str

    def alarms(self) -> list[Alarm]:
        return alarms_of(self.store, "sim")

    def state(self, number: int) -> str:
        return proposal_status(self.store, number, load(self.store, number), SystemClock().utc().timestamp()).word

    def told(self) -> list[dict[str, Any]]:
        found = [json.loads(m.payload) for m in self.store.outbox.pending() if m.topic == TOPICS[1]]
        return [doc for doc in found if doc["code"].startswith("ALM")]  # slots that came due during all this are told, too

    @asynccontextmanager
    async def service(self) -> AsyncIterator[Board]:
        """What `abbe.service.serve` wires, without page and broker."""
        clock, board = SystemClock(), Board({}, SystemClock())
        full = identification(self.site.machine, rate_hz=RATE_HZ)
        tests = tuple(t for t in full.tests if not t.label.endswith(("ZYX", "helix4", "helix5")))
        duties = duties_on(AlarmSection(push="approved"), self.site, CampaignPlan("full", tests), RATE_HZ)(self.store)
        channels = AlarmChannels(TOPICS[1], lambda: None, AuditBook(self.store, self.url))
        desk = AlarmManager(self.store, clock, "sim", [OFTEN], duties, channels)
        shelf = StoreShelf(self.store, clock, ("sim", self.store.machines.add("sim", self.site.doc)), TOPICS, lambda: None)

        async def check(recipe: str, progress: ProgressSink, control: Control) -> CheckResult:
            return await run_check(self.config, self.store, recipe, progress, control=control)

        checks = CheckJobs("sim", check, shelf, clock, desk.checked)

        async def run_job(job: Job[Any]) -> SlotState:
            return await carry_out(job, clock.utc(), Control(), [board])

        async def run_slot(schedule: Schedule, slot: datetime) -> SlotState:
            return await run_job(checks(schedule, slot))

        terms = LoopTerms(poll_s=0.5, recheck_s=0.5, follow_ups=desk, run_job=run_job)
        scheduler = Scheduler([OFTEN], StoreLedger(self.store, clock, "sim"), run_slot, shelf, clock, terms)
        running = asyncio.create_task(scheduler.run())
        self.view = StatusReader(Reader(self.store, "sim", clock), "0", board, scheduler.next_due, "")
        try:
            yield board
            assert not running.done(), running
        finally:
            running.cancel()
            with suppress(asyncio.CancelledError):
                await running


async def until(what: Callable[[], Any], limit_s: float = 300.0) -> Any:
    """Poll what another task brings about; the store is where it can be seen."""
    async with asyncio.timeout(limit_s):
        while True:
            with suppress(StoreError):  # locked for a while on a busy computer: the next look sees it
                found = await asyncio.to_thread(what)
                if found:
                    return found
            await SystemClock().sleep(0.25)


@pytest.fixture
async def shop(start_sims: Callable[..., Sims]) -> AsyncIterator[Shop]:
    sims = start_sims("--speed", "100", "--seed", "2", extra=LIMITS)
    loaded = load_machine(sims.machine_file)
    # As in test_correction: some tests are left out to save time, so the tables bend more than they should. Nothing was pushed before.
    wide = PushLimits(value_mm=0.3, second_mm=0.05, change_mm=0.3, walk_mm=0.3)
    site = replace(site_of(loaded.machine), limits=wide, watching=Watching(unknown_s=5.0))
    with Store.open(loaded.database_url) as store:
        async with open_session(site.urls) as session:
            await as_if_commissioned(session.controller, store, site)
            await as_if_proved_for_nobody_there(session.controller, store, site)
        yield Shop(sims, site, store, loaded.machine, loaded.database_url)


@pytest.mark.skipif(not os.environ.get("ABBE_TEST_LONG"), reason="a minute and a half: ABBE_TEST_LONG=1 runs it")
async def test_a_drift_is_found_named_proposed_approved_pushed_and_over(shop: Shop, capsys: pytest.CaptureFixture[str]) -> None:
    async with shop.service():
        await until(lambda: shop.store.verifications.of_machine("sim"))
        assert shop.alarms() == []
        shop.sims.ask("drift", axis="X", um_per_m=120.0)
        (raised,) = await until(shop.alarms)
        assert raised.word == "raised"
        assert {s.figure for s in raised.signals} >= {"helix_rms_um"}
        assert all(s.expanded > 0 for s in raised.signals)

        # nobody has asked for it: the full campaign, what is missing, the tables
        await until(lambda: shop.alarms()[0].last(AlarmKind.PROPOSED, AlarmKind.ENDED, AlarmKind.FAILED))
        found = shop.alarms()[0]
        kinds = [step.kind for step in found.work]
        assert kinds == [AlarmKind.BEGUN, AlarmKind.MEASURED, AlarmKind.DISCOVERED, AlarmKind.PROPOSED], found.outcome
        proposed = found.work[-1].facts
        number, change = proposed.proposal, re.search(r"largest change: ([+-][\d.]+) µm .* in the table of X over X", proposed.text)
        assert change is not None, proposed.text  # what drifted: X, by its own scale
        assert abs(float(change[1])) == pytest.approx(72.0, abs=15.0)  # 120 µm/m over 600 mm, and what X had before
        assert shop.state(number) == "proposed"
        assert shop.store.pushes.entries("sim") == []  # nothing is written, nobody has approved
        assert [d["code"] for d in shop.told()] == ["ALM-001", "ALM-003"]
        (shown,) = (await shop.view.status()).alarms
        assert (shown.state, shown.proposal) == ("raised", number)
        assert acknowledge(shop.store, "sim", 1, "otto").word == "acknowledged"

        # a person says yes: the service pushes, verifies, keeps, checks again, and the alarm is over
        approve(shop.store, number, "anna", 1.0, SystemClock())
        await until(lambda: shop.alarms()[0].last(AlarmKind.PUSHED))
        pushed = shop.alarms()[0].last(AlarmKind.PUSHED)
        assert pushed is not None
        assert pushed.facts.word == "kept", pushed.facts.text
        over = await until(lambda: None if shop.alarms()[0].active else shop.alarms()[0])
        assert over.word == "closed"
        assert shop.state(number) == "kept"
        assert len(shop.alarms()) == 1

    latest = shop.store.verifications.of_machine("sim")[0]
    assert latest.verdict == "pass"
    assert latest.doc["values"]["helix_rms_um"] < 4.0
    assert [d["code"] for d in shop.told()] == ["ALM-001", "ALM-003", "ALM-006", "ALM-002"]
    entry = next(e.doc for e in shop.store.pushes.entries("sim") if e.state == "APPROVED")
    assert entry["approved_by"].startswith("anna; pushed by ")
    assert entry["approved_by"].endswith("by the service")
    said = [r.outcome for r in shop.store.audit.events() if r.action == "abbe serve"]
    assert said == ["raised", "begun", "measured", "discovered", "proposed", "pushing", "pushed", "cleared"]
    reasons = [s.reason for s in shop.store.slots.latest("sim/often") if s.reason and s.state == "done: fail"]
    assert any(reason.startswith("alarm 1 raised: helix rms") for reason in reasons)

    # the trend begins anew with the table
    capsys.readouterr()
    assert run(["trend", "-m", str(shop.sims.machine_file), "--json"]) == 0
    figures = {f["figure"]: f for f in json.loads(capsys.readouterr().out)["figures"]}
    assert figures["helix_rms_um"]["checks"] < len([v for v in shop.store.verifications.of_machine("sim") if v.doc.get("values")])
    assert figures["helix_rms_um"]["latest"] < 4.0
    assert run(["alarm", "list", "-m", str(shop.sims.machine_file), "--all", "--json"]) == 0
    (doc,) = json.loads(capsys.readouterr().out)["alarms"]
    assert (doc["state"], doc["acknowledged_by"], doc["proposal"]) == ("closed", "otto", number)
    assert "kept: push 1: worst body diagonal" in doc["outcome"]


@pytest.fixture
def receiver(tmp_path: Path) -> Iterator[tuple[Broker, Process]]:
    """A broker, and somebody who listens to it."""
    broker = Broker(tmp_path)
    with closing(broker.process), closing(broker.subscriber()) as process:
        yield broker, process


def test_once_checks_tells_raises_the_alarm_ends_with_1_and_says_what_a_bad_campaign_file_is(
    start_sims: Callable[..., Sims], receiver: tuple[Broker, Process], capsys: pytest.CaptureFixture[str]
) -> None:
    broker, heard = receiver
    timetable = '[[schedule]]\nname = "weekly"\ncron = "0 6 * * 1"\nrecipe = "quick-check at 20 Hz"\non_alarm = "propose"\n'
    out = f'[verify]\nhelix_rms_um = 1\n[mqtt]\nurl = "{broker.url}"\ntopic_prefix = "plant/abbe"\n[web]\nport = 0\n{timetable}'
    sims = start_sims("--speed", "100", "--seed", "2", extra=out)
    assert run(["serve", "-m", str(sims.machine_file), "--once", "--json"]) == 1, capsys.readouterr().err
    assert json.loads(capsys.readouterr().out) == {"machine": "sim", "exit_code": 1, "text": "not all checks passed"}
    result = payload(heard.expect("sim/verification"))
    assert (result["verdict"], result["schedule"]) == ("fail", "weekly (once)")
    assert run(["alarm", "list", "-m", str(sims.machine_file), "--json"]) == 0
    (doc,) = json.loads(capsys.readouterr().out)["alarms"]
    assert (doc["state"], doc["schedule"]) == ("raised", "weekly (once)")
    assert {(s["figure"], s["kind"]) for s in doc["signals"]} >= {("helix_rms_um", "limit")}

    with sims.machine_file.open("a") as file:
        file.write('[alarm]\ncampaign = "hour.toml"\n')
    assert run(["serve", "-m", str(sims.machine_file), "--once"]) == 2
    assert re.search(r"error CFG-001: .*hour\.toml", capsys.readouterr().err)
