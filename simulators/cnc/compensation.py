"""The controller's two compensation banks: writing, sealing, activating, and the lease that guards them."""

from enum import IntEnum

from abbe.simulators.cnc import bank


class CompResult(IntEnum):
    """Result of a compensation command, as in the register COMP_RESULT."""

    OK = 0
    BAD_ARGUMENT = 1
    INTERLOCK = 2
    CRC_DIFFERS = 3
    GEN_DIFFERS = 4
    BANK_ACTIVE = 5
    NOT_AN_IMAGE = 6
    LEASED = 7


class BankState(IntEnum):
    """State of a bank, as in the register BANK_STATE."""

    EMPTY = 0
    WRITING = 1
    SEALED = 2


class Compensation:
    """Banks, their generation (register GEN) and the lease. Times are controller seconds.

    ``lease_scale``: controller seconds per second of the lease. A lease guards against a host that died, so it runs in wall time, however
    fast the simulated world runs.
    """

    def __init__(self, lease_scale: float = 1.0) -> None:
        image = bank.empty_image()
        self.words = [image + [0] * (bank.BANK_WORDS - len(image)), [0] * bank.BANK_WORDS]
        self.states = [BankState.SEALED, BankState.EMPTY]
        self.crcs = [bank.checksum(image), 0]
        self.active = 0
        self.generation = 1
        self.kind, self.correction = bank.parse(image)
        self._scale = lease_scale
        self._owner = 0
        self._lease_end_s = 0.0

    def write(self, number: int, offset: int, values: list[int]) -> bool:
        """Write words into a bank; do nothing and return False if the bank is active or the words do not fit."""
        if number == self.active or offset < 0 or offset + len(values) > bank.BANK_WORDS:
            return False
        self.words[number][offset : offset + len(values)] = values
        self.states[number], self.crcs[number] = BankState.WRITING, 0
        self.generation += 1
        return True

    def owner(self, now_s: float) -> int:
        """Return the holder of the lease, 0 = free."""
        return self._owner if now_s < self._lease_end_s else 0

    def lease_left_ms(self, now_s: float) -> int:
        """Return the remaining time of the lease, in milliseconds of wall time."""
        return int(1000.0 * (self._lease_end_s - now_s) / self._scale) if self.owner(now_s) else 0

    def lease(self, owner: int, lease_ms: int, now_s: float) -> CompResult:
        """Take or renew the lease."""
        if owner == 0 or lease_ms == 0:
            return CompResult.BAD_ARGUMENT
        if self.owner(now_s) not in (0, owner):
            return CompResult.LEASED
        self._owner, self._lease_end_s = owner, now_s + lease_ms * 1e-3 * self._scale
        return CompResult.OK

    def release(self, owner: int, now_s: float) -> CompResult:
        """Release the lease."""
        if self.owner(now_s) not in (0, owner):
            return CompResult.LEASED
        self._owner = 0
        return CompResult.OK

    def seal(self, number: int, owner: int, now_s: float) -> CompResult:
        """Check the image in a bank and store its CRC."""
        refusal = self._refuse(number, owner, now_s)
        if refusal:
            return refusal
        words = self.words[number]
        try:
            bank.parse(words)
        except bank.ImageError:
            return CompResult.NOT_AN_IMAGE
        if self.states[number] != BankState.SEALED:
            self.states[number], self.crcs[number] = BankState.SEALED, bank.checksum(words)
            self.generation += 1
        return CompResult.OK

    def activate(self, number: int, owner: int, expected: tuple[int, int], *, may_act: bool, now_s: float) -> CompResult:
        """Make a sealed bank the active one if its CRC and GEN are ``expected``; ``may_act``: the machine stands still, interlocks hold."""
        refusal = self._refuse(number, owner, now_s)
        if refusal:
            return refusal
        if self.states[number] != BankState.SEALED:
            return CompResult.NOT_AN_IMAGE
        if expected[0] != self.crcs[number]:
            return CompResult.CRC_DIFFERS
        if expected[1] != self.generation:
            return CompResult.GEN_DIFFERS
        if not may_act:
            return CompResult.INTERLOCK
        self.kind, self.correction = bank.parse(self.words[number])
        self.active = number
        self.generation += 1
        return CompResult.OK

    def _refuse(self, number: int, owner: int, now_s: float) -> CompResult:
        """Return why this bank can be neither sealed nor activated, or OK."""
        if number not in (0, 1):
            return CompResult.BAD_ARGUMENT
        if owner == 0 or self.owner(now_s) != owner:
            return CompResult.LEASED
        return CompResult.BANK_ACTIVE if number == self.active else CompResult.OK
