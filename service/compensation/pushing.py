"""One table's way into a controller, as a job asks for it: the push machine (`abbe.service.push`) with this job's questions and errors.

The machine runs in a task of its own: a job that is cancelled meanwhile waits until nothing unverified is in force, and ends then.
"""

from __future__ import annotations

import asyncio
import secrets
from collections.abc import Awaitable, Callable
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from datetime import timedelta

from abbe.drivers.api import TableController
from abbe.drivers.errors import DriverError
from abbe.drivers.links.shielded import run_to_end
from abbe.drivers.tables import crc32, encode
from abbe.models.compensation.tables import NineTables
from abbe.service.clock import Clock, SystemClock
from abbe.service.compensation.proved_levels import level_status
from abbe.service.domain.owner import this_process
from abbe.service.errors import AbbeError, MachineInUse, PushNotBegun, StillActive, TableMismatch, TableRefused
from abbe.service.push import execute
from abbe.service.push.adapter import ControllerPort, PushActors
from abbe.service.push.book import StoreBook
from abbe.service.push.entries import Doc, Journal, facts
from abbe.service.push.execute import Ended
from abbe.service.push.operations import Approval, Verdict
from abbe.service.push.order import OperationOrder
from abbe.service.push.semantic_digest import semantic_digest_of_tables
from abbe.service.push.states import PushState
from abbe.service.sequences.control import Control
from abbe.service.site import Site
from abbe.service.storage.store import Store
from abbe.service.tables.base_table import Base
from abbe.service.tables.nine_tables import table_image
from abbe.service.tables.push_journal import STILL_ACTIVE, operator_needed, push_log

MAKE_READY = "make the machine ready (interlocks, link); the next abbe command takes it back before anything else"
NOT_TO_BE_TRUSTED = "move nothing; make the table from before active at the control, and commission it anew: it does not do what it answers"
PERHAPS = f"a new table that was not verified may be in force; {MAKE_READY}"
APPROVED_S = 3600.0
AGAIN_S = 2.0
"""How long after a push that was given up after its activation was sent the controller is asked again what is in force."""
STILL_S, STILL_POLL_S, STILL_LIMIT_S = 1.2, 0.05, 15.0
"""How long the axes have to stand before a table may change; how often that is asked, and for how long."""

_under_way: set[tuple[str, str]] = set()
"""Controls into which this process pushes now, by database and control (or name, where no address is given)."""


@dataclass(frozen=True, slots=True)
class WantedTable:
    """A table that shall come into force: absolute corrections in the controller's unit, on which base, and what is kept about it.

    ``image_id``: number inside the image, drawn by lot if None; given where the image was approved before.
    """

    tables: NineTables
    base: Base
    lsb_nm: int
    solution_id: int | None
    doc: Doc
    image_id: int | None = None


@dataclass(frozen=True, slots=True)
class WantedAgain:
    """A table that was in force before, byte for byte: ``image``, and what it meant when it was read or written (``meaning``)."""

    image: bytes
    meaning: str
    base: Base
    doc: Doc
    solution_id: int | None = None


@dataclass(frozen=True, slots=True)
class Questions:
    """What a job answers while its table is on the way.

    ``validate``: reasons against the table, without touching the controller; ``approved_by``: who agreed to it. ``probe`` and ``verify``
    move the machine; what they raise leads back like a no, and is raised again afterwards. ``approval``: given before, for exactly this
    image on exactly this base; None: the one who ordered the push approves it.
    """

    validate: Callable[[], list[str]]
    approved_by: str
    probe: Callable[[], Awaitable[Verdict]]
    verify: Callable[[], Awaitable[Verdict]]
    approval: Approval | None = None


@dataclass(frozen=True, slots=True)
class PushResult:
    """How a push ended: the new table is kept, or the old one is in force again. ``log``: every transition, for people."""

    push_id: int
    table_id: int
    bank: int
    crc: int
    previous_bank: int
    previous_crc: int
    kept: bool
    why: str
    log: tuple[str, ...]


@dataclass
class Pushing:
    """Brings one table into a controller."""

    controller: TableController
    store: Store
    site: Site
    clock: Clock = field(default_factory=SystemClock)
    level: int | None = None
    """Capability level of the controller; None: what its commissioning has proved."""
    attended: bool = True
    control: Control = field(default_factory=Control)
    """Who may stop it: what is active and not verified goes back then. A pause is waited for before anything is written, and not after."""
    crc: int | None = None
    """Of the image on its way, from `bring` on."""
    _stop: str = ""
    _question: asyncio.Task[Verdict] | None = None
    _error: BaseException | None = None
    _notes: list[str] = field(default_factory=list)

    async def bring(self, wanted: WantedTable | WantedAgain, questions: Questions) -> PushResult:
        """Push, prove, verify; keep or go back.

        Raises
        ------
        TableRefused
            There are reasons against the table; nothing was written.
        PushNotBegun
            It came to nothing before it was in force; the old table is in force.
        StillActive
            The old table could not be made active again (yet).
        TableMismatch
            The controller holds what the journal does not know, or activated what it had refused; or encoding is not what the tables mean.
        MachineInUse, UnsafeToMove
            Another push on this machine is under way, or has not come to an end.
        Stopped, Aborted
            Asked for before anything was written.
        StoreError
            The journal cannot be written. A note says whether the new table may be in force.
        asyncio.CancelledError
            When nothing is on its way any more; a note says which table is in force.
        """
        order = await self._order(wanted)
        key = _place(self.store, self.site)
        if key in _under_way:
            raise MachineInUse(f"a push into {self.site.name} is under way in this process", "wait until it has ended")
        _under_way.add(key)
        # First pauses are closed, then an earlier one is waited for: none can come between and hold an unverified table in force.
        self.control.no_pause_reason = "a table that nobody has verified may be in force: stop it, or let it end"
        try:
            await self.control.gate()
            book = await StoreBook.new(self.store, self.site.name, self.clock, self.site.control)
            await self._stand_still()
            ended = await self._drive(book, order, wanted, questions)
            await self._look_again(ended)
        finally:
            _under_way.discard(key)
            self.control.no_pause_reason = ""
        return self._outcome(ended)

    async def _order(self, wanted: WantedTable | WantedAgain) -> OperationOrder:
        form = await self.controller.table_format()
        image, meaning = _image(wanted)
        if len(image) > 2 * form.bank_registers:
            raise TableRefused(f"the tables need {len(image) // 2} registers, a bank has {form.bank_registers}", "use a coarser grid")
        self.crc = crc32(image)
        level = self.level if self.level is not None else (await level_status(self.controller, self.store, self.site)).level
        machine_id = await self.store.write(self.store.machines.add, self.site.name, self.site.doc)
        table_id = await self.store.write(self.store.tables.add, machine_id, wanted.solution_id, image, crc32(image), wanted.doc)
        return OperationOrder(
            self.site.name, image, crc32(image), meaning, self.site.limits.digest(),
            owner=(secrets.randbits(15) + 1) << 16, level=level, attended=self.attended, table=table_id,
            process=asdict(this_process()), control=self.site.control,
        )  # fmt: skip

    async def _stand_still(self) -> None:
        """Wait until the axes have stood long enough; the machine of the push judges, this only keeps it from being asked too early."""
        end_s = self.clock.monotonic_s() + STILL_LIMIT_S
        while self.clock.monotonic_s() < end_s:
            status = await self.controller.status()
            if (status.ctrl_us - status.in_position_us) * 1e-6 >= STILL_S:
                return
            await self.clock.sleep(STILL_POLL_S)

    async def _drive(self, book: StoreBook, order: OperationOrder, wanted: WantedTable | WantedAgain, questions: Questions) -> Ended:
        """Let the machine run in a task of its own; a cancellation is raised when it has come to its end, and says what is in force."""
        port = ControllerPort(self.controller, self._people(wanted, questions), self.clock)
        task = asyncio.ensure_future(execute.push(port, book, order, stop=self._told_to_stop))
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
        """A control that refused the activation, or was fenced off, must not do it all the same a moment later.

        Raises
        ------
        TableMismatch
            It did.
        """
        if ended.state is not PushState.ABORTED or PushState.ACTIVATING not in {entry.state for entry in ended.journal}:
            return
        known = facts(ended.journal)
        await self.clock.sleep(AGAIN_S)
        with suppress(DriverError):  # nothing was activated as far as the controller said; the next command looks again
            now = await self.controller.comp_status()
            if now.bank_crc[now.active_bank] == known.crc != known.base_crc:
                said = f"push {ended.journal[-1].push} was given up ({known.why})"
                why = f"{said}, and the control made its table active all the same"
                raise TableMismatch(f"{why}: {STILL_ACTIVE} (CRC {known.crc:08X})", NOT_TO_BE_TRUSTED)

    def _told_to_stop(self) -> str:
        return self._stop or ("stopped by a person" if self.control.stopping or self.control.aborting else "")

    async def _failed(self, port: ControllerPort, book: StoreBook, failed: BaseException) -> BaseException:
        """The journal could not be written, or there is a defect: try the way back once, and say how that ended."""
        try:
            ended = await run_to_end(execute.recover(port, book))
        except Exception as again:  # noqa: BLE001 - whatever it is, the first failure is the one to be heard, with what is known
            failed.add_note(f"{PERHAPS} ({again})")
            return failed
        failed.add_note(PERHAPS if not ended.settled or ended.state is PushState.OPERATOR else "the old table is in force")
        return failed

    def _people(self, wanted: WantedTable | WantedAgain, questions: Questions) -> PushActors:
        async def validate(journal: Journal) -> list[str]:
            known = facts(journal)
            if known.base_crc != wanted.base.crc or known.base_image != wanted.base.image:
                return ["BASE: the active table is not the one that was in force while this one was made"]
            if (known.boot, known.gen) != (wanted.base.status.boot_id, wanted.base.status.gen):
                return ["GENERATION: the controller restarted, or somebody wrote into a bank, since the base was read"]
            return questions.validate()

        async def approve(journal: Journal) -> Approval:
            if questions.approval is not None:
                return questions.approval
            expiry = (self.clock.utc() + timedelta(seconds=APPROVED_S)).isoformat(timespec="seconds")
            digest = facts(journal).binding(expiry)
            return Approval(digest, questions.approved_by, expiry, self.clock.monotonic_s() + APPROVED_S)

        async def probe(journal: Journal) -> Verdict:
            return await self._ask(questions.probe)

        async def verify(journal: Journal) -> Verdict:
            return await self._ask(questions.verify)

        return PushActors(validate, approve, probe, verify)

    async def _ask(self, question: Callable[[], Awaitable[Verdict]]) -> Verdict:
        """Let the job measure; whatever stops it is an answer, and is raised again when the old table is in force."""

        async def ask() -> Verdict:
            return await question()

        if stop := self._told_to_stop():  # heard before anything of this question has moved
            return Verdict(False, stop)
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
            return Verdict(False, "stopped")
        error = task.exception()
        if error is None:
            return task.result()
        self._error = error
        return Verdict(False, str(error) or type(error).__name__)

    def _keep_notes(self, task: asyncio.Task[Verdict]) -> None:
        """What a stopped measurement has to say, e.g. that the stop could not be delivered."""
        try:
            task.result()
        except asyncio.CancelledError as error:
            self._notes += getattr(error, "__notes__", [])

    def _outcome(self, ended: Ended) -> PushResult:
        """What a job hears, with all notes of its own error."""
        try:
            return self._pushed(ended)
        except AbbeError as error:
            for note in getattr(self._error, "__notes__", []):
                if error is not self._error:
                    error.add_note(note)
            raise

    def _pushed(self, ended: Ended) -> PushResult:
        """What a job hears."""
        known = facts(ended.journal)
        why = known.why or ended.why
        detail = str(self._error) if self._error is not None else why
        if ended.state is not None and not ended.settled and ended.state is not PushState.ROLLBACK_PENDING:
            raise StillActive(f"{detail}: {ended.why}", MAKE_READY) from self._error
        match ended.state:
            case PushState.KEEP | PushState.ROLLED_BACK:
                if self._error is not None:
                    raise self._error
                last = ended.journal[-1]
                return PushResult(
                    last.push, known.table, known.target, known.crc, known.base_bank,
                    known.base_crc, last.state is PushState.KEEP, why, push_log(ended.journal),
                )  # fmt: skip
            case PushState.REJECTED:
                raise TableRefused.because(known.reasons)
            case PushState.OPERATOR:
                raise operator_needed(ended.journal, detail) from self._error
            case PushState.ROLLBACK_PENDING:
                raise StillActive(f"{detail}; {STILL_ACTIVE} ({known.pending})", MAKE_READY) from self._error
        raise PushNotBegun(f"the table was not brought into force: {why}", "the old table is in force; look at the cause, then push again")


def _image(wanted: WantedTable | WantedAgain) -> tuple[bytes, str]:
    """What the controller is to hold, and the digest of what it means, which does not come from it."""
    if isinstance(wanted, WantedAgain):
        return wanted.image, wanted.meaning
    number = secrets.randbits(31) if wanted.image_id is None else wanted.image_id
    return encode(table_image(wanted.tables, wanted.lsb_nm, number)), semantic_digest_of_tables(wanted.tables)


def _after_cancel(ended: Ended | None, failed: BaseException | None) -> str:
    """What the one who stopped it has to know."""
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
    return _place(store, site) in _under_way


def _place(store: Store, site: Site) -> tuple[str, str]:
    return str(store.url), site.control or site.name
