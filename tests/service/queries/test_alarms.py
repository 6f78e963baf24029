"""The way from an alarm to a report follows from the store alone, step by step, and can be taken up again at any of them."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from abbe.service.clock import SystemClock
from abbe.service.compensation.proposal_decisions import approve
from abbe.service.domain.service_records import AlarmFacts, AlarmKind
from abbe.service.queries.alarms import PathStep, path_of_alarm, path_with
from abbe.service.queries.reader import Reader
from abbe.service.storage.store import Store
from abbe.service.verification.alarms import acknowledge
from abbe.service.web.page import step_address
from tests.pages_world import Filled, filled_once
from tests.pretended_push import KEPT, as_if_pushed


@pytest.fixture
def filled(tmp_path_factory: pytest.TempPathFactory) -> Filled:
    return filled_once(tmp_path_factory)


@pytest.fixture
def reader(filled: Filled) -> Iterator[Reader]:
    with Store.open(filled.url) as store:
        yield Reader(store, filled.machine, SystemClock())


def states(reader: Reader, number: int) -> dict[str, str]:
    way = path_of_alarm(reader, number)
    assert way is not None
    return {step.key: step.state for step in way.steps}


def to_do(reader: Reader, number: int) -> str:
    """Where the one button of the way leads."""
    way = path_of_alarm(reader, number)
    assert way is not None
    return "" if way.now is None else step_address(way.now, to_do_for=way.alarm)


def begins(reader: Reader, number: int) -> str:
    """What a search for the cause does first, were it ordered now."""
    way = path_of_alarm(reader, number)
    assert way is not None
    return way.begins


def test_a_search_begins_after_the_lines_of_its_alarm(reader: Reader, filled: Filled) -> None:
    store = reader.store
    first = next(e for e in store.alarms.entries(filled.machine) if e.kind == "raised")
    number = store.alarms.append(filled.machine, None, 0, AlarmKind.RAISED, first.facts).alarm
    seen = [begins(reader, number)]
    for seq, kind in enumerate((AlarmKind.MEASURED, AlarmKind.FAILED, AlarmKind.FAILED, AlarmKind.DISCOVERED, AlarmKind.ENDED), start=1):
        store.alarms.append(filled.machine, number, seq, kind, AlarmFacts(campaign="c"))
        seen.append(begins(reader, number))
    assert seen == ["measured", "discovered", "discovered", "discovered", "proposed", "measured"]


async def test_from_the_alarm_to_the_report(reader: Reader, filled: Filled) -> None:
    store, proposal = reader.store, filled.proposals[2]
    assert to_do(reader, 2) == "/alarm?id=2"
    acknowledge(store, filled.machine, 2, "olga")
    assert to_do(reader, 2) == f"/proposal?id={proposal}"
    approve(store, proposal, "anna", 1.0, SystemClock(), "user:anna")
    assert states(reader, 2) | {"push": "now", "approval": "done"} == states(reader, 2)
    await as_if_pushed(store, SystemClock(), filled.machine, {"proposal": proposal}, (b"June", b"July"), KEPT)
    assert states(reader, 2) | {"push": "done", "proof": "now"} == states(reader, 2)
    assert to_do(reader, 2) == "/new?recipe=quick-check&rate_hz=100"
    store.alarms.append(filled.machine, 2, 3, AlarmKind.CLEARED, AlarmFacts(verification=20, text="pass", recipe="quick-check"))
    assert to_do(reader, 2) == "/api/v1/reports/verification/20"
    for key, number in (("check", 24), ("proposal", proposal), ("proof", 20)):
        found = path_with(reader, key, number)  # type: ignore[arg-type]
        assert found is not None
        assert found.alarm == 2
    assert path_with(reader, "check", 1) is None


def test_a_step_is_measured_at_the_rate_of_the_alarm_s_own_recipe() -> None:
    step = PathStep(key="proof", state="now", recipe="quick-check at 20 Hz")
    assert step_address(step, to_do_for=2) == "/new?recipe=quick-check&rate_hz=20", "a check at another rate would not end the alarm"


def test_without_a_proposal_the_cause_is_to_be_measured_or_nothing_is_needed(reader: Reader, filled: Filled) -> None:
    store = reader.store
    first = next(e for e in store.alarms.entries(filled.machine) if e.kind == "raised")
    number = store.alarms.append(filled.machine, None, 0, AlarmKind.RAISED, first.facts).alarm
    acknowledge(store, filled.machine, number, "olga")
    assert to_do(reader, number) == f"/new?recipe=identification&alarm={number}"
    store.alarms.append(filled.machine, number, 2, AlarmKind.ENDED, AlarmFacts(text="no proposal: nothing is known"))
    assert states(reader, number) | {"cause": "failed", "approval": "waiting"} == states(reader, number)
    assert to_do(reader, number) == ""
    proposal = store.proposals.get(filled.proposals[2])
    store.proposals.add(proposal.machine, proposal.solution_id, proposal.doc, proposal.digest)
    assert states(reader, number)["cause"] == "skipped", "somebody has proposed since: nobody searched"
    store.alarms.append(filled.machine, number, 3, AlarmKind.ORDERED, AlarmFacts(name="petra"))
    assert states(reader, number) | {"cause": "now", "proposal": "waiting"} == states(reader, number), (
        "a proposal of before is none of this search"
    )
    assert to_do(reader, number) == f"/new?recipe=identification&alarm={number}"
    assert begins(reader, number) == "measured"
    store.alarms.append(filled.machine, number, 4, AlarmKind.CLEARED, AlarmFacts(verification=20, text="pass"))
    assert states(reader, number) | {"approval": "skipped", "push": "skipped", "proof": "done"} == states(reader, number)
