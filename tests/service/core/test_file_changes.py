"""A change of the machine file by the core: who may, when it is refused, that the audit has it first, and that the file is whole."""

from __future__ import annotations

import asyncio
import os
import stat
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from abbe.service.audit.book import AuditBook
from abbe.service.channel.messages import Answer, ChangeFile
from abbe.service.config import load_machine
from abbe.service.core import file_changes
from abbe.service.core.file_changes import FileChangeContext, FileChanges
from abbe.service.core.setup import MachineFileSource
from abbe.service.domain.audit_event import AuditEvent
from abbe.service.domain.machine_file import FileEdit
from abbe.service.errors import ConfigError, StoreError
from abbe.service.storage.store import Store
from abbe.service.users.roles import Permission
from tests.service.test_machine_changes import TEXT

VALUE = FileEdit("limits.table_value_um", "70")
LOOSER = FileEdit("limits.table_value_um", "90")


@dataclass
class Claimed:
    """A claim on the machine."""

    name: str = ""

    def take(self, name: str) -> str:
        other, self.name = self.name, self.name or name
        return other

    def give_back(self) -> None:
        self.name = ""


@dataclass
class Bench:
    """A real file, store and audit; what would start anew is only noted."""

    file: Path
    store: Store
    claim: Claimed = field(default_factory=Claimed)
    takes_jobs: bool = True
    pushing: bool = False
    bad: str = ""
    begun: list[Any] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.loaded = load_machine(self.file)
        self.audit = AuditBook(self.store, self.store.url)

    async def ask(self, *edits: FileEdit, who: str = "user:both", sha256: str = "", reason: str = "", looser: bool = False) -> Answer:
        async def may(name: str, need: Permission) -> bool:
            return name == "user:both" or {"user:anna": Permission.APPROVE, "user:adam": Permission.CONFIGURE}.get(name) is need

        async def push_open() -> bool:
            return self.pushing

        def prepare(loaded: object) -> Any:
            if self.bad:
                raise ConfigError(self.bad)
            return loaded

        context = FileChangeContext(may, self.audit, lambda: self.claim if self.takes_jobs else None, push_open, self.begun.append)
        asked = ChangeFile(request=5, who=who, sha256=sha256 or self.loaded.sha256, edits=edits, reason=reason, looser=looser)
        answer = await FileChanges(MachineFileSource(self.loaded, prepare), context).change(asked)
        assert answer.request == 5
        return answer

    def recorded(self) -> list[tuple[str, str, str]]:
        return [(one.who, one.target, one.outcome) for one in self.store.audit.events()]


@pytest.fixture
def bench(tmp_path: Path) -> Any:
    file = tmp_path / "machine.toml"
    file.write_text(TEXT)
    with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as store:
        yield Bench(file, store)


async def test_a_change_is_recorded_then_written_then_the_service_starts_anew(bench: Bench) -> None:
    bench.file.chmod(0o640)
    answer = await bench.ask(LOOSER, reason="new scales", looser=True)
    assert (answer.outcome, bench.file.read_text()) == ("done", TEXT.replace("80.0", "90"))
    assert stat.S_IMODE(bench.file.stat().st_mode) == 0o640
    assert bench.recorded() == [("user:both", "limits.table_value_um 80.0 → 90.0", word) for word in ("begun", "done")]
    doc = bench.store.audit.events()[-1].doc
    assert doc["changes"] == [{"key": "limits.table_value_um", "old": 80.0, "new": 90.0, "looser": True}]
    assert (doc["reason"], doc["sha256_before"], doc["sha256"]) == ("new scales", bench.loaded.sha256, load_machine(bench.file).sha256)
    assert [one.machine.limits.table_value_um for one in bench.begun] == [90.0]
    assert bench.claim.name, "nothing begins with the old values"
    assert [one.name for one in bench.file.parent.iterdir() if one.name.endswith(".new")] == []


@pytest.mark.parametrize(
    ("edits", "who", "outcome", "text"),
    [
        ((VALUE,), "user:adam", "forbidden", "may not approve"),
        ((FileEdit("item.serial", '"1"'),), "user:anna", "forbidden", "may not configure"),
        ((FileEdit("item.serial", '"1"'), VALUE), "user:adam", "forbidden", "may not approve"),
        ((), "user:anna", "forbidden", "may not configure"),
        ((FileEdit("web.host", '"0.0.0.0"'),), "user:both", "forbidden", "[web] cannot be changed"),
        ((FileEdit("signatures.trusted", "[]"),), "user:both", "forbidden", "[signatures] cannot"),
        ((LOOSER,), "user:both", "conflict", "this allows more than before: limits.table_value_um 80.0 → 90.0"),
        ((FileEdit("limits.table_value_um", "80"),), "user:both", "conflict", "nothing is different"),
        ((FileEdit("limits.table_value_um", "-3"),), "user:both", "conflict", "limits.table_value_um: expected"),
    ],
)
async def test_what_may_not_be_is_refused(bench: Bench, edits: tuple[FileEdit, ...], who: str, outcome: str, text: str) -> None:
    answer = await bench.ask(*edits, who=who)
    assert (answer.outcome, text in answer.text) == (outcome, True), answer.text
    untouched(bench)


def untouched(bench: Bench, claim: str = "") -> None:
    assert (bench.file.read_text(), bench.begun, bench.claim.name, bench.recorded()) == (TEXT, [], claim, [])


async def test_a_tick_without_a_reason_loosens_nothing(bench: Bench) -> None:
    assert (await bench.ask(LOOSER, looser=True, reason="  ")).outcome == "conflict"
    assert (await bench.ask(LOOSER, reason="because")).outcome == "conflict"
    untouched(bench)


async def test_nothing_is_changed_while_the_machine_is_used(bench: Bench) -> None:
    bench.claim.name = "weekly"
    answer = await bench.ask(VALUE)
    assert (answer.outcome, "weekly" in answer.text) == ("busy", True)
    untouched(bench, "weekly")
    bench.claim.name, bench.pushing = "", True
    assert "push is not finished" in (await bench.ask(VALUE)).text
    bench.pushing, bench.takes_jobs = False, False
    assert (await bench.ask(VALUE)).outcome == "busy"
    untouched(bench)


async def test_what_the_start_would_refuse_is_refused_now(bench: Bench) -> None:
    bench.bad = "there is no recipe 'quick-chekc'"
    assert (await bench.ask(VALUE)).text == bench.bad
    untouched(bench)


async def test_an_editor_is_not_overwritten_and_his_work_is_taken_over(bench: Bench) -> None:
    mine = TEXT + '\n[item]\nserial = "7"\n'
    bench.file.write_text(mine)
    assert "has changed since" in (await bench.ask(VALUE)).text
    assert "has changed since" in (await bench.ask(VALUE, sha256="0" * 64)).text
    assert (bench.file.read_text(), bench.begun) == (mine, [])
    assert (await bench.ask()).outcome == "done"
    assert (bench.file.read_text(), bench.begun[0].machine.item.serial) == (mine, "7")
    assert bench.recorded()[-1] == ("user:both", "item.serial – → 7", "done")


async def test_an_address_taken_over_by_hand_needs_a_start_by_the_computer(bench: Bench) -> None:
    bench.file.write_text(TEXT + "[web]\nport = 9000\n")
    assert "web.port" in (await bench.ask()).text
    assert bench.begun == []


async def test_without_the_audit_nothing_is_written(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(_event: object) -> None:
        raise StoreError("the disk is full")

    monkeypatch.setattr(bench.audit, "write", broken)
    assert (await bench.ask(VALUE)).text == "the disk is full"
    untouched(bench)


async def test_a_changed_file_is_taken_over_even_if_its_second_record_fails(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    write = bench.audit.write

    def once(event: AuditEvent) -> AuditEvent:
        if event.outcome == "done":
            raise StoreError("the disk is full")
        return write(event)

    monkeypatch.setattr(bench.audit, "write", once)
    assert (await bench.ask(VALUE)).outcome == "done"
    assert [one.machine.limits.table_value_um for one in bench.begun] == [70.0]
    assert [word for *_, word in bench.recorded()] == ["begun"]


async def test_a_link_to_the_file_stays_a_link(bench: Bench) -> None:
    target = bench.file.rename(bench.file.with_name("mill-7.toml"))
    bench.file.symlink_to(target)
    assert (await bench.ask(VALUE)).outcome == "done"
    assert (bench.file.is_symlink(), target.read_text()) == (True, TEXT.replace("80.0", "70"))


async def test_a_folder_that_may_not_be_written_is_named(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    def denied(path: Path, body: bytes) -> None:
        raise OSError(30, os.strerror(30))

    monkeypatch.setattr(file_changes, "replace_file", denied)
    answer = await bench.ask(VALUE)
    assert (answer.outcome, str(bench.file) in answer.text, "Read-only" in answer.text) == ("conflict", True, True)
    assert (bench.file.read_text(), bench.begun, bench.claim.name) == (TEXT, [], "")
    assert [word for *_, word in bench.recorded()] == ["begun", "failed"]


async def test_of_two_at_once_one_is_taken(bench: Bench) -> None:
    answers = await asyncio.gather(bench.ask(VALUE), bench.ask(VALUE))
    assert sorted(one.outcome for one in answers) == ["busy", "done"]
    assert len(bench.begun) == 1
