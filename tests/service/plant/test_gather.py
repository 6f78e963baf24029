"""PlantFacts are what the page, the slots and the journal of pushes say; and a picture of them shows nothing that is not known."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from abbe.service.core.board import Board
from abbe.service.domain.push_entry import PushEntry, PushState
from abbe.service.plant.gather import UNITS, Gatherer, table_in_force
from abbe.service.plant.opcua.space import picture_of
from abbe.service.queries.reader import Reader
from abbe.service.queries.status import StatusReader
from abbe.service.storage.store import Store
from tests.service.core.fakes import STEP, FakeClock
from tests.service.plant.facts_for_tests import NOON, facts

SNAPSHOT = {"base_bank": 0, "base_crc": 11, "base_image": "00", "target": 1, "crc": 22}


def journal(*states: str, **last: Any) -> list[PushEntry]:
    docs = [SNAPSHOT if state == "SNAPSHOT" else {} for state in states]
    docs[-1] = docs[-1] | last
    return [
        PushEntry(
            number=k,
            machine="mill-7",
            push=3,
            seq=k,
            state=PushState(state),
            doc=doc,
            utc="2026-06-01T12:00:00.000000Z",
            prev="",
            digest="",
        )
        for k, (state, doc) in enumerate(zip(states, docs, strict=True))
    ]


@pytest.mark.parametrize(
    ("states", "last", "expected"),
    [
        (("SNAPSHOT",), {}, (0, 11)),
        (("SNAPSHOT", "REJECTED"), {}, (0, 11)),
        (("SNAPSHOT", "VALIDATED", "APPROVED", "LEASED", "STAGING", "STAGED"), {}, (0, 11)),
        (("SNAPSHOT", "VALIDATED", "ABORTED"), {}, (0, 11)),
        (("SNAPSHOT", "ACTIVATING"), {}, None),
        (("SNAPSHOT", "ACTIVATING", "PROBATION", "PROBED", "VERIFIED"), {}, None),
        (("SNAPSHOT", "ACTIVATING", "PROBATION", "PROBED", "VERIFIED", "KEEP"), {}, (1, 22)),
        (("SNAPSHOT", "ACTIVATING", "ROLLBACK"), {}, None),
        (("SNAPSHOT", "ACTIVATING", "ROLLBACK", "ROLLED_BACK"), {"bank": 0}, (0, 11)),
        (("SNAPSHOT", "ACTIVATING", "OPERATOR"), {}, None),
        (("SNAPSHOT", "ACTIVATING", "OPERATOR", "ACCEPTED"), {"accepted_bank": 1, "accepted_crc": 99}, (1, 99)),
        (("SNAPSHOT", "ACTIVATING", "OPERATOR", "ACCEPTED"), {}, None),
    ],
)
def test_the_table_in_force_as_far_as_the_journal_knows(states: tuple[str, ...], last: dict[str, Any], expected: object) -> None:
    found = table_in_force(journal(*states, **last))
    assert (None if found is None else (found.bank, found.crc)) == expected
    assert found is None or found.push == 3


def test_no_push_no_table() -> None:
    assert table_in_force([]) is None


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as opened:
        yield opened


async def test_facts_of_a_real_store(store: Store) -> None:
    clock = FakeClock(NOON)
    board = Board({"laser": "modbus+tcp://127.0.0.1:502"}, clock)
    view = StatusReader(Reader(store, "mill-7", clock), "0.1.0", board, lambda: [], "")
    gatherer = Gatherer(view.status, store)
    empty = await gatherer.facts()
    assert (empty.state, empty.checks, empty.alarms, empty.table) == ("idle", (), (), None)

    machine = store.machines.add("mill-7", {})
    cause = {"code": "DRV-002", "what": "refused", "remedy": "", "device": "laser"}
    doc = {"verdict": "cannot tell", "campaign": "", "started_utc": "2026-06-01T10:00:00+00:00", "text": "t", "cause": cause}
    store.verifications.add_with_messages(machine, doc, [])
    figures = {"values": {"body_diagonal_um": 11.8}, "uncertainties": {"body_diagonal_um": 1.1}, "limits": {"body_diagonal_um": 20.0}}
    store.verifications.add_with_messages(machine, doc | {"verdict": "pass", "cause": None} | figures, [])
    for schedule in ("mill-7/weekly", "mill-77/weekly", "mill_7/weekly"):
        store.slots.claim(schedule, NOON)
        store.slots.finish(schedule, NOON, "missed: 3 days late", f"{schedule} was missed")
    store.slots.claim("mill-7/daily", NOON)
    store.slots.finish("mill-7/daily", NOON, "done: pass", "")
    for entry in journal("SNAPSHOT"):
        store.pushes.append(entry)
    board.job_progress(STEP)
    board.changes += 1
    known = await gatherer.facts()
    assert [(one.id, one.verdict) for one in known.checks] == [(2, "pass"), (1, "cannot tell")]
    (figure,) = known.checks[0].figures
    assert (figure.name, figure.value, figure.expanded, figure.limit) == ("body_diagonal_um", 11.8, 1.1, 20.0)
    assert sorted((alarm.code, alarm.text) for alarm in known.alarms) == [("DRV-002", "refused"), ("SCH-001", "mill-7/weekly was missed")]
    assert known.table is not None
    assert (known.table.bank, known.table.crc) == (0, 11)


def test_a_picture_shows_nothing_that_is_not_known() -> None:
    known = picture_of(facts())
    assert known["LastResult/Figures/body_diagonal_um"].value == 11.8
    assert known["CompensationTable/Crc32"].value == "0000beef"
    assert known["Devices/cnc/Text"].value == "refused by peer"
    nothing = picture_of(facts(checks=(), alarms=(), devices=(), table=None, next_utc=None))
    assert nothing["CompensationTable/Known"].value is False
    assert {path for path, leaf in nothing.items() if leaf.value is not None} == {
        "State", "Version", "Check/Active", "Results/Numbers", "Results/Verdicts", "Results/Started", "Results/Figures", "Alarms/Count",
        "Alarms/Codes", "Alarms/Texts", "Alarms/Devices", "Alarms/Times", "CompensationTable/Known",
    }  # fmt: skip


def test_units_have_the_numbers_of_opc_ua() -> None:
    """From UNECE_to_OPCUA.csv of the OPC Foundation: these are the published ones."""
    published = {"um": 13384, "mm": 5066068, "s": 5457219, "c": 4408652, "percent": 20529}
    assert {key: UNITS[key].number for key in published} == published


async def test_a_table_of_slots_is_not_read_every_second(store: Store) -> None:
    clock = FakeClock(NOON)
    board = Board({}, clock)
    asked = [0]

    class Counted:
        def not_run(self, machine: str, limit: int = 20, /) -> list[Any]:
            asked[0] += 1
            return []

        def last(self, machine: str, control: str = "", /) -> list[Any]:
            return []

    gatherer = Gatherer(
        StatusReader(Reader(store, "mill-7", clock), "0.1.0", board, lambda: [], "").status,
        SimpleNamespace(slots=Counted(), pushes=Counted()),
    )
    for _ in range(59):
        await gatherer.facts()
        clock.now_s += 1.0
    assert asked == [1]
    board.changes += 1
    await gatherer.facts()
    assert asked == [2]
