"""The push protocol in a world that goes wrong on purpose: every wire request, question and journal write is a place for a fault."""

from __future__ import annotations

from collections.abc import Coroutine
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

from abbe.service.domain.document import GENESIS
from tests.push import controller as c
from tests.push.content import images, meanings, tables
from tests.push.invariants import CHECKS, violations

HOST = ("crash_before", "crash_after")
WORLD = (
    "reboot_keep", "reboot_inactive", "reboot_factory", "hand_active", "hand_inactive", "hand_sealed", "hand_switch", "estop",
    "foreign_lease", "lease_ends",
)  # fmt: skip
WIRE = ("lost_request", "lost_reply", "duplicate", "late_request", "later_request", "late_reply")
JOURNAL = ("crash_before", "crash_after", "journal_fails")
FAULTS = {
    "read": (*HOST, *WORLD, "lost_request", "lost_reply", "late_reply", "flip_read"),
    "look": (*HOST, *WORLD, "lost_request", "lost_reply", "late_reply"),
    "write": (*HOST, *WORLD, *WIRE, "flip_write"),
    "command": (*HOST, *WORLD, *WIRE),
    "question": (*HOST, *WORLD, "no_answer"),
    "journal": JOURNAL,
}
LATE = {"late_request": 3, "later_request": 6}
"""A late request arrives after so many others."""
CHUNK_WORDS = 14
OWNER = 0x00070000
FOREIGN = 0x00990001


class Crash(Exception):  # noqa: N818
    """The process is gone."""


class NoAnswer(Exception):  # noqa: N818
    """No valid reply came."""


class JournalFails(Exception):  # noqa: N818
    """The disk does not take an entry."""


@dataclass(frozen=True, slots=True)
class Case:
    """What is pushed and how it would go without faults."""

    name: str = "good"
    reasons: tuple[str, ...] = ()
    approved: str = "yes"
    verify: bool = True
    level: int = 3
    attended: bool = False
    compares: bool = True
    one_bank: bool = False
    stages: bool = False
    forgets: bool = True
    base_bank: int = 0
    machine_sign: int = 1
    approval_s: float = 1e6
    lease_ms: int = 60000
    """What is left of a lease whenever somebody looks."""
    still_s: float = 5.0
    """How long the axes have stood."""
    end: str = "KEEP"
    """How it ends without any fault."""


class World:
    """One controller, one journal, one process at a time; ``plan`` says which operation goes wrong how."""

    checks = CHECKS

    def __init__(self, protocol: SimpleNamespace, case: Case, plan: dict[int, str]) -> None:
        self.p, self.case, self.plan = protocol, case, plan
        factory, self.base, self.candidate = images(protocol.codec)
        size = len(self.candidate)
        pad = self.base + bytes(size - len(self.base))
        banks = [pad, bytes(size)] if case.base_bank == 0 else [factory + bytes(size - len(factory)), pad]
        self.ctl = c.Controller(banks, factory, compares=case.compares, one_bank=case.one_bank, active=case.base_bank)
        self.ctl.stages, self.ctl.forgets = case.stages, case.forgets
        self.ctl.states = [c.SEALED, c.SEALED if case.base_bank else c.EMPTY]
        for bank in (0, 1):
            if self.ctl.states[bank] == c.SEALED:
                self.ctl.crc[bank] = c.zlib.crc32(self.ctl.content(bank))
        self.ctl.ack = 41
        self.journal: tuple[Any, ...] = ()
        self.n = 0
        self.kinds: list[str] = []
        self.late: list[tuple[int, Any]] = []
        self.events: list[tuple] = []
        self.bad_instants: list[str] = []
        self.allowed = {self.base, self.candidate, factory}
        self.process = 0
        self.last_look: tuple[Any, bytes] | None = None
        self.time_s = 0.0
        self.trace = self.ctl.trace = self.events  # one order of everything
        self.ops_since_quiet = 0
        self.ops_after_quiet = self.n_before_judging = 0
        self.gen_of_edit: dict[int, int] = {}
        self.idempotent = self.settled = False
        self.foreign = FOREIGN

    # ---- faults -------------------------------------------------------------------------------------------------------------

    def step(self, kind: str) -> str:
        """Number one more operation; the fault that is planned for it, if it fits."""
        fault = self.plan.get(self.n, "")
        self.n += 1
        self.kinds.append(kind)
        self.ops_since_quiet += 1
        self.time_s += 0.01
        if fault and fault not in FAULTS[kind]:
            fault = ""
        if fault == "crash_before":
            raise Crash
        return fault

    def request(self, kind: str, do: Any, garble: Any = None) -> Any:
        """One request on the wire."""
        fault = self.step(kind)
        self.deliver_late()
        if fault in WORLD:
            self.happens(fault)
            if fault.startswith("reboot"):
                self.instant()
                raise NoAnswer("connection lost")
        if fault == "lost_request":
            raise NoAnswer("timeout")
        if fault in LATE:
            self.late.append((self.n + LATE[fault], do))
            raise NoAnswer("timeout")
        answer = do() if fault != "flip_write" else garble()
        if fault == "duplicate":
            do()
        self.instant()
        if fault == "crash_after":
            raise Crash
        if fault in ("lost_reply", "late_reply"):  # with transaction numbers a late reply is thrown away when it comes
            raise NoAnswer("timeout")
        if fault == "flip_read":
            return garble(answer)
        return answer

    def deliver_late(self) -> None:
        due = [do for at, do in self.late if at <= self.n]
        self.late = [(at, do) for at, do in self.late if at > self.n]
        for do in due:
            do()
            self.instant()

    def happens(self, fault: str) -> None:
        ctl = self.ctl
        if fault.startswith("reboot"):
            self.late.clear()
            ctl.reboot(fault.removeprefix("reboot_"))
        elif fault == "hand_active":
            ctl.hand_edit(ctl.active, sealed=True)
        elif fault in ("hand_inactive", "hand_sealed"):
            ctl.hand_edit(1 - ctl.active, sealed=fault == "hand_sealed")
            self.gen_of_edit[1 - ctl.active] = ctl.gen
        elif fault == "hand_switch":
            ctl.hand_switch()
        elif fault == "estop":
            ctl.estop = True
        elif fault == "foreign_lease":
            ctl.owner = ctl.owner or FOREIGN
        else:
            ctl.owner = 0
        self.instant()

    def instant(self) -> None:
        """I1, at every instant: what is in force was verified in full, or a person set it."""
        if self.ctl.in_force not in self.allowed and self.ctl.in_force not in self.ctl.human:
            self.bad_instants.append(f"operation {self.n - 1}")

    # ---- the port -----------------------------------------------------------------------------------------------------------

    async def execute(self, op: Any, journal: tuple[Any, ...]) -> Any:
        o = self.p.operations
        last = self.journal[-1] if self.journal else None
        self.events.append(("issue", op.kind.name, op, last.state if last else None, last, self.process, self.last_look))
        try:
            return getattr(self, f"_{op.kind.name.lower()}")(op)
        except NoAnswer as error:
            self.events.append(("doubt", self.process))
            return o.Unanswered(str(error))

    def _look(self, op: Any) -> Any:
        def do() -> Any:
            ctl = self.ctl
            truth = self.p.operations.Truth(
                ctl.boot, ctl.gen, ctl.active, tuple(ctl.crc), tuple(ctl.states), ctl.owner,
                self.case.lease_ms if ctl.owner else 0, "the e-stop is pressed" if ctl.estop else "", self.case.still_s, self.time_s,
                "map 1",
            )  # fmt: skip
            self.last_look = (truth, ctl.in_force)
            return truth

        truth = self.request("look", do)
        self.boot = truth.boot
        return self.p.operations.Done(truth)

    def _take(self, bank: int, first: int, count: int, note: str) -> bytes:
        def do() -> bytes:
            ctl = self.ctl
            n = 2 * count or c.length_of(ctl.banks[bank])
            data = ctl.banks[bank][2 * first : 2 * first + n]
            if note:
                self.events.append((note, bank, ctl.boot, ctl.gen, data, self.process))
            return data

        return self.request("read", do, lambda data: data[:-2] + bytes([data[-2] ^ 1, data[-1]]) if data else data)

    def _read(self, op: Any) -> Any:
        data = self._take(op.bank, 0, op.count, "read")
        return self.p.operations.Done(data) if data else self.p.operations.OperationRefused("no image")

    def _read_again(self, op: Any) -> Any:
        data = self._take(op.bank, 0, op.count, "read_again")
        return self.p.operations.Done(meanings(self.p.execute)(data))

    def _read_chunk(self, op: Any) -> Any:
        return self.p.operations.Done(self._take(op.bank, op.first, op.count, ""))

    def _write(self, op: Any) -> Any:
        ctl = self.ctl
        bad = op.data[:-1] + bytes([op.data[-1] ^ 2])
        result = self.request("write", lambda: ctl.write(op.bank, op.first, op.data), lambda: ctl.write(op.bank, op.first, bad))
        return self.p.operations.Done() if result == c.OK else self.p.operations.OperationRefused("the bank is active")

    def _command(self, command: int, op: Any) -> Any:
        """As drivers/links/words.py does: ask the number, send once, let the acknowledge decide."""
        o, ctl = self.p.operations, self.ctl
        boot, ack = self.request("look", lambda: (ctl.boot, ctl.ack))
        if boot != self.boot:
            return o.OperationRefused("the controller restarted")
        number, doubt = (ack + 1) & 0xFFFF, False
        try:
            self.request("command", lambda: ctl.command(number, command, op.bank, op.crc, op.gen, op.owner))
        except NoAnswer:
            doubt = True
        boot, ack, result = self.request("look", lambda: (ctl.boot, ctl.ack, ctl.result))
        if doubt and boot != self.boot:
            return o.Unanswered("the controller restarted")
        if ack != number:
            return o.Unanswered("not acknowledged")
        return o.Done() if result == c.OK else o.OperationRefused(f"result {result}")

    def _lease(self, op: Any) -> Any:
        return self._command(c.LEASE, op)

    def _release(self, op: Any) -> Any:
        return self._command(c.RELEASE, op)

    def _seal(self, op: Any) -> Any:
        return self._command(c.SEAL, op)

    def _activate(self, op: Any) -> Any:
        return self._command(c.ACTIVATE, op)

    # ---- people -------------------------------------------------------------------------------------------------------------

    def _question(self, answer: Any) -> Any:
        fault = self.step("question")
        self.deliver_late()
        if fault in WORLD:
            self.happens(fault)
        if fault == "no_answer":
            raise NoAnswer("no answer")
        done = self.p.operations.Done(answer())
        if fault == "crash_after":
            raise Crash
        return done

    def _validate(self, op: Any) -> Any:
        return self.p.operations.Done(list(self.case.reasons))

    def _approve(self, op: Any) -> Any:
        if self.case.approved == "no":
            return self.p.operations.OperationRefused("no")
        f = self.p.journal.facts(self.journal)
        if self.case.approved == "another table":
            f = replace(f, image=self.base)
        if self.case.approved == "another base":
            f = replace(f, base_image=self.candidate)
        digest = f.binding("then")
        return self._question(lambda: self.p.operations.Approval(digest, "a person", "then", self.time_s + self.case.approval_s))

    def _probe(self, op: Any) -> Any:
        return self._question(self._probed)

    def _probed(self) -> Any:
        """What the machine does with the bytes in force, by the machine's own reading: the last value of Z over Z, added to the command."""
        moved = self.case.machine_sign * int.from_bytes(self.ctl.in_force[-2:], "big", signed=True)
        wanted = round(float(tables(55).correction_mm[2][1, 2]) * 1e4)
        self.events.append(("probed", self.ctl.in_force, moved == wanted))
        return self.p.operations.VerificationResult(moved == wanted and not self.ctl.estop, f"moved {moved}, wanted {wanted}")

    def _verify(self, op: Any) -> Any:
        return self._question(self._verified)

    def _verified(self) -> Any:
        good = self.case.verify and self.ctl.in_force == self.candidate and not self.ctl.estop
        self.events.append(("verified", self.ctl.in_force, good))
        return self.p.operations.VerificationResult(good, "better" if good else "not better")

    # ---- the journal --------------------------------------------------------------------------------------------------------

    async def entries(self) -> tuple[Any, ...]:
        return self.journal

    async def append(self, journal: tuple[Any, ...], state: Any, doc: dict[str, Any]) -> Any:
        fault = self.step("journal")
        if fault == "journal_fails":
            raise JournalFails
        head = self.journal[-1].digest if self.journal else GENESIS
        entry = self.p.journal.follow(journal, 1, state, doc, utc="2026-01-01T00:00:00Z", head=head, machine="M")
        if len(journal) != len(self.journal):
            raise JournalFails("somebody else wrote an entry")
        self.journal = (*self.journal, entry)
        if not journal and self.last_look:
            self.base = self.last_look[1]  # what the controller really had in force when the snapshot was taken
        self.events.append(("record", entry, self.last_look, self.ctl.in_force, self.process))
        if fault == "crash_after":
            raise Crash
        return entry

    # ---- processes ----------------------------------------------------------------------------------------------------------

    def order(self) -> Any:
        case = self.case
        meaning = self.p.execute.semantic_digest_of_tables(tables(55))
        return self.p.journal.OperationOrder(
            "M", self.candidate, c.zlib.crc32(self.candidate), meaning, "limits", OWNER, case.level, case.attended, CHUNK_WORDS
        )

    def live(self, coroutine: Coroutine[Any, Any, Any]) -> Any:
        """Let one process live until it ends or dies."""
        self.process += 1
        self.boot = self.ctl.boot
        try:
            coroutine.send(None)
        except StopIteration as end:
            return end.value
        except (Crash, JournalFails):
            return None
        raise AssertionError("the model never waits")

    def run(self, most: int = 6) -> list[str]:
        """Push; after every death recover; then the faults stop, people make the machine ready, and it has to come to an end."""
        ended = self.live(self.p.execute.push(self, self, self.order()))
        lives = 0
        while (ended is None or not ended.settled) and lives < most:
            lives += 1
            last_fault = max(self.plan, default=-1)
            if self.n > last_fault or lives >= 3:
                self.quiet()
            ended = self.live(self.p.execute.recover(self, self))
        return self.judge(ended)

    def kinds_of_run(self) -> list[str]:
        """Run, and give the kinds of all operations: where a further fault can hit."""
        self.run()
        return self.kinds[: self.n_before_judging]

    def quiet(self) -> None:
        """Faults stop; whoever pressed the e-stop releases it; another's lease ends."""
        self.plan = {}
        self.ctl.estop = False
        if self.ctl.owner == FOREIGN:
            self.ctl.owner = 0
        self.ops_since_quiet = 0

    def judge(self, ended: Any) -> list[str]:
        self.ops_after_quiet, self.n_before_judging = self.ops_since_quiet, self.n
        self.quiet()
        self.n += max(LATE.values())
        self.deliver_late()
        before, writes = len(self.journal), self.n_changes()
        again = self.live(self.p.execute.recover(self, self)) if self.journal else ended
        idempotent = len(self.journal) == before and self.n_changes() == writes
        return violations(self, ended, again, idempotent=idempotent)

    def n_changes(self) -> int:
        return sum(1 for event in self.events if event[0] in ("write", "activated"))
