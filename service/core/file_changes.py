"""Carries out changes of the machine file that a person makes on the page, and has the service start anew with the changed file.

Rights are decided here. A change is refused while the machine is used, or if somebody has edited the file meanwhile, and it is recorded in
the audit before it is made. The setup of `abbe serve` judges the changed file, as at every start.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import structlog

from abbe.service.audit.book import AuditBook
from abbe.service.channel.messages import Answer, ChangeFile, Outcome
from abbe.service.config import LoadedMachine, load_machine
from abbe.service.core.jobs import MachineClaim
from abbe.service.core.setup import MachineFileSource, ServiceSetup
from abbe.service.devices.session import lock_machine
from abbe.service.domain.people import Permission
from abbe.service.domain.service_records import AuditEvent
from abbe.service.errors import AbbeError, ConfigError, MachineInUse
from abbe.service.files import replace_file
from abbe.service.machine_changes import RIGHTS, ValueChange, changed, differences, section_of

log = structlog.get_logger("abbe.file")
ACTION = "machine file"
FILE_ONLY = "limits.two_people"
"""Never changed on the page: it keeps a single person from deciding alone, so no single person may switch it off."""
LONGEST_TARGET = 400
CLOSED = "{key} is different in the file: start the service again on its computer to use the new value"


@dataclass(frozen=True, slots=True)
class FileChangeContext:
    """Data that a change needs.

    ``may(who, need)``: whether a person has a right. ``claim``: claims the machine; None while the service takes no jobs. ``push_open``:
    whether a push is unfinished. ``restart``: starts the service anew with a setup. ``cnc``: URL of the controller, if there is one.
    """

    may: Callable[[str, Permission], Awaitable[bool]]
    audit: AuditBook
    claim: Callable[[], MachineClaim | None]
    push_open: Callable[[], Awaitable[bool]]
    restart: Callable[[ServiceSetup], None]
    cnc: str | None = None


@dataclass(frozen=True, slots=True)
class _Plan:
    """A change that is allowed: the file before and after, what differs, and the setup that it makes."""

    old: LoadedMachine
    new: LoadedMachine
    found: tuple[ValueChange, ...]
    setup: ServiceSetup


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
        """Change the file, or answer why it is not changed. After "done" the service starts anew.

        A change that has begun is completed even if the caller stops waiting, so that a written file is always used.
        """
        self._work = asyncio.ensure_future(self._carried_out(asked))
        return await asyncio.shield(self._work)

    async def _carried_out(self, asked: ChangeFile) -> Answer:
        try:
            await self._check_rights(asked.who, [edit.key for edit in asked.edits])
            claim = self._context.claim()
            if claim is None:
                raise _Refusal("busy", "the service takes no jobs now: it is starting, ending, or running its timetable once")
            if other := claim.take(ACTION):
                raise _Refusal("busy", f"the machine is in use: {other}")
            try:
                setup = await self._claimed(asked)
            except BaseException:
                claim.give_back()
                raise
        except _Refusal as no:
            return _answer(asked, no.outcome, str(no))
        except MachineInUse as error:
            return _answer(asked, "busy", error.detail)
        except AbbeError as error:
            return _answer(asked, "conflict", error.detail.removeprefix(f"{self._source.loaded.path}: "))
        self._context.restart(setup)  # the claim stays taken: nothing begins with the old values
        return _answer(asked, "done", "")

    async def _check_rights(self, who: str, keys: Iterable[str], closed: str = "[{section}] cannot be changed on the page") -> None:
        """Refuse a key whose section the page does not change, or this person may not change."""
        needed = {Permission.CONFIGURE} if not keys else set[Permission]()
        for key in keys:
            if (section := section_of(key)) not in RIGHTS:
                raise _Refusal("forbidden", closed.format(key=key, section=section))
            needed.add(RIGHTS[section])
        for need in sorted(needed):
            if not await self._context.may(who, need):
                raise _Refusal("forbidden", f"{who} may not {need} here")

    async def _claimed(self, asked: ChangeFile) -> ServiceSetup:
        """Change the file while nobody else uses the machine; return the setup that the changed file makes."""
        if await self._context.push_open():
            raise _Refusal("conflict", "a push is not finished: the limits stay as they are until it is")
        plan = await asyncio.to_thread(self._planned, asked)
        await self._check_rights(asked.who, [one.key for one in plan.found], CLOSED)  # of a file edited by hand: of all that differs
        return await asyncio.to_thread(self._written, asked, plan)

    def _planned(self, asked: ChangeFile) -> _Plan:
        old = self._source.loaded
        now = load_machine(old.path)
        if asked.sha256 != old.sha256 or (asked.edits and now.body != old.body):
            raise _Refusal(
                "conflict", "the machine file has changed since the service read it: have it read again, then look at the values"
            )
        new = changed(now, asked.edits)
        found = differences(old, new)
        _check(asked, old, new, found)
        return _Plan(old, new, found, self._source.prepare(new))

    def _written(self, asked: ChangeFile, plan: _Plan) -> ServiceSetup:
        """Write the file with its record in the audit, under the machine's lock. Raises MachineInUse while a command has the lock."""
        begun = _event(asked, plan.old, plan.new, plan.found)
        with lock_machine(self._context.cnc):
            self._context.audit.write(begun)
            if asked.edits:
                try:
                    replace_file(plan.old.path, plan.new.body)
                except OSError as err:
                    self._context.audit.write(replace(begun, outcome="failed"))
                    raise ConfigError(
                        f"the service may not write {plan.old.path}: {err.strerror}", "give it the right to write this folder"
                    ) from None
        try:
            self._context.audit.write(replace(begun, outcome="done"))
        except AbbeError as error:  # the file is changed and the first record says so: the service must not go on with the old values
            log.error("audit record failed", cause=error.detail)
        log.warning("machine file changed", who=asked.who, changes=[str(one) for one in plan.found])
        return plan.setup


def _check(asked: ChangeFile, old: LoadedMachine, new: LoadedMachine, found: tuple[ValueChange, ...]) -> None:
    if not found and (asked.edits or old.body == new.body):
        raise _Refusal("conflict", "nothing is different from the file in force")
    if any(one.key == FILE_ONLY and one.looser for one in found):
        raise _Refusal("conflict", f"{FILE_ONLY} can be switched off only in the file, by somebody who may start the service")
    looser = [str(one) for one in found if one.looser]
    if looser and not (asked.looser and asked.reason.strip()):
        raise _Refusal("conflict", f"this allows more than before: {', '.join(looser)}. Tick that you mean it, and give the reason")


def _event(asked: ChangeFile, old: LoadedMachine, new: LoadedMachine, found: tuple[ValueChange, ...]) -> AuditEvent:
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
