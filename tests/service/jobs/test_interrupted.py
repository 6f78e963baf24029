"""The last campaign of a recipe, if it was interrupted."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path

import pytest

from abbe.service.domain.measured import this_process
from abbe.service.domain.service_records import AlarmFacts, AlarmKind
from abbe.service.jobs.interrupted import InterruptedCampaign, interrupted_campaign
from abbe.service.sequences.journal import BEGUN, ENDED
from abbe.service.storage.store import Store

MILL, RECIPE = "mill-7", "identification"
GONE = asdict(replace(this_process(), start="another boot/1"))


class Shop:
    """A store with campaigns of one machine."""

    def __init__(self, store: Store) -> None:
        self.store = store
        self.machine = store.machines.add(MILL, {})

    def campaign(self, name: str, recipe: str = RECIPE, *, how: str = "stopped", complete: int = 2, owner: dict | None = None) -> None:
        """``how``: how it ended, empty while it is measured; ``owner``: its process."""
        number = self.store.campaigns.add(self.machine, name, {})
        source = {"recipe": recipe, "rate_hz": 500} if recipe else {}
        doc = {"plan": "hash", "source": source, "boot_id": 1, "table_crc": 2, "owner": owner or asdict(this_process())}
        self.store.checkpoints.add(number, BEGUN, doc)
        for k in range(complete + 1):
            run = self.store.runs.start(number, f"r{k}", "laser_linear", "identify", {})
            self.store.runs.finish(run, "complete" if k < complete else "stopped", "", None)
        if how:
            self.store.checkpoints.add(number, ENDED, {"how": how})

    def found(self) -> InterruptedCampaign | None:
        return interrupted_campaign(self.store, MILL, RECIPE)


@pytest.fixture
def shop(tmp_path: Path) -> Iterator[Shop]:
    with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as store:
        yield Shop(store)


@pytest.mark.parametrize("how", ["stopped", "failed"])
def test_what_was_interrupted_is_found_behind_later_checks(shop: Shop, how: str) -> None:
    shop.campaign("noon", how=how)
    shop.campaign("a check", recipe="", how="complete")
    shop.campaign("another recipe", recipe="own.toml")
    found = shop.found()
    assert found is not None
    assert (found.name, found.rate_hz, found.complete, found.alarm) == ("noon", 500, 2, 0)


def test_the_last_campaign_counts_alone(shop: Shop) -> None:
    shop.campaign("morning")
    shop.campaign("noon", how="complete")
    assert shop.found() is None


def test_what_has_no_complete_run_begins_anew(shop: Shop) -> None:
    shop.campaign("noon", complete=0)
    assert shop.found() is None


@pytest.mark.parametrize(("owner", "interrupted"), [(None, False), (GONE, True)])
def test_a_campaign_without_an_end_is_interrupted_once_its_process_is_gone(shop: Shop, owner: dict | None, interrupted: bool) -> None:
    shop.campaign("noon", how="", owner=owner)
    assert (shop.found() is not None) == interrupted


def test_it_names_the_alarm_that_still_waits_for_it(shop: Shop) -> None:
    shop.campaign("alarm 1 of noon")
    append = shop.store.alarms.append
    append(MILL, None, 0, AlarmKind.RAISED, AlarmFacts(text="too far off", recipe="quick-check"))
    append(MILL, 1, 1, AlarmKind.BEGUN, AlarmFacts(campaign="alarm 1 of noon"))
    found = shop.found()
    assert found is not None
    assert found.alarm == 1
    append(MILL, 1, 2, AlarmKind.BEGUN, AlarmFacts(campaign="alarm 1 of evening"))
    found = shop.found()
    assert found is not None
    assert found.alarm == 0, "the alarm has another campaign by now"


def test_a_campaign_of_another_machine_is_none_of_ours(shop: Shop) -> None:
    shop.machine = shop.store.machines.add("mill-8", {})
    shop.campaign("noon")
    assert shop.found() is None
