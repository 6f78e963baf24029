"""Run the push machine: get the next operation, do it through a port, learn from its outcome. Tests run the same loop on a model.

`ControllerPort` is the port to a real controller: it turns each operation into calls of the driver or a question to `PushActors`, and
errors of the driver into outcomes: Refused (nothing changed) or Unanswered (the result is unknown). It decides nothing.
"""

from __future__ import annotations

import asyncio
import hashlib
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Protocol

from abbe.drivers.api import Condition, TableController
from abbe.drivers.errors import DriverError, Rebooted, Refused
from abbe.drivers.second_decoder import UnreadableImage, read_axis_tables
from abbe.models.compensation.tables import NineTables
from abbe.service.clock import Clock
from abbe.service.domain.document import Doc, canonical
from abbe.service.domain.push_entry import TERMINAL, PushEntry, PushState
from abbe.service.push import operations as o
from abbe.service.push.journal import Journal, OperationOrder, facts
from abbe.service.push.machine import next_operation
from abbe.service.push.operations import Operation, OperationKind, Outcome, PushKnowledge, Truth, after_record, learn
from abbe.service.sequences.control import tripped

LEASE_MS, BEAT_S = 60_000, 20.0
"""Length of a lease, and interval of its renewal while the machine is measured."""
_POSITIONS_PER_MM = 1e5
_VALUES_PER_MM = 1e6

Rows = list[tuple[str, str, list[tuple[int, int]]]]


class Port(Protocol):
    """Does one operation on a controller, or asks one of the `PushActors`. Faults of controller and link are outcomes, not exceptions."""

    async def execute(self, op: Operation, journal: Journal) -> Outcome:
        """Do the operation; ``journal`` is the push so far."""
        ...


class Book(Protocol):
    """The durable journal of one push."""

    async def entries(self) -> Journal:
        """All entries so far."""
        ...

    async def append(self, journal: Journal, state: PushState, doc: Doc) -> PushEntry:
        """Write the next entry; on return it is on disk. Raises if it cannot be written, or if another process wrote one meanwhile."""
        ...


@dataclass(frozen=True, slots=True)
class Ended:
    """State of a push after this run of the loop. ``state`` None: nothing was begun. Not ``settled``: recovery has to continue the push."""

    state: PushState | None
    journal: Journal
    why: str

    @property
    def settled(self) -> bool:
        """Whether nothing is left to do, or only a person can do the rest."""
        return self.state is None or self.state in TERMINAL


def _never_stop() -> str:
    return ""


async def push(port: Port, book: Book, order: OperationOrder, *, stop: Callable[[], str] = _never_stop) -> Ended:
    """Push a table into a controller, from SNAPSHOT to KEEP, or roll back.

    ``stop`` is called before every operation: a reason to stop, or an empty text. A stop rolls an unverified table back.
    """
    return await _drive(port, book, (), PushKnowledge(mine=True), order, stop)


async def recover(port: Port, book: Book) -> Ended:
    """Finish an interrupted push from its journal and the controller's state. May itself be interrupted and repeated."""
    return await _drive(port, book, await book.entries(), PushKnowledge(), None, _never_stop)


async def _drive(
    port: Port, book: Book, journal: Journal, known: PushKnowledge, order: OperationOrder | None, stop: Callable[[], str]
) -> Ended:
    while True:
        text = stop()
        if text and not known.stop:
            known = known._replace(stop=text)
        op = next_operation(journal, known, order)
        if op.kind is OperationKind.END:
            return Ended(journal[-1].state if journal else None, journal, op.text)
        if op.kind is OperationKind.RECORD:
            assert op.state is not None
            entry = await book.append(journal, op.state, op.doc or {})
            journal, known = (*journal, entry), after_record(known, entry.state)
        else:
            known = learn(known, op, await port.execute(op, journal))


@dataclass(frozen=True, slots=True)
class PushActors:
    """Functions that answer the push machine's questions: check of the table, approval, probe, verification."""

    validate: Callable[[Journal], Awaitable[list[str]]]
    approve: Callable[[Journal], Awaitable[o.Approval | None]]
    probe: Callable[[Journal], Awaitable[o.VerificationResult]]
    verify: Callable[[Journal], Awaitable[o.VerificationResult]]


def no_actors() -> PushActors:
    """Actors for a recovery without a person: every question is answered with no."""

    async def no_reason(journal: Journal) -> list[str]:
        return ["no one is present to check the table"]

    async def no_approval(journal: Journal) -> o.Approval | None:
        return None

    async def no_verdict(journal: Journal) -> o.VerificationResult:
        return o.VerificationResult(False, "no one is present to measure the machine")

    return PushActors(no_reason, no_approval, no_verdict, no_verdict)


class ControllerPort:
    """Does operations on a real controller.

    Parameters
    ----------
    controller : TableController
        A controller that has been identified.
    clock : Clock
        Monotonic time, in which approvals expire.
    """

    def __init__(self, controller: TableController, actors: PushActors, clock: Clock) -> None:
        self._c, self._actors, self._clock = controller, actors, clock
        self._map = ""

    async def execute(self, op: Operation, journal: Journal) -> Outcome:
        """Do one operation; faults of controller and link are outcomes, not exceptions."""
        try:
            return await self._execute(op, journal)
        except Refused as error:
            return o.OperationRefused(str(error))
        except (DriverError, TimeoutError) as error:
            return o.Unanswered(str(error) or type(error).__name__)

    async def _execute(self, op: Operation, journal: Journal) -> Outcome:
        match op.kind:
            case OperationKind.LOOK:
                return o.Done(await self._look())
            case OperationKind.READ:
                return o.Done(await self._c.read_bank(op.bank, 2 * op.count or None))
            case OperationKind.READ_AGAIN:
                return o.Done(semantic_digest_of_image(await self._c.read_bank(op.bank, 2 * op.count or None)))
            case OperationKind.READ_CHUNK:
                return o.Done(await self._c.read_bank(op.bank, 2 * op.count, first=op.first))
            case OperationKind.VALIDATE | OperationKind.APPROVE | OperationKind.PROBE | OperationKind.VERIFY:
                return await self._ask(op.kind, journal)
            case _:
                await self._change(op)
                return o.Done()

    async def _change(self, op: Operation) -> None:
        match op.kind:
            case OperationKind.LEASE:
                await self._c.lease(op.owner, LEASE_MS)
            case OperationKind.RELEASE:
                await self._c.release(op.owner)
            case OperationKind.WRITE:
                await self._c.write_bank(op.bank, op.data, first=op.first)
            case OperationKind.SEAL:
                await self._c.seal(op.bank, op.owner)
            case OperationKind.ACTIVATE:
                await self._c.activate(op.bank, expect_crc=op.crc, expect_gen=op.gen, owner=op.owner)
            case _:
                raise AssertionError(f"{op.kind} is not an operation on a controller")

    async def _ask(self, kind: OperationKind, journal: Journal) -> Outcome:
        if kind is OperationKind.VALIDATE:
            return o.Done(await self._actors.validate(journal))
        if kind is OperationKind.APPROVE:
            approval = await self._actors.approve(journal)
            return o.OperationRefused("nobody approved the table") if approval is None else o.Done(approval)
        return o.Done(await self._while_leased(self._actors.probe if kind is OperationKind.PROBE else self._actors.verify, journal))

    async def _while_leased(self, question: Callable[[Journal], Awaitable[o.VerificationResult]], journal: Journal) -> o.VerificationResult:
        """Measure while renewing the lease. If another owner takes it, the measurement does not count."""
        over, lost = asyncio.Event(), asyncio.Event()
        asked = asyncio.ensure_future(question(journal))
        beat = asyncio.ensure_future(self._beat(facts(journal).owner, over, lost))
        try:
            await asyncio.wait([asked, beat], return_when=asyncio.FIRST_COMPLETED)
            if lost.is_set() and not asked.done():
                asked.cancel()
            await asyncio.wait([asked])
        finally:
            over.set()  # not cancelled: a command under way would leave the link in doubt
            await asyncio.wait([beat])
        if lost.is_set() and asked.cancelled():
            return o.VerificationResult(False, "another owner took the lease meanwhile")
        if not beat.cancelled():
            beat.exception()  # a failed renewal shows at the next look at the lease; the measurement counts
        return asked.result()

    async def _beat(self, owner: int, over: asyncio.Event, lost: asyncio.Event) -> None:
        """Renew the lease until ``over`` is set; set ``lost`` when another owner has it."""
        ended = asyncio.ensure_future(over.wait())
        try:
            while True:
                pause = asyncio.ensure_future(self._clock.sleep(BEAT_S))
                await asyncio.wait([ended, pause], return_when=asyncio.FIRST_COMPLETED)
                pause.cancel()
                if ended.done():
                    return
                try:
                    await self._c.lease(owner, LEASE_MS)
                except Refused:
                    lost.set()
                    return
                except (DriverError, TimeoutError):
                    continue  # the measurement meets the same fault and reports it
        finally:
            ended.cancel()

    async def _look(self) -> Truth:
        """Read the controller's state. Only this read accepts a restart of the controller: the push machine sees its new boot id."""
        if not self._map:
            self._map = (await self._c.identify()).firmware
        try:
            return await self._truth()
        except Rebooted:
            self._map = (await self._c.identify()).firmware
            return await self._truth()

    async def _truth(self) -> Truth:
        status = await self._c.status()
        comp = await self._c.comp_status()
        trouble = tripped(status)
        unsafe = trouble.detail if trouble else ("the axes move" if status.moving else "")
        still_s = (status.ctrl_us - status.in_position_us) * 1e-6 if Condition.IN_POSITION in status.conditions else 0.0
        return Truth(
            comp.boot_id, comp.gen, comp.active_bank, comp.bank_crc, comp.bank_state, comp.lease_owner, comp.lease_left_ms,
            unsafe, still_s, self._clock.monotonic_s(), self._map,
        )  # fmt: skip


def semantic_digest_of_tables(tables: NineTables) -> str:
    """Digest of corrections (added to the command): position in 10 nm and correction in nm, for each moved and each corrected axis.

    It shares no code with `semantic_digest_of_image`: if the encoder gets a sign, an axis or a unit wrong, the two digests differ. Only the
    physical probe shows a mistake that is in both.
    """
    rows: Rows = []
    for a, moved in enumerate("XYZ"):
        for i, corrected in enumerate("XYZ"):
            pairs = zip(tables.position_mm[a].tolist(), tables.correction_mm[a][:, i].tolist(), strict=True)
            rows.append((moved, corrected, [(round(p * _POSITIONS_PER_MM), round(c * _VALUES_PER_MM)) for p, c in pairs]))
    return _digest(rows)


def semantic_digest_of_image(image: bytes) -> str:
    """Digest of a bank as the independent decoder reads it; ``"unreadable"`` if it cannot."""
    try:
        curves = read_axis_tables(image)
    except UnreadableImage:
        return "unreadable"
    rows: Rows = []
    for (moved, corrected), pairs in curves.items():
        rows.append((moved, corrected, [(round(p * _POSITIONS_PER_MM), round(c * _VALUES_PER_MM)) for p, c in pairs]))
    return _digest(rows)


def _digest(rows: Rows) -> str:
    return hashlib.sha256(canonical(sorted(rows))).hexdigest()
