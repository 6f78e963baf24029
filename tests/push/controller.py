"""A controller as docs/protocols/cnc.md promises it, pure and small: two banks, generation, boot id, numbered commands, lease, interlocks.

Written for the model of the push protocol; it shares nothing with the simulators. Everything that happens to it is noted.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field

from abbe.drivers.api import BankState

EMPTY, WRITING, SEALED, STAGED = BankState.EMPTY, BankState.WRITING, BankState.SEALED, BankState.LAID_ASIDE
OK, BAD, INTERLOCK, CRC, GEN, ACTIVE, IMAGE, LEASED, RESTART = range(9)
SEAL, ACTIVATE, LEASE, RELEASE = 1, 2, 3, 4


def length_of(image: bytes) -> int:
    """Bytes of the image that a bank begins with; 0 if none does."""
    if image[:2] != b"\xab\xbe":
        return 0
    return 2 * int.from_bytes(image[6:8], "big")


@dataclass(slots=True)
class Controller:
    """Banks are bytes of one size. ``compares``, ``one_bank``: what the variants take away.

    ``stages``: a new table is only laid aside, and acts after the next start. ``forgets``: unless somebody writes into its bank.
    ``deaf``: it is read, and does nothing.
    """

    banks: list[bytes]
    factory: bytes
    states: list[BankState] = field(default_factory=lambda: [SEALED, EMPTY])
    crc: list[int] = field(default_factory=lambda: [0, 0])
    active: int = 0
    gen: int = 1
    boot: int = 1000
    ack: int = 0
    result: int = OK
    owner: int = 0
    estop: bool = False
    compares: bool = True
    one_bank: bool = False
    stages: bool = False
    forgets: bool = True
    deaf: bool = False
    human: set[bytes] = field(default_factory=set)
    trace: list[tuple] = field(default_factory=list)

    def content(self, bank: int) -> bytes:
        """The image in a bank; everything it holds if that is none."""
        n = length_of(self.banks[bank])
        return self.banks[bank][:n] if n else self.banks[bank]

    @property
    def in_force(self) -> bytes:
        return self.content(self.active)

    # ---- the wire -----------------------------------------------------------------------------------------------------------

    def write(self, bank: int, first: int, data: bytes) -> int:
        refused = bank == self.active and not self.one_bank
        self.trace.append(("write", bank, bank == self.active, refused))
        if refused:
            return ACTIVE
        if self.states[bank] == STAGED and not self.forgets:
            return OK
        whole = self.banks[bank]
        self.banks[bank] = whole[: 2 * first] + data + whole[2 * first + len(data) :]
        self.states[bank], self.crc[bank] = WRITING, 0
        self.gen += 1
        return OK

    def command(self, number: int, command: int, bank: int, crc: int, gen: int, owner: int) -> None:
        if self.deaf or number != (self.ack + 1) & 0xFFFF:
            return
        self.ack, self.result = number, self._execute(command, bank, crc, gen, owner)

    def _execute(self, command: int, bank: int, crc: int, gen: int, owner: int) -> int:
        if command == LEASE:
            if self.owner not in (0, owner):
                return LEASED
            self.owner = owner
            self.trace.append(("leased", owner))
            return OK
        if command == RELEASE:
            if self.owner not in (0, owner):
                return LEASED
            self.owner = 0
            return OK
        if self.owner != owner:
            return LEASED
        if bank == self.active and not self.one_bank:
            return ACTIVE
        return self._seal(bank) if command == SEAL else self._activate(bank, crc, gen, owner)

    def _seal(self, bank: int) -> int:
        if not length_of(self.banks[bank]):
            return IMAGE
        if self.states[bank] != SEALED:
            self.states[bank], self.crc[bank] = SEALED, zlib.crc32(self.content(bank))
            self.gen += 1
        return OK

    def _activate(self, bank: int, crc: int, gen: int, owner: int) -> int:
        if self.states[bank] != SEALED:
            return IMAGE
        if self.compares:
            if crc != self.crc[bank]:
                return CRC
            if gen != self.gen:
                return GEN
            if self.estop:
                return INTERLOCK
        if self.stages:
            self.states[bank] = STAGED
            return RESTART
        self.trace.append(("activated", bank, self.content(bank), self.in_force, self.boot, self.gen, self.estop, owner, self.owner))
        self.active = bank
        self.gen += 1
        return OK

    # ---- what people and the world do to it ------------------------------------------------------------------------------------

    def reboot(self, what: str) -> None:
        """``keep``: both banks persist; ``inactive``: the inactive bank is lost; ``factory``: everything is."""
        self.boot += 1
        if self.states[1 - self.active] == STAGED:
            self.states[1 - self.active], self.active = SEALED, 1 - self.active
        self.ack, self.result, self.owner = 0, OK, 0
        if what == "inactive":
            self._lose(1 - self.active)
        elif what == "factory":
            self.active, self.gen = 0, 1
            self.banks[0] = self.factory + self.banks[0][len(self.factory) :]
            self.states[0], self.crc[0] = SEALED, zlib.crc32(self.factory)
            self._lose(1)
        self.trace.append(("reboot",))

    def _lose(self, bank: int) -> None:
        self.banks[bank], self.states[bank], self.crc[bank] = bytes(len(self.banks[bank])), EMPTY, 0

    def hand_edit(self, bank: int, *, sealed: bool) -> None:
        """Somebody at the panel changes one value of a bank; in the active one it acts at once."""
        if not length_of(self.banks[bank]):
            return
        n = len(self.content(bank)) - 3
        whole = self.banks[bank]
        self.banks[bank] = whole[:n] + bytes([whole[n] ^ 4]) + whole[n + 1 :]
        self.gen += 1
        sealed = sealed or bank == self.active
        self.states[bank], self.crc[bank] = (SEALED, zlib.crc32(self.content(bank))) if sealed else (WRITING, 0)
        if bank == self.active:
            self.human.add(self.in_force)
        self.trace.append(("hand", bank, bank == self.active))

    def hand_switch(self) -> None:
        """Somebody at the panel makes the other bank the active one."""
        if self.states[1 - self.active] == SEALED:
            self.active = 1 - self.active
            self.gen += 1
            self.human.add(self.in_force)
            self.trace.append(("hand", self.active, True))
