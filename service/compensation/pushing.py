"""Push one table for a job: run the push machine (`abbe.service.push`) with the job's answers, and turn a bad end into an error.

The push machine runs in a task of its own: a cancelled job ends only when no unverified table is in force.
"""

from __future__ import annotations

import asyncio
import secrets
from collections.abc import Awaitable, Callable
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from datetime import timedelta

from abbe.drivers.api import TableController
from abbe.drivers.errors import DriverError, run_to_end
from abbe.drivers.tables import crc32, encode
from abbe.models.compensation.tables import NineTables
from abbe.service.clock import Clock, SystemClock
from abbe.service.compensation.proved_levels import level_status
from abbe.service.domain.document import Doc
from abbe.service.domain.measured import this_process
from abbe.service.domain.push_entry import PushState
from abbe.service.errors import AbbeError, MachineInUse, PushNotBegun, StillActive, TableMismatch, TableRefused
from abbe.service.push import execute
from abbe.service.push.execute import ControllerPort, Ended, PushActors, semantic_digest_of_tables
from abbe.service.push.journal import Journal, OperationOrder, StoreBook, facts, push_log
from abbe.service.push.operations import Approval, VerificationResult
from abbe.service.sequences.control import Control
from abbe.service.site import Site
from abbe.service.storage.store import Store
from abbe.service.tables.nine_tables import Base, table_image
from abbe.service.tables.push_journal import STILL_ACTIVE, operator_needed

MAKE_READY = "make the machine ready (interlocks, link); the next abbe command rolls the table back before anything else"
UNTRUSTED_CONTROL = (
    "move nothing; activate the old table at the control, and commission the control again: its answers contradict what it does"
)
MAY_BE_ACTIVE = f"a new table that was not verified may be in force; {MAKE_READY}"
APPROVED_S = 3600.0
RECHECK_S = 2.0
"""Pause before the second look at the controller, if a push was given up after its activation was sent."""
STILL_S, STILL_POLL_S, STILL_LIMIT_S = 1.2, 0.05, 15.0
"""How long the axes have to stand before a table may change; interval between looks, and longest wait for the standstill."""

_under_way: set[tuple[str, str]] = set()
"""Controls into which this process is pushing, by database and control (by name if no address is given)."""


@dataclass(frozen=True, slots=True)
class WantedTable:
    """A new table to push: absolute corrections in the controller's unit, its base, and its document for the store.

    ``image_id``: number inside the image; None draws a random one. An approved image needs the approved number.
    """

    tables: NineTables
    base: Base
    lsb_nm: int
    solution_id: int | None
    doc: Doc
    image_id: int | None = None


@dataclass(frozen=True, slots=True)
class RestoredTable:
    """A table to restore, byte for byte. ``semantic_digest``: digest of its corrections when it was read or written."""

    image: bytes
    semantic_digest: str
    base: Base
    doc: Doc
    solution_id: int | None = None


@dataclass(frozen=True, slots=True)
class Questions:
    """A job's answers to the questions of the push machine.

    ``validate``: reasons against the table, without touching the controller; ``approved_by``: the approver. ``probe`` and ``verify`` move
    the machine; an error in them rolls the table back, as a failed check does, and is raised again afterwards. ``approval``: given earlier
    for exactly this image on exactly this base; None: the person who ordered the push approves it.
    """

    validate: Callable[[], list[str]]
    approved_by: str
    probe: Callable[[], Awaitable[VerificationResult]]
    verify: Callable[[], Awaitable[VerificationResult]]
    approval: Approval | None = None


@dataclass(frozen=True, slots=True)
class PushResult:
    """Result of a push: the new table is kept, or the old one is in force again. ``log``: every transition, for people."""

    push_id: int
    table_id: int
    bank: int
    crc: int
    previous_bank: int
    kept: bool
    why: str
    log: tuple[str, ...]


@dataclass
class Pushing:
    """Pushes one table into a controller."""

    controller: TableController
    store: Store
    site: Site
    clock: Clock = field(default_factory=SystemClock)
    level: int | None = None
    """Capability level of the controller; None: what its commissioning has proved."""
    attended: bool = True
    control: Control = field(default_factory=Control)
    """Stops or pauses the push: a stop rolls an unverified table back; a pause takes effect only before anything is written."""
    crc: int | None = None
    """CRC of the pushed image, from `bring` on."""
    _stop: str = ""
    _question: asyncio.Task[VerificationResult] | None = None
    _error: BaseException | None = None
    _notes: list[str] = field(default_factory=list)

    async def bring(self, wanted: WantedTable | RestoredTable, questions: Questions) -> PushResult:
        """Push, probe, verify; keep or roll back.

        Raises
        ------
        TableRefused
            There are reasons against the table; nothing was written.
        PushNotBegun
            The push ended before the new table was in force; the old table is in force.
        StillActive
            The old table could not be made active again (yet).
        TableMismatch
            The controller holds a table unknown to the journal, or has activated the new one after refusing it.
        MachineInUse, UnsafeToMove
            Another push on this machine is under way or unfinished.
        Stopped, Aborted
            A person asked for it before anything was written.
        StoreError
            The journal cannot be written. A note says whether the new table may be in force.
        asyncio.CancelledError
            Raised only after the push has ended; a note names the table in force.
        """
        order = await self._order(wanted)
        key = _control_key(self.store, self.site)
        if key in _under_way:
            raise MachineInUse(f"a push into {self.site.name} is under way in this process", "wait until the push has ended")
        _under_way.add(key)
        # Refuse new pauses first, then wait for a pending one: no pause can come between and hold an unverified table in force.
        self.control.no_pause_reason = "an unverified table may be in force: stop the push, or let it finish"
        try:
            await self.control.gate()
            book = await StoreBook.new(self.store, self.site.name, self.clock, self.site.urls.control)
            await self._wait_for_standstill()
            ended = await self._drive(book, order, wanted, questions)
            await self._look_again(ended)
        finally:
            _under_way.discard(key)
            self.control.no_pause_reason = ""
        return self._outcome(ended)

    async def _order(self, wanted: WantedTable | RestoredTable) -> OperationOrder:
        form = await self.controller.table_format()
        image, semantic_digest = _image(wanted)
        if len(image) > 2 * form.bank_registers:
            raise TableRefused(f"the tables need {len(image) // 2} registers, a bank has {form.bank_registers}", "use a coarser grid")
        self.crc = crc32(image)
        level = self.level if self.level is not None else (await level_status(self.controller, self.store, self.site)).level
        machine_id = await self.store.write(self.store.machines.add, self.site.name, self.site.doc)
        table_id = await self.store.write(self.store.tables.add, machine_id, wanted.solution_id, image, crc32(image), wanted.doc)
        return OperationOrder(
            self.site.name, image, crc32(image), semantic_digest, self.site.limits.digest(),
            owner=(secrets.randbits(15) + 1) << 16, level=level, attended=self.attended, table=table_id,
            process=asdict(this_process()), control=self.site.urls.control,
        )  # fmt: skip

    async def _wait_for_standstill(self) -> None:
        """Wait until the axes have stood long enough. This only avoids an early refusal: the push machine checks it again."""
        end_s = self.clock.monotonic_s() + STILL_LIMIT_S
        while self.clock.monotonic_s() < end_s:
            status = await self.controller.status()
            if (status.ctrl_us - status.in_position_us) * 1e-6 >= STILL_S:
                return
            await self.clock.sleep(STILL_POLL_S)

    async def _drive(self, book: StoreBook, order: OperationOrder, wanted: WantedTable | RestoredTable, questions: Questions) -> Ended:
        """Run the push machine in a task of its own; raise a cancellation only after its end, with a note on the table in force."""
        port = ControllerPort(self.controller, self._actors(wanted, questions), self.clock)
        task = asyncio.ensure_future(execute.push(port, book, order, stop=self._stop_reason))
        cancelled: asyncio.CancelledError | None = None
        while not task.done():
            try:
                await asyncio.wait([task])
            except asyncio.CancelledError as error:
                cancelled, self._stop = error, "stopped"
                if self._question is not None:
                    self._question.cancel()
        failed = task.exception()
        if failed is not None:
            failed = await self._failed(port, book, failed)
        if cancelled is not None:
            for note in self._notes:
                cancelled.add_note(note)
            cancelled.add_note(_after_cancel(None if failed is not None else task.result(), failed))
            raise cancelled
        if failed is not None:
            raise failed
        return task.result()

    async def _look_again(self, ended: Ended) -> None:
        """Check that a control that refused the activation, or was fenced off, has not activated the table afterwards.

        Raises
        ------
        TableMismatch
            The control has activated the table.
        """
        if ended.state is not PushState.ABORTED or PushState.ACTIVATING not in {entry.state for entry in ended.journal}:
            return
        known = facts(ended.journal)
        await self.clock.sleep(RECHECK_S)
        with suppress(DriverError):  # the controller reported no activation; the next command looks again
            now = await self.controller.comp_status()
            if now.bank_crc[now.active_bank] == known.crc != known.base_crc:
                given_up = f"push {ended.journal[-1].push} was given up ({known.why})"
                why = f"{given_up}, but the control made the table of this push active"
                raise TableMismatch(f"{why}: {STILL_ACTIVE} (CRC {known.crc:08X})", UNTRUSTED_CONTROL)

    def _stop_reason(self) -> str:
        return self._stop or ("stopped by a person" if self.control.stopping or self.control.aborting else "")

    async def _failed(self, port: ControllerPort, book: StoreBook, failed: BaseException) -> BaseException:
        """Try recovery once after a journal error or a defect; return the error with a note on the outcome of the recovery."""
        try:
            ended = await run_to_end(execute.recover(port, book))
        except Exception as again:  # noqa: BLE001 - the first failure is raised in any case, with what is known
            failed.add_note(f"{MAY_BE_ACTIVE} ({again})")
            return failed
        failed.add_note(MAY_BE_ACTIVE if not ended.settled or ended.state is PushState.OPERATOR else "the old table is in force")
        return failed

    def _actors(self, wanted: WantedTable | RestoredTable, questions: Questions) -> PushActors:
        async def validate(journal: Journal) -> list[str]:
            known = facts(journal)
            if known.base_crc != wanted.base.crc or known.base_image != wanted.base.image:
                return ["BASE: this table was made for another active table"]
            if (known.boot, known.gen) != (wanted.base.status.boot_id, wanted.base.status.gen):
                return ["GENERATION: the controller restarted, or a bank was changed, since the base was read"]
            return questions.validate()

        async def approve(journal: Journal) -> Approval:
            if questions.approval is not None:
                return questions.approval
            expiry = (self.clock.utc() + timedelta(seconds=APPROVED_S)).isoformat(timespec="seconds")
            digest = facts(journal).binding(expiry)
            return Approval(digest, questions.approved_by, expiry, self.clock.monotonic_s() + APPROVED_S)

        async def probe(journal: Journal) -> VerificationResult:
            return await self._run_question(questions.probe)

        async def verify(journal: Journal) -> VerificationResult:
            return await self._run_question(questions.verify)

        return PushActors(validate, approve, probe, verify)

    async def _run_question(self, question: Callable[[], Awaitable[VerificationResult]]) -> VerificationResult:
        """Run the job's probe or verification. An error in it fails the check; `_pushed` raises it again once the old table is in force."""

        async def ask() -> VerificationResult:
            return await question()

        if stop := self._stop_reason():  # before this question has moved anything
            return VerificationResult(False, stop)
        self._question = asyncio.ensure_future(ask())
        try:
            await asyncio.wait([self._question])
        except asyncio.CancelledError:  # the adapter has lost the lease, or the loop ends
            self._question.cancel()
            await asyncio.wait([self._question])
            raise
        finally:
            task, self._question = self._question, None
        if task.cancelled():
            self._keep_notes(task)
            return VerificationResult(False, "stopped")
        error = task.exception()
        if error is None:
            return task.result()
        self._error = error
        return VerificationResult(False, str(error) or type(error).__name__)

    def _keep_notes(self, task: asyncio.Task[VerificationResult]) -> None:
        """Keep the notes of a stopped measurement, e.g. that the stop could not be delivered."""
        try:
            task.result()
        except asyncio.CancelledError as error:
            self._notes += getattr(error, "__notes__", [])

    def _outcome(self, ended: Ended) -> PushResult:
        """Return the result of the push, or raise its error with all notes of the job's own error added."""
        try:
            return self._pushed(ended)
        except AbbeError as error:
            for note in getattr(self._error, "__notes__", []):
                if error is not self._error:
                    error.add_note(note)
            raise

    def _pushed(self, ended: Ended) -> PushResult:
        """Return the result of a push that has ended, or raise the error that describes its end."""
        known = facts(ended.journal)
        why = known.why or ended.why
        detail = str(self._error) if self._error is not None else why
        if ended.state is not None and not ended.settled and ended.state is not PushState.ROLLBACK_PENDING:
            raise StillActive(detail if detail == ended.why else f"{detail}; {ended.why}", MAKE_READY) from self._error
        match ended.state:
            case PushState.KEEP | PushState.ROLLED_BACK:
                if self._error is not None:
                    raise self._error
                last = ended.journal[-1]
                return PushResult(
                    last.push, known.table, known.target, known.crc, known.base_bank,
                    last.state is PushState.KEEP, why, push_log(ended.journal),
                )  # fmt: skip
            case PushState.REJECTED:
                raise TableRefused.because(known.reasons)
            case PushState.OPERATOR:
                raise operator_needed(ended.journal, detail) from self._error
            case PushState.ROLLBACK_PENDING:
                raise StillActive(f"{detail}; {STILL_ACTIVE} ({known.pending})", MAKE_READY) from self._error
        raise PushNotBegun(f"the table was not brought into force: {why}", "the old table is in force; remove the cause, then push again")


def _image(wanted: WantedTable | RestoredTable) -> tuple[bytes, str]:
    """The image to push and the semantic digest, which is computed independently of the image."""
    if isinstance(wanted, RestoredTable):
        return wanted.image, wanted.semantic_digest
    number = secrets.randbits(31) if wanted.image_id is None else wanted.image_id
    return encode(table_image(wanted.tables, wanted.lsb_nm, number)), semantic_digest_of_tables(wanted.tables)


def _after_cancel(ended: Ended | None, failed: BaseException | None) -> str:
    """The note for the person who cancelled: which table is in force."""
    if ended is None:
        return f"{failed}; {'; '.join(getattr(failed, '__notes__', []))}"
    if ended.state is PushState.KEEP:
        return "the new table was verified and is kept"
    if ended.state is PushState.OPERATOR:
        error = operator_needed(ended.journal)
        return str(error)
    if not ended.settled:
        return f"{STILL_ACTIVE}: {facts(ended.journal).pending or ended.why}; {MAKE_READY}"
    return "the old table is in force"


def pushes_here(store: Store, site: Site) -> bool:
    """Whether this process is pushing into a machine's control now."""
    return _control_key(store, site) in _under_way


def _control_key(store: Store, site: Site) -> tuple[str, str]:
    return str(store.url), site.urls.control or site.name
