"""Compensation banks: lease, write, read, seal, activate; each command is sent once, and the controller's status decides its outcome."""

from __future__ import annotations

import asyncio

from abbe.drivers.api import BankState, CompStatus
from abbe.drivers.cnc import registers as reg
from abbe.drivers.cnc.session import ControllerSession
from abbe.drivers.errors import BadFrame, DeviceFault, Refused
from abbe.drivers.links.modbus_link import ModbusOperation
from abbe.drivers.links.words import bytes_of, next_number, run_numbered, words_of

_WINDOW = 100  # even, and all 32-bit values of an image stand at even words: none is ever split
_SEQLOCK_TRIES = 4
_HEADER_WORDS = 24
_LENGTH_WORD = 3
_MAGIC = 0xABBE
_TRIES = 4
_SEALED = (BankState.SEALED, BankState.LAID_ASIDE)
_LEASED = 7


class Banks:
    """The two compensation banks of one controller."""

    def __init__(self, session: ControllerSession) -> None:
        self._session = session
        self._name = session.name
        self._commands = asyncio.Lock()

    async def status(self) -> CompStatus:
        """See ``ModbusController.comp_status``."""
        for _ in range(_SEQLOCK_TRIES):
            before = await self._seqlock()
            words = await self._session.link.read_block(reg.COMP_STATUS)
            if await self._seqlock() == before:
                boot_id, gen = before
                return reg.decode_comp_status(words, boot_id=boot_id, gen=gen)
        detail = f"the generation changed during each of {_SEQLOCK_TRIES} reads"
        raise DeviceFault(self._name, "read compensation status", detail, "is another program or the operator editing tables?")

    async def write(self, bank: int, data: bytes, *, first: int = 0) -> None:
        """See ``ModbusController.write_bank``."""
        base = self._base(bank, "write bank")
        self._within("write bank", first, len(data))
        words = words_of(data)
        for at in range(0, len(words), _WINDOW):
            await self._session.link.write(base + first + at, words[at : at + _WINDOW], ModbusOperation.NUMBERED)

    async def read(self, bank: int, n_bytes: int | None, *, first: int = 0) -> bytes:
        """See ``ModbusController.read_bank``."""
        base = self._base(bank, "read bank")
        if n_bytes is None:
            end = await self._length(bank, base)
        else:
            self._within("read bank", first, n_bytes)
            end = first + n_bytes // 2
        words: list[int] = []
        for at in range(first, end, _WINDOW):
            words += await self._session.link.read(base + at, min(_WINDOW, end - at), lead=at)
        return bytes_of(words)

    async def lease(self, owner: int, lease_ms: int, *, anyway: bool = False) -> None:
        """See ``ModbusController.lease``."""
        await self._command(reg.LEASE, "take the lease", anyway=anyway, owner=owner, lease_ms=lease_ms)

    async def release(self, owner: int, *, anyway: bool = False) -> None:
        """See ``ModbusController.release``."""
        await self._command(reg.RELEASE, "release the lease", anyway=anyway, owner=owner)

    async def seal(self, bank: int, owner: int) -> None:
        """See ``ModbusController.seal``."""
        self._base(bank, "seal bank")
        await self._command(reg.SEAL, f"seal bank {bank}", bank=bank, owner=owner)

    async def activate(self, bank: int, *, expect_crc: int, expect_gen: int, owner: int) -> None:
        """See ``ModbusController.activate``."""
        self._base(bank, "activate bank")
        operation = f"activate bank {bank}"
        await self._command(reg.ACTIVATE, operation, bank=bank, expect_crc=expect_crc, expect_gen=expect_gen, owner=owner)
        active = (await self._comp_counts())["ACTIVE_BANK"]
        if active != bank:
            raise DeviceFault(self._name, operation, f"acknowledged, but bank {active} is active", "do not measure; look at the controller")

    async def _command(self, command: int, operation: str, *, anyway: bool = False, **fields: int) -> None:
        """Send a command and determine its outcome.

        Two programs can use the same number: the controller executes the first command and skips the second, and both see the same
        acknowledge. Therefore the acknowledge is compared with the owner of the lease. A skipped command never executes; it is sent again
        under another number, except ACTIVATE, where the caller decides.
        """
        async with self._commands:
            for _ in range(1 if command == reg.ACTIVATE else _TRIES):
                result, counts = await self._once(command, operation, fields, anyway=anyway)
                if not _passed_over(command, result, counts, fields):
                    break
            else:
                detail = "another program's command took its number: it was not executed"
                raise DeviceFault(self._name, operation, detail, "let one program at a time push; read the status again, then decide")
        if command == reg.RELEASE and result == _LEASED and counts["LEASE_OWNER"] == 0:
            return  # some controls refuse to release a free lease
        if result:
            raise Refused(self._name, operation, reg.COMP_RESULT.get(result, f"result {result}"), "read the status again, then decide")

    async def _once(self, command: int, operation: str, fields: dict[str, int], *, anyway: bool) -> tuple[int, dict[str, int]]:
        await self._session.check_boot()
        counts = await self._comp_counts()
        if not anyway and command in (reg.LEASE, reg.RELEASE) and counts["LEASE_OWNER"] not in (0, fields["owner"]):
            return _LEASED, counts  # a request would use up the number of a command of the lease's owner
        number = next_number(counts["COMP_ACK_SEQ"])
        try:
            words = reg.encode_comp(number, command, **fields)
        except ValueError as error:
            raise Refused(self._name, operation, str(error)) from None

        async def write() -> None:
            await self._session.link.write(reg.COMP_ADDRESS, words, ModbusOperation.NUMBERED)

        async def acknowledge() -> tuple[int, int]:
            nonlocal counts
            connection = self._session.link.connections
            counts = await self._comp_counts()
            if connection != self._session.link.connections:
                await self._session.check_boot()  # after a restart the numbers begin anew and prove nothing
            return counts["COMP_ACK_SEQ"], counts["COMP_RESULT"]

        return await run_numbered(self._name, operation, number, write, acknowledge), counts

    async def _comp_counts(self) -> dict[str, int]:
        return reg.COMP_STATUS.counts(await self._session.link.read_block(reg.COMP_STATUS))

    async def _seqlock(self) -> tuple[int, int]:
        counts = reg.SEQLOCK.counts(await self._session.link.read_block(reg.SEQLOCK))
        return counts["BOOT_ID"], counts["GEN"]

    async def _length(self, bank: int, base: int) -> int:
        header = await self._session.link.read(base, _HEADER_WORDS)
        length = header[_LENGTH_WORD]
        if header[0] != _MAGIC or not _HEADER_WORDS <= length <= reg.BANK_REGISTERS:
            detail = f"bank {bank} holds no image (magic {header[0]:#06x}, length {length})"
            raise BadFrame(self._name, "read bank", detail, "empty or half written: give the number of bytes to read it anyway")
        return length

    def _within(self, operation: str, first: int, n_bytes: int) -> None:
        """Refuse ranges beyond the registers of a bank, or that split a 32-bit value."""
        if n_bytes % 2 or n_bytes <= 0 or first % 2 or not 0 <= first <= reg.BANK_REGISTERS - n_bytes // 2:
            detail = f"{n_bytes} bytes from register {first} on are not within the {reg.BANK_REGISTERS} registers of a bank"
            raise Refused(self._name, operation, detail)

    def _base(self, bank: int, operation: str) -> int:
        if bank not in (0, 1):
            raise Refused(self._name, operation, f"there is no bank {bank}", "use 0 or 1")
        return reg.BANK_BASE[bank]


def _passed_over(command: int, result: int, counts: dict[str, int], fields: dict[str, int]) -> bool:
    """Whether an acknowledge belongs to another program's command: it contradicts the owner of the lease."""
    owner, holder = fields["owner"], counts["LEASE_OWNER"]
    if result == _LEASED:
        return holder == owner or (command == reg.LEASE and holder == 0)
    if result:
        return False
    if command == reg.SEAL:
        return reg.bank_state(counts[f"BANK_STATE_{fields['bank']}"]) not in _SEALED
    return (holder != owner) if command == reg.LEASE else (command == reg.RELEASE and holder == owner)
