"""The two compensation banks: lease, writing, sealing, compare-and-swap, and tables that wait for the control's restart."""

from __future__ import annotations

from enum import IntEnum
from typing import Protocol

import image
from files import TableSets
from network import Network


class Result(IntEnum):
    """Result of a compensation command, as in the register COMP_RESULT."""

    OK = 0
    BAD_ARGUMENT = 1
    INTERLOCK = 2
    CRC_DIFFERS = 3
    GEN_DIFFERS = 4
    BANK_ACTIVE = 5
    NOT_AN_IMAGE = 6
    LEASED = 7
    RESTART = 8


class State(IntEnum):
    """State of a bank, as in the register BANK_STATE."""

    EMPTY = 0
    WRITING = 1
    SEALED = 2
    STAGED = 3


class Networks(Protocol):
    """The control's live correction networks."""

    def load(self, bank: int, network: Network) -> bool:
        """Set the values of the network that is not active; return True if every value reads back."""

    def select(self, bank: int) -> bool:
        """Make a network act; return True if the control confirms it."""


class Banks:
    """Two banks in front of a control.

    Parameters
    ----------
    networks : Networks
        Destination of tables that act at once.
    sets : TableSets
        Destination of tables that act after a restart.
    acting : list of int
        Image of the files that the running control read at its start; first content of bank 0.

    Raises
    ------
    RuntimeError
        The control does not take the values.
    """

    def __init__(self, networks: Networks, sets: TableSets, acting: list[int]) -> None:
        self._networks, self._sets = networks, sets
        self._at_start = acting
        self.plan = image.plan(acting)
        self._files = self.plan.files
        self.words = [acting + [0] * (image.BANK_WORDS - len(acting)), [0] * image.BANK_WORDS]
        self.states = [State.SEALED, State.EMPTY]
        self.crcs = [image.checksum(acting), 0]
        self.active = 0
        self.generation = 1
        self._owner, self._lease_end_s = 0, 0.0
        if not (networks.load(0, self.plan.network) and networks.select(0) and networks.load(1, Network())):
            raise RuntimeError("the control's network does not take values: does volumetric.hal belong to this bridge?")

    def write(self, bank: int, offset: int, words: list[int]) -> bool:
        """Write words into a bank; if that bank is the acting one or the words do not fit, do nothing and return False."""
        if bank == self.active or not 0 <= offset <= image.BANK_WORDS - len(words):
            return False
        self._unstage(bank)
        self.words[bank][offset : offset + len(words)] = words
        self.states[bank], self.crcs[bank] = State.WRITING, 0
        self.generation += 1
        return True

    def owner(self, now_s: float) -> int:
        """Owner of the lease; 0: nobody."""
        return self._owner if now_s < self._lease_end_s else 0

    def lease_left_ms(self, now_s: float) -> int:
        """Remaining time of the lease, ms."""
        return int((self._lease_end_s - now_s) * 1000) if self.owner(now_s) else 0

    def lease(self, owner: int, lease_ms: int, now_s: float) -> Result:
        """Take or extend the lease."""
        if not owner or not lease_ms:
            return Result.BAD_ARGUMENT
        if self.owner(now_s) not in (0, owner):
            return Result.LEASED
        self._owner, self._lease_end_s = owner, now_s + lease_ms / 1000
        return Result.OK

    def release(self, owner: int, now_s: float) -> Result:
        """Release the lease."""
        if self.owner(now_s) not in (0, owner):
            return Result.LEASED
        self._owner = 0
        return Result.OK

    def seal(self, bank: int, owner: int, now_s: float) -> Result:
        """Check that the control can reproduce the bank's image, and fix its CRC."""
        refusal = self._refusal(bank, owner, now_s)
        if refusal:
            return refusal
        try:
            image.plan(self.words[bank])
        except image.ImageError:
            return Result.NOT_AN_IMAGE
        if self.states[bank] not in (State.SEALED, State.STAGED):
            self.states[bank], self.crcs[bank] = State.SEALED, image.checksum(self.words[bank])
            self.generation += 1
        return Result.OK

    def activate(self, bank: int, owner: int, expected: tuple[int, int], *, may_act: bool, now_s: float) -> Result:
        """Make a sealed bank act if its CRC and the generation are the ``expected`` ones.

        If the table's files differ from those that the control read at its start, the table is only stored for the next start, and the
        result is ``RESTART``.
        """
        refusal = self._refusal(bank, owner, now_s)
        if refusal:
            return refusal
        if self.states[bank] not in (State.SEALED, State.STAGED):
            return Result.NOT_AN_IMAGE
        if expected[0] != self.crcs[bank]:
            return Result.CRC_DIFFERS
        if expected[1] != self.generation:
            return Result.GEN_DIFFERS
        if not may_act:
            return Result.INTERLOCK
        plan = image.plan(self.words[bank])
        if plan.files != self._files:
            return self._stage(bank)
        if not (self._networks.load(bank, plan.network) and self._networks.select(bank)):
            self._networks.select(self.active)
            return Result.INTERLOCK
        self.active, self.plan = bank, plan
        self.generation += 1
        return Result.OK

    def _stage(self, bank: int) -> Result:
        if self.states[bank] != State.STAGED:
            self._sets.stage(self.words[bank][: image.length_of(self.words[bank])])
            self.states[bank] = State.STAGED
            self.generation += 1
        return Result.RESTART

    def _unstage(self, bank: int) -> None:
        if self.states[bank] == State.STAGED:
            self._sets.stage(self._at_start)

    def _refusal(self, bank: int, owner: int, now_s: float) -> Result:
        if bank not in (0, 1):
            return Result.BAD_ARGUMENT
        if not owner or self.owner(now_s) != owner:
            return Result.LEASED
        return Result.BANK_ACTIVE if bank == self.active else Result.OK
