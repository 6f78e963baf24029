"""Carries out changes of the machine file that a person makes on the page, and has the service start anew with the changed file.

Rights are decided here. Nothing is changed while the machine is used, behind the back of an editor, or before the audit has the record. The
file is judged by what judges it at a start, `abbe serve`'s own setup.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, replace
from pathlib import Path

import structlog

from abbe.service.audit.book import AuditBook
from abbe.service.channel.messages import Answer, ChangeFile, Outcome
from abbe.service.config import LoadedMachine, load_machine
from abbe.service.core.jobs import MachineClaim
from abbe.service.core.setup import MachineFileSource, ServiceSetup
from abbe.service.domain.audit_event import AuditEvent
from abbe.service.errors import AbbeError, ConfigError
from abbe.service.files import replace_file
from abbe.service.machine_changes import RIGHTS, Change, changed, differences, section_of
from abbe.service.users.roles import Permission

log = structlog.get_logger("abbe.file")
ACTION = "machine file"
NEEDS_START = ("web", "store")
"""Sections whose change needs a start of the service by its computer: this process keeps its address and its database."""
LONGEST_TARGET = 400


@dataclass(frozen=True, slots=True)
class FileChangeContext:
    """What a change needs to know. ``may(who, need)``: rights; ``claim``: claim on the machine, None: no jobs now; ``push_open``: whether a
    push is unfinished; ``restart``: starts the service anew with a setup."""

    may: Callable[[str, Permission], Awaitable[bool]]
    audit: AuditBook
    claim: Callable[[], MachineClaim | None]
    push_open: Callable[[], Awaitable[bool]]
    restart: Callable[[ServiceSetup], None]


class _Refusal(Exception):  # noqa: N818 - an answer, not an error
    """A refusal with its outcome and its text."""

    def __init__(self, outcome: Outcome, text: str) -> None:
        super().__init__(text)
        self.outcome: Outcome = outcome


class FileChanges:
    """Takes changes of the machine file."""

    def __init__(self, source: MachineFileSource, context: FileChangeContext) -> None:
        self._source, self._context = source, context

    async def change(self, asked: ChangeFile) -> Answer:
        """Change the file; a person's answer says why not. After "done" the service starts anew."""
        try:
            await self._check_rights(asked)
            claim = self._context.claim()
            if claim is None:
                raise _Refusal("busy", "the service takes no jobs now: it is starting, ending, or running its timetable once")
            if other := claim.take(ACTION):
                raise _Refusal("busy", f"the machine is in use: {other}")
            try:
                if await self._context.push_open():
                    raise _Refusal("conflict", "a push is not finished: the limits stay as they are until it is")
                setup = await asyncio.to_thread(self._changed, asked)
            except BaseException:
                claim.give_back()
                raise
        except _Refusal as no:
            return _answer(asked, no.outcome, str(no))
        except AbbeError as error:
            return _answer(asked, "conflict", error.detail.removeprefix(f"{self._source.loaded.path}: "))
        self._context.restart(setup)  # the claim stays taken: nothing begins with the old values
        return _answer(asked, "done", "")

    async def _check_rights(self, asked: ChangeFile) -> None:
        sections = {section_of(edit.key) for edit in asked.edits}
        if closed := sorted(sections - set(RIGHTS)):
            raise _Refusal("forbidden", f"[{closed[0]}] cannot be changed on the page")
        for need in sorted({RIGHTS[one] for one in sections} or {Permission.CONFIGURE}):
            if not await self._context.may(asked.who, need):
                raise _Refusal("forbidden", f"{asked.who} may not {need} here")

    def _changed(self, asked: ChangeFile) -> ServiceSetup:
        """Write the file with its record in the audit; return the setup that it makes."""
        old = self._source.loaded
        now = load_machine(old.path)
        if asked.sha256 != old.sha256 or (asked.edits and now.body != old.body):
            raise _Refusal(
                "conflict", "the machine file has changed since the service read it: have it read again, then look at the values"
            )
        new = changed(now, asked.edits)
        found = differences(old, new)
        _check(asked, old, new, found)
        setup = self._source.prepare(new)
        begun = _event(asked, old, new, found)
        self._context.audit.write(begun)
        if asked.edits:
            try:
                replace_file(old.path, new.body)
            except OSError as err:
                self._context.audit.write(replace(begun, outcome="failed"))
                raise ConfigError(
                    f"the service may not write {old.path}: {err.strerror}", "give it the right to write this folder"
                ) from None
        try:
            self._context.audit.write(replace(begun, outcome="done"))
        except AbbeError as error:  # the file is changed and the first record says so: the service must not go on with the old values
            log.error("audit record failed", cause=error.detail)
        log.warning("machine file changed", who=asked.who, changes=[str(one) for one in found])
        return setup


def _check(asked: ChangeFile, old: LoadedMachine, new: LoadedMachine, found: tuple[Change, ...]) -> None:
    if not found and (asked.edits or old.body == new.body):
        raise _Refusal("conflict", "nothing is different from the file in force")
    if fixed := next((one.key for one in found if section_of(one.key) in NEEDS_START), ""):
        raise _Refusal("conflict", f"{fixed} is different in the file: only a start of the service by its computer takes it over")
    looser = [str(one) for one in found if one.looser]
    if looser and not (asked.looser and asked.reason.strip()):
        raise _Refusal("conflict", f"this allows more than before: {', '.join(looser)}. Tick that you mean it, and give the reason")


def _event(asked: ChangeFile, old: LoadedMachine, new: LoadedMachine, found: tuple[Change, ...]) -> AuditEvent:
    target = ", ".join(str(one) for one in found) or Path(old.path).name
    doc = {
        "reason": asked.reason,
        "changes": [{"key": one.key, "old": one.old, "new": one.new, "looser": one.looser} for one in found],
        "file": str(old.path.resolve()),
        "sha256_before": old.sha256,
        "sha256": new.sha256,
    }
    return AuditEvent(who=asked.who, action=ACTION, target=target[:LONGEST_TARGET], outcome="begun", doc=doc)


def _answer(asked: ChangeFile, outcome: Outcome, text: str) -> Answer:
    return Answer("answer", asked.request, outcome, text[:4000], "")
