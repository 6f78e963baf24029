"""Everything that opens the devices finishes an interrupted push and looks at the table in force first: no door can be forgotten."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import abbe.service
from abbe.drivers.errors import LinkDown
from abbe.service.compensation import recover
from abbe.service.devices import session
from abbe.service.domain.machine import DeviceUrls
from abbe.service.errors import TableMismatch
from abbe.service.site import Site
from tests.faults.sequencer_world import MACHINE

ROOT = Path(abbe.service.__file__).parent
ONLY_LOOKS = {
    ("scheduler/ready.py", "look_at"): "reads the status",
    ("core/table_watch.py", "look_at_table"): "reads which table is in force",
    ("cli/tables/comp_push.py", "accept_table"): "a person vouches",
    ("compensation/rollback.py", "ordered_rollback"): "goes through `rollback`, which recovers",
    ("demo/demo.py", "run_demo"): "a control of its own, begun with this database",
    ("demo/demo_serve.py", "run_served_demo"): "the same",
    ("demo/demo_hidden.py", "run_hidden_demo"): "the same",
    ("demo/demo_artefact.py", "run_artefact_demo"): "the same",
}


HELPER = ("compensation/recover.py", "recovered_session")


def doors() -> dict[tuple[str, str], set[str]]:
    """Every function of the service that opens the devices, and the names that it calls."""
    found = {}
    for path in sorted(ROOT.rglob("*.py")):
        text = path.read_text()
        if "open_session" not in text and "recovered_session" not in text:
            continue
        for node in ast.parse(text).body:
            called = {n.func.id for n in ast.walk(node) if isinstance(n, ast.Call) and isinstance(n.func, ast.Name)}
            if {"open_session", "recovered_session"} & called and isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                found[str(path.relative_to(ROOT)), node.name] = called
    return found


def test_every_door_goes_through_the_one_helper() -> None:
    by_itself = {door for door, called in doors().items() if "open_session" in called}
    assert by_itself == {*ONLY_LOOKS, HELPER}
    assert len(doors()) > 10


DEVICES = ("controller", "ballbar", "laser", "fixture")


@pytest.fixture
def said(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What is done with the devices, in order. The laser is missing."""
    done: list[str] = []

    class Device:
        def __init__(self, role: str) -> None:
            self.role = role

        async def close(self) -> None:
            done.append(f"close {self.role}")

    for role in DEVICES:

        async def opens(url: str, *_: object, role: str = role) -> Device:
            done.append(f"open {role}")
            if role == "laser":
                raise LinkDown(url, "open", "nothing is there")
            return Device(role)

        monkeypatch.setattr(session.registry, f"open_{role}", opens)
    return done


async def opened(monkeypatch: pytest.MonkeyPatch, done: list[str], error: Exception | None = None) -> None:
    """Goes through the helper with a `recover` that is only noted, or raises."""

    async def recovers(controller: object, *_: object, accept_by: str) -> str:
        done.append(f"recover for {accept_by}")
        if error is not None:
            raise error
        return "taken back"

    monkeypatch.setattr(recover, "recover", recovers)
    urls = DeviceUrls("cnc", "ballbar", "laser", "fixture")
    site = Site("m", MACHINE, {}, urls)
    async with recover.recovered_session(None, site, accept_by="ann", report=done.append):  # type: ignore[arg-type]
        done.append("in use")


async def test_what_is_left_is_taken_back_and_told_before_any_instrument_is_opened(
    monkeypatch: pytest.MonkeyPatch, said: list[str]
) -> None:
    with pytest.raises(LinkDown):
        await opened(monkeypatch, said)
    opening, closing = said[:6], said[6:]
    assert opening == ["open controller", "recover for ann", "taken back", "open ballbar", "open laser", "open fixture"]
    assert closing == ["close fixture", "close ballbar", "close controller"]


async def test_no_instrument_is_opened_where_a_person_has_to_look(monkeypatch: pytest.MonkeyPatch, said: list[str]) -> None:
    with pytest.raises(TableMismatch):
        await opened(monkeypatch, said, TableMismatch("a strange table", "look"))
    assert said == ["open controller", "recover for ann", "close controller"]
