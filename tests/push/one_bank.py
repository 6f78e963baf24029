"""A control with one table, and the world of the push protocol around it.

The weaker forms of invariants that such a control can keep stand in `WEAKER`, each with its reason; all others are those of two banks.
"""

from __future__ import annotations

import zlib
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from abbe.drivers.api import NOTHING_HOLDS, Condition, ControllerStatus, TableState
from abbe.drivers.errors import DriverError, Refused, ReplyTimeout
from tests.push import invariants
from tests.push.content import images, meanings
from tests.push.controller import length_of
from tests.push.world import CHUNK_WORDS, FAULTS, Case, NoAnswer, World

READY = NOTHING_HOLDS | Condition.REMOTE | Condition.REFERENCED | Condition.DRIVES_ON | Condition.IN_POSITION
NOTHING = b""
"""What is in force while compensation is off."""
NOT_HERE = ("foreign_lease", "lease_ends")
"""Faults of a lease, which this control has not."""


@dataclass(slots=True)
class OneTable:
    """``compares``, ``guards``: what variants take away: a switch compares the CRC; writes are refused while the table acts."""

    store: bytes
    factory: bytes
    acts: bool = True
    boot: int = 1000
    ack: int = 41
    result: bool = True
    estop: bool = False
    compares: bool = True
    guards: bool = True
    owner: int = 0
    edits: int = 0
    human: set[bytes] = field(default_factory=set)
    trace: list[tuple] = field(default_factory=list)

    @property
    def content(self) -> bytes:
        n = length_of(self.store)
        return self.store[:n] if n else self.store

    @property
    def in_force(self) -> bytes:
        return self.content if self.acts else NOTHING

    def write(self, first: int, data: bytes) -> bool:
        refused = self.acts and self.guards
        self.trace.append(("write", 0, self.acts, refused))
        if not refused:
            self.store = self.store[: 2 * first] + data + self.store[2 * first + len(data) :]
        return not refused

    def command(self, number: int, on: bool, crc: int) -> None:
        if number != (self.ack + 1) & 0xFFFF:
            return
        self.ack = number
        self.result = not self.compares or (crc == zlib.crc32(self.content) and on != self.acts)
        if self.result and on != self.acts:
            self.acts = on
            self.trace.append(("switched", on, self.content))

    def reboot(self, what: str) -> None:
        """The table and its switch persist, or all is as it left the factory."""
        self.boot += 1
        self.ack = 0
        if what == "factory":
            self.store, self.acts = self.factory + self.store[len(self.factory) :], True
        self.trace.append(("reboot",))

    def hand_edit(self) -> None:
        n, self.edits = len(self.content) - 3, self.edits + 1
        self.store = self.store[:n] + bytes([self.store[n] ^ (2 << self.edits)]) + self.store[n + 1 :]
        self.trace.append(("hand", self.content, self.acts))
        if self.acts:
            self.human.add(self.in_force)

    def hand_switch(self) -> None:
        self.acts = not self.acts
        self.trace.append(("hand switch", self.in_force))
        self.human.add(self.in_force)


class OneBankWorld(World):
    """The same processes, journal, people and faults; `abbe.drivers.one_bank` between the push machine and the control."""

    def __init__(self, protocol: Any, case: Case, plan: dict[int, str]) -> None:
        super().__init__(protocol, case, plan)
        factory, self.base, self.candidate = images(protocol.codec)
        pad = self.base + bytes(len(self.candidate) - len(self.base) + 8)
        self.ctl = OneTable(pad, factory, compares=case.compares, guards=not case.one_bank, trace=self.events)
        self.allowed |= {NOTHING}
        self.tables: Any = None
        self.faults = tuple(plan.values())
        self.seen = self.base

    checks = invariants.CHECKS

    def live(self, coroutine: Any) -> Any:
        self.tables = self.p.one_bank.OneBankTables(self, chunk_words=CHUNK_WORDS)  # memory of one process
        return super().live(coroutine)

    def step(self, kind: str) -> str:
        """I18 counts from the last fault on, not from the beginning."""
        fault = super().step(kind)
        self.ops_since_quiet = 0 if fault else self.ops_since_quiet
        return fault

    def request(self, kind: str, do: Any, garble: Any = None) -> Any:
        """As a driver reports it."""
        try:
            return super().request(kind, do, garble)
        except NoAnswer as error:
            raise ReplyTimeout("one table", kind, str(error)) from error

    def happens(self, fault: str) -> None:
        if fault.startswith("reboot"):
            self.late.clear()
            self.ctl.reboot(fault.removeprefix("reboot_"))
        elif fault.startswith("hand_") and fault != "hand_switch":
            self.ctl.hand_edit()
        elif fault == "hand_switch":
            self.ctl.hand_switch()
        elif fault == "estop":
            self.ctl.estop = True
        self.instant()

    # ---- the control, as its driver shows it (`abbe.drivers.api.OneBank`)

    async def status(self) -> ControllerStatus:
        holds = READY | Condition.ESTOP if self.ctl.estop else READY
        return self.request("look", lambda: ControllerStatus(self.time_s, 9_000_000, holds, (0.0, 0.0, 0.0), 0, 0, 0, 100, 0))

    async def table_state(self) -> TableState:
        def do() -> TableState:
            self.seen = self.ctl.in_force
            return TableState(self.ctl.boot, self.ctl.acts)

        return self.request("look", do)

    async def read_table(self) -> bytes:
        def do() -> bytes:
            self.events.append(("store read", self.ctl.store, self.process))
            return self.ctl.store

        return self.request("read", do, lambda data: data[:-12] + bytes([data[-12] ^ 1]) + data[-11:])

    async def write_table(self, data: bytes, *, first: int) -> None:
        bad = data[:-1] + bytes([data[-1] ^ 2])
        self.events.append(("write sent", self.process))
        if not self.request("write", lambda: self.ctl.write(first, data), lambda: self.ctl.write(first, bad)):
            raise Refused("one table", "write", "the table acts")

    async def switch(self, *, on: bool, expect_crc: int) -> None:
        ctl = self.ctl
        self.events.append(("switch sent", on, self.process, ctl.estop))
        boot, ack = self.request("look", lambda: (ctl.boot, ctl.ack))
        number = (ack + 1) & 0xFFFF
        with suppress(ReplyTimeout):  # the acknowledge decides
            self.request("command", lambda: ctl.command(number, on, expect_crc))
        now, ack, result = self.request("look", lambda: (ctl.boot, ctl.ack, ctl.result))
        if now != boot or ack != number:
            raise ReplyTimeout("one table", "switch", "not acknowledged")
        if not result:
            raise Refused("one table", "switch", "the CRC is another one, or it is switched so already")

    # ---- the port

    async def execute(self, op: Any, journal: tuple[Any, ...]) -> Any:
        o = self.p.operations
        last = self.journal[-1] if self.journal else None
        self.events.append(("issue", op.kind.name, op, last.state if last else None, last, self.process, self.last_look))
        try:
            return await self._do(op)
        except Refused as error:
            return o.OperationRefused(str(error))
        except (NoAnswer, DriverError) as error:
            self.events.append(("doubt", self.process))
            return o.Unanswered(str(error))

    async def _do(self, op: Any) -> Any:
        o, kind, t = self.p.operations, op.kind.name, self.tables
        if kind == "LOOK":
            return o.Done(await self._truth())
        if kind in ("READ", "READ_AGAIN", "READ_CHUNK"):
            data = await t.read_bank(op.bank, 2 * op.count or None, first=op.first)
            self.events.append((kind.lower(), op.bank, 0, 0, data, self.process))
            return o.Done(meanings(self.p.execute)(data) if kind == "READ_AGAIN" else data)
        if kind in ("VALIDATE", "APPROVE", "PROBE", "VERIFY"):
            return getattr(self, f"_{kind.lower()}")(op)
        calls = {
            "LEASE": lambda: t.lease(op.owner, 60000), "RELEASE": lambda: t.release(op.owner), "SEAL": lambda: t.seal(op.bank, op.owner),
            "WRITE": lambda: t.write_bank(op.bank, op.data, first=op.first),
            "ACTIVATE": lambda: t.activate(op.bank, expect_crc=op.crc, expect_gen=op.gen, owner=op.owner),
        }  # fmt: skip
        await calls[kind]()
        return o.Done()

    async def _truth(self) -> Any:
        comp = await self.tables.comp_status()
        status = await self.status()
        self.boot = comp.boot_id
        truth = self.p.operations.Truth(
            comp.boot_id, comp.gen, comp.active_bank, comp.bank_crc, comp.bank_state, comp.lease_owner,
            self.case.lease_ms if comp.lease_owner else 0, "the e-stop is pressed" if Condition.ESTOP in status.conditions else "",
            self.case.still_s, self.time_s, "map 1",
        )  # fmt: skip
        self.last_look = (truth, self.seen)
        return truth


# ---- what such a control can keep -----------------------------------------------------------------------------------------------------


def _switched_on(world: Any) -> list[int]:
    return [k for k, event in enumerate(world.events) if event[0] == "switched" and event[1]]


def i2_never_written_while_it_acts(world: Any) -> bool:
    return not any(acts and not refused for name, *rest in world.events if name == "write" for _, acts, refused in [rest])


def i3_interlocks_looked_at_before_each_exchange(world: Any) -> bool:
    """WEAKER: by us, before each switch; the control does not look at the instant of the switch."""
    return not any(look[0].unsafe for _, _, _, _, _, _, look in invariants._issued(world, "ACTIVATE"))


def i6_full_read_back_before_it_acts(world: Any) -> bool:
    """Before the table was switched on, the control's own was read in full and was that table."""
    for k in _switched_on(world):
        content = world.events[k][2]
        read = [event[1] for event in world.events[:k] if event[0] == "store read"]
        if not read or read[-1][: len(content)] != content:
            return False
    return True


def i7_approved_is_what_acts(world: Any) -> bool:
    acting = [world.events[k][2] for k in _switched_on(world)]
    return invariants.only_approved(world, [image for image in acting if image != world.base])


def i8_base_as_approved_when_exchanged(world: Any) -> bool:
    """What was switched off for the new table was the approved base: the control compares its CRC."""
    offs = [event for event in world.events if event[0] == "switched" and not event[1]]
    return not offs or offs[0][2] == world.base


def i10_terminal_agrees_with_controller(world: Any) -> bool:
    """And ABORTED leaves no table switched off by us."""
    ours_off = False
    for event in world.events:
        if event[0] in ("switched", "hand", "hand switch", "reboot"):
            ours_off = event[0] == "switched" and not event[1]
        elif event[0] == "record":
            state, seen = str(event[1].state), event[2][1] if event[2] else NOTHING
            if state == "KEEP" and seen != world.candidate:
                return False
            if state == "ABORTED" and (ours_off or (event[3] == world.candidate and world.candidate not in world.ctl.human)):
                return False
    return True


def i12_one_pusher(world: Any) -> bool:
    """WEAKER: there is no lease; one process at a time pushes, by the journal and the lock of the machine."""
    return True


def i13_hand_edits_survive(world: Any) -> bool:
    """WEAKER: content that a person wrote is not overwritten; a person's switching off after the exchange ends with the old table acting.

    As with two banks, what happens between a read and the next request cannot be seen.
    """
    edited: set[bytes] = set()
    n = len(world.base)  # what lies behind it is not restored, and not overwritten
    kept = world.ctl.human - {NOTHING, world.base, world.candidate}
    shown = exchanged = person_off = unsure = False
    for event in world.events:
        name = event[0]
        if name == "hand":
            edited |= {event[1][:n]} - {world.base[:n], world.candidate[:n]}
        elif name == "hand switch":
            person_off = event[1] == NOTHING and not exchanged and not unsure
        elif name == "reboot" or (name == "record" and str(event[1].state) == "SNAPSHOT"):
            edited.clear()
            shown = person_off = unsure = False
        elif name == "doubt" or (name == "issue" and event[5] > 1):
            unsure, person_off = True, False  # whether our own request switched it off is not known, nor to a process that did not send it
        elif name == "store read":
            shown = any(event[1].startswith(e) for e in edited)
        elif name == "switched":
            shown, exchanged = shown and event[1], True
            if (event[1] and person_off) or (not event[1] and event[2] in kept):
                return False
        elif name == "write sent" and shown:
            return False
    return True


def t1_taken_back(world: Any) -> bool:
    """Unless content came from elsewhere, nobody has to come: whatever interrupts an exchange, the old table acts in the end."""
    foreign = any(event[0].startswith("hand") for event in world.events) or {"flip_write", "reboot_factory"} & set(world.faults)
    return bool(foreign) or not world.journal or str(world.journal[-1].state) != "OPERATOR"


def i18_ends_in_bounded_time(world: Any) -> bool:
    """WEAKER: twice the requests of two banks (60 s), because each look reads the table twice, and going back writes it."""
    return bool(world.settled) and world.ops_after_quiet <= 2 * invariants.OPS_AFTER_QUIET


WEAKER = {
    "I2": i2_never_written_while_it_acts, "I3": i3_interlocks_looked_at_before_each_exchange, "I6": i6_full_read_back_before_it_acts,
    "I7": i7_approved_is_what_acts, "I8": i8_base_as_approved_when_exchanged,
    "I10": i10_terminal_agrees_with_controller, "I12": i12_one_pusher, "I13": i13_hand_edits_survive, "I18": i18_ends_in_bounded_time,
    "T1": t1_taken_back,
}  # fmt: skip
OneBankWorld.checks = invariants.CHECKS | WEAKER

CASES = (
    Case("one table, kept", level=1, attended=True),
    Case("one table, goes back", level=1, attended=True, verify=False, end="ROLLED_BACK"),
    Case("one table, wrong sign on the machine", level=1, attended=True, machine_sign=-1, end="ROLLED_BACK"),
    Case("one table, unattended", level=1, end="REJECTED"),
    Case("one table, not approved", level=1, attended=True, approved="no", end="REJECTED"),
    Case("one table, axes just come to rest", level=1, attended=True, still_s=0.99, end="ABORTED"),
)
KINDS = {kind: tuple(f for f in faults if f not in NOT_HERE) for kind, faults in FAULTS.items()}
