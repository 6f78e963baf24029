"""Trouble on the links of a measurement is in the campaign's journal: noticed, and how it ended. Nobody waits for a locked database."""

from __future__ import annotations

import asyncio
import json
import re
import sqlite3
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from abbe.drivers.errors import LinkDown
from abbe.service.campaigns.measure import MeasureOptions, measure
from abbe.service.cli.app import app
from abbe.service.clock import SystemClock
from abbe.service.sequences.control import State
from abbe.service.sequences.journal import ENDED, INCIDENT, StoreJournal, troubles
from abbe.service.sequences.steps import CampaignPlan
from abbe.service.sequences.watch import IncidentNotes, incidents_noted, links_of
from abbe.service.storage.store import Store
from abbe.simulators.faults.modbus_proxy import ModbusProxy
from abbe.simulators.faults.scenario import Fault, FaultScenario
from tests.faults.sequencer_world import AtStep, Bench, bench, small

SPEED = 60.0


@dataclass
class Place:
    """A machine whose controller is behind a proxy, and a database."""

    bench: Bench
    proxy: ModbusProxy
    store: Store
    url: str
    pulled: asyncio.Task[None] | None = None

    def lines(self) -> list[dict[str, Any]]:
        return [one.doc for one in self.store.checkpoints.of_campaign(self.store.campaigns.all()[-1].id) if one.kind == INCIDENT]


@pytest.fixture
async def place(tmp_path: Path) -> AsyncIterator[Place]:
    async with proxied(tmp_path) as (b, proxy):
        b.sim.pace(SPEED)
        url = f"sqlite:///{tmp_path / 'abbe.sqlite3'}"
        with Store.open(url) as store:
            yield Place(b, proxy, store, url)


@asynccontextmanager
async def proxied(folder: Path) -> AsyncIterator[tuple[Bench, ModbusProxy]]:
    """The proxy is there before the session; it is told where the controller is when the simulators have started."""
    proxy = ModbusProxy(("127.0.0.1", 0))
    await proxy.start()

    def through(url: str) -> str:
        found = re.search(r":(\d+)\?", url)
        assert found is not None
        proxy._upstream = ("127.0.0.1", int(found[1]))
        return proxy.url

    try:
        async with bench(folder, cnc_url=through) as b:
            yield b, proxy
    finally:
        await proxy.stop()


async def test_a_connection_that_is_reset_is_two_lines_that_name_the_run(place: Place) -> None:
    plan = CampaignPlan("c", (small("Helix"),))
    control = AtStep(3, lambda: place.proxy.play(FaultScenario("rst", 1, (Fault("rst"),))))
    (run,) = await measure(place.bench.session, place.store, place.bench.site, plan, options=MeasureOptions(control))
    detected, outcome = place.lines()
    assert (detected["phase"], outcome["phase"], outcome["state"]) == ("detected", "outcome", "recovered")
    assert detected["code"] == outcome["code"] == LinkDown.code
    assert (detected["link"], detected["device"]) == ("controller", place.proxy.url)
    assert detected["run"] == outcome["run"] == f"run {run} test"
    assert detected["at_utc"] <= outcome["at_utc"]
    assert place.store.runs.find(run).status == "complete"


async def test_show_tells_a_campaigns_incidents_and_how_they_ended(place: Place) -> None:
    plan = CampaignPlan("c", (small("Helix"),))
    control = AtStep(3, lambda: place.proxy.play(FaultScenario("rst", 1, (Fault("rst"),))))
    (run,) = await measure(place.bench.session, place.store, place.bench.site, plan, options=MeasureOptions(control))
    shown = await asyncio.to_thread(CliRunner().invoke, app, ["show", "c", "--db", place.url])
    assert "incidents on the links to devices: 1" in shown.stdout
    assert re.search(rf"controller\s+DRV-002\s+1\s+recovered 1\s+run {run} test", shown.stdout)
    told = json.loads((await asyncio.to_thread(CliRunner().invoke, app, ["show", "c", "--db", place.url, "--json"])).stdout)
    assert [(one["code"], one["times"], one["ends"]) for one in told["incidents"]] == [("DRV-002", 1, {"recovered": 1})]
    assert [(one["number"], one["run_id"], one["test"], one["status"]) for one in told["runs"]] == [
        (run, "test", "ballbar_helix", "complete")
    ]


async def test_a_cable_that_is_pulled_is_noted_with_its_run_and_as_not_over(place: Place) -> None:
    session = place.bench.session
    plan = CampaignPlan("c", (small("Helix"),))

    def pull() -> None:
        place.pulled = asyncio.get_running_loop().create_task(place.bench.sim.unplug())

    control = AtStep(5, pull)
    with pytest.raises(LinkDown) as caught:
        await measure(session, place.store, place.bench.site, plan, options=MeasureOptions(control))
    (run,) = place.store.runs.all()
    assert caught.value.run == f"run {run.id} test"
    lines = [one for one in place.lines() if one["link"] == "ball-bar"]
    assert [one["phase"] for one in lines] == ["detected", "outcome"]
    assert {one["run"] for one in lines} == {f"run {run.id} test"}
    assert lines[-1]["state"] == "open"


async def test_a_locked_database_holds_up_no_link_and_no_end(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("abbe.service.sequences.watch.LAST_LINES_S", 0.2)
    store, session = place.store, place.bench.session
    campaign = store.campaigns.add(store.machines.add("m", {}), "c", {})
    notes = IncidentNotes(StoreJournal(store, campaign), SystemClock())
    links = links_of(session)
    assert set(links) == {"controller", "laser", "ball-bar"}
    locked = sqlite3.connect(place.url.removeprefix("sqlite:///"), isolation_level=None)
    locked.execute("BEGIN IMMEDIATE")
    loop = asyncio.get_running_loop()
    try:
        async with incidents_noted(session, notes):
            began_s = loop.time()
            for _ in range(2000):
                links["laser"].note(LinkDown("laser", "read", "gone"))
                links["laser"].good()
            assert loop.time() - began_s < 1.0
            ending_s = loop.time()
        assert loop.time() - ending_s < 2.0
    finally:
        locked.execute("ROLLBACK")
        locked.close()
    assert notes.not_written == 4000
    assert all(one.listen is None for one in links.values())


async def test_more_incidents_than_may_wait_are_counted_at_the_end_of_the_journal(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("abbe.service.sequences.watch.MOST_WAITING", 3)
    control = AtStep(3, lambda: [(link.note(LinkDown("laser", "read", "gone")), link.good()) for _ in range(5)])  # type: ignore[func-returns-value]
    link = links_of(place.bench.session)["laser"]
    await measure(place.bench.session, place.store, place.bench.site, CampaignPlan("c", (small("Helix"),)), options=MeasureOptions(control))
    assert control.state == State.ENDED
    assert len(place.lines()) == 3
    (ended,) = [one for one in place.store.checkpoints.of_campaign(place.store.campaigns.all()[-1].id) if one.kind == ENDED]
    assert ended.doc == {"how": "complete", "incidents_not_written": 7}
    (trouble,) = troubles(place.store.checkpoints.of_campaign(ended.campaign_id))
    assert (trouble.times, trouble.ends) == (2, {"recovered": 1, "no outcome": 1})
