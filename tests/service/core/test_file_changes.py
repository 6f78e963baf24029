"""A change of the machine file by the core: who may, when it is refused, that the audit has it first, and that the file is whole."""

from __future__ import annotations

import asyncio
import os
import stat
import threading
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from abbe.service.audit.book import AuditBook
from abbe.service.channel.messages import Answer, ChangeFile
from abbe.service.config import load_machine
from abbe.service.core import file_changes
from abbe.service.core.file_changes import CLOSED, FileChangeContext, FileChanges
from abbe.service.core.setup import MachineFileSource
from abbe.service.devices.session import lock_machine
from abbe.service.domain.machine_file import FileEdit
from abbe.service.domain.people import Permission
from abbe.service.domain.service_records import AuditEvent
from abbe.service.errors import ConfigError, StoreError
from abbe.service.storage.store import Store
from tests.service.test_machine_changes import TEXT

VALUE = FileEdit("limits.table_value_um", "70")
LOOSER = FileEdit("limits.table_value_um", "90")
NIGHT = (FileEdit("schedule[1].name", '"night"'), FileEdit("schedule[1].cron", '"* * * * *"'))


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
    cnc: str | None = None
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

        context = FileChangeContext(
            may, self.audit, lambda: self.claim if self.takes_jobs else None, push_open, self.begun.append, self.cnc
        )
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
        ((FileEdit("item.serial", "[" * 3900),), "user:both", "conflict", "item.serial has no value that can be read"),
        ((FileEdit("item.serial", '"\\ud83d"'),), "user:both", "conflict", "item.serial has no value that can be read"),
        (NIGHT, "user:adam", "conflict", "this allows more than before: schedule[night].name – → night. Tick"),
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


@pytest.mark.parametrize(
    ("before", "after", "key"),
    [
        ("X = [0, 600]", "X = [0, 900]", "stroke_mm.X"),
        ("[limits]", "[web]\nport = 9000\n[limits]", "web.port"),
        ("[limits]", '[alarm]\npush = "approved"\n[limits]', "alarm.push"),
        ("[limits]", '[mqtt]\nurl = "mqtt://u:p@broker:1883"\n[limits]', "mqtt.url"),
        ('name = "mill"', 'name = "lathe"', "name"),
    ],
)
async def test_only_a_start_takes_over_by_hand_what_the_page_does_not_change(bench: Bench, before: str, after: str, key: str) -> None:
    mine = TEXT.replace(before, after)
    bench.file.write_text(mine)
    answer = await bench.ask(looser=True, reason="because")
    assert (answer.outcome, answer.text) == ("forbidden", CLOSED.format(key=key))
    assert (bench.file.read_text(), bench.begun, bench.claim.name, bench.recorded()) == (mine, [], "", [])


async def test_a_limit_changed_by_hand_needs_the_right_for_limits(bench: Bench) -> None:
    bench.file.write_text(TEXT.replace("80.0", "900"))
    answer = await bench.ask(who="user:adam", looser=True, reason="because")
    assert (answer.outcome, answer.text, bench.begun) == ("forbidden", "user:adam may not approve here", [])
    bench.file.write_text(TEXT + '[item]\nserial = "7"\n')
    assert (await bench.ask(who="user:adam")).outcome == "done"


async def test_a_second_person_is_kept_on_the_page_and_asked_for_on_it(bench: Bench) -> None:
    bench.file.write_text(TEXT.replace("[limits]", "[limits]\ntwo_people = true"))
    bench.loaded = load_machine(bench.file)
    for value in ("false", "null"):
        answer = await bench.ask(FileEdit("limits.two_people", value), looser=True, reason="she is on holiday")
        assert (answer.outcome, "switched off only in the file" in answer.text) == ("conflict", True)
    assert bench.begun == []
    bench.file.write_text(TEXT)
    bench.loaded = load_machine(bench.file)
    assert (await bench.ask(FileEdit("limits.two_people", "true"))).outcome == "done"


async def test_nothing_is_changed_while_a_command_measures(bench: Bench) -> None:
    bench.cnc = "tcp://127.0.0.1:5020"
    with lock_machine(bench.cnc):
        answer = await bench.ask(VALUE)
    assert (answer.outcome, "is in use by process" in answer.text) == ("busy", True)
    untouched(bench)
    assert (await bench.ask(VALUE)).outcome == "done"


@pytest.mark.parametrize("fails", [False, True])
async def test_a_change_that_nobody_waits_for_any_more_is_brought_to_its_end(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, *, fails: bool
) -> None:
    """The process of the page dies while the file is being written: the service has the changed file, or all is as before."""
    begun, go_on, real = threading.Event(), threading.Event(), file_changes.replace_file

    def slow(path: Path, body: bytes) -> None:
        begun.set()
        assert go_on.wait(60)
        if fails:
            raise OSError(28, os.strerror(28))
        real(path, body)

    monkeypatch.setattr(file_changes, "replace_file", slow)
    asked = asyncio.create_task(bench.ask(VALUE))
    assert await asyncio.to_thread(begun.wait, 60)
    asked.cancel()
    with suppress(asyncio.CancelledError):
        await asked
    held, rest = bench.claim.name, asyncio.all_tasks() - {asyncio.current_task()}
    go_on.set()
    assert held, "the thread still writes"
    await asyncio.wait(rest, timeout=60)
    assert (len(bench.begun), bool(bench.claim.name), bench.file.read_text() != TEXT) == (not fails, not fails, not fails)


async def test_a_folder_that_cannot_be_flushed_is_no_failed_change(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    real = os.fsync

    def no_folders(descriptor: int) -> None:
        if stat.S_ISDIR(os.fstat(descriptor).st_mode):
            raise OSError(22, os.strerror(22))
        real(descriptor)

    monkeypatch.setattr(os, "fsync", no_folders)
    assert (await bench.ask(VALUE)).outcome == "done"
    assert (len(bench.begun), bench.recorded()[-1][2]) == (1, "done")


async def test_a_link_laid_where_the_new_file_is_written_leads_nowhere(bench: Bench) -> None:
    other = bench.file.with_name("other")
    other.write_text("kept")
    bench.file.with_name(".machine.toml.new").symlink_to(other)
    assert (await bench.ask(VALUE)).outcome == "done"
    assert (other.read_text(), bench.file.is_symlink()) == ("kept", False)


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
