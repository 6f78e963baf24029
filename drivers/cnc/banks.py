"""The part of the controller's driver for writing tables: identity, coherent status, detection of a restart, compensation banks.

Each command to the banks (lease, seal, activate) is sent once, and the controller's status decides its outcome.
"""

from __future__ import annotations

import asyncio
import time

from abbe.drivers.api import BankState, CompStatus, ControllerStatus, DeviceInfo, TableFormat
from abbe.drivers.cnc import registers as reg
from abbe.drivers.errors import BadFrame, DeviceFault, Rebooted, Refused, WrongDevice
from abbe.drivers.links.modbus_link import ModbusLink, ModbusOperation
from abbe.drivers.links.words import bytes_of, check_clock, check_identity, next_number, run_numbered, words_of

_WINDOW = 100  # even, and all 32-bit values of an image stand at even words: none is ever split
_SEQLOCK_TRIES = 4
_HEADER_WORDS = 24
_LENGTH_WORD = 3
_MAGIC = 0xABBE
_TRIES = 4
_SEALED = (BankState.SEALED, BankState.LAID_ASIDE)
_LEASED = 7


class ControllerSession:
    """A link that verifies that it still talks to the same controller, and that this has not restarted."""

    def __init__(self, link: ModbusLink) -> None:
        self.link = link
        self.name = link.name
        self.incidents = link.incidents
        """Incidents of the link: one entry for the detection, one for the outcome."""
        self.fifo_size = 0
        self._boot_id: int | None = None
        self._map = ""
        self._connection = link.connections
        self._last_us = -1

    async def identify(self) -> DeviceInfo:
        """Read the identity of the controller, and accept its boot id as the current one.

        Raises
        ------
        WrongDevice
            Canary registers or register map are not those of docs/protocols/cnc.md.
        LinkDown, ReplyTimeout, BadFrame
            Communication failed.
        """
        self._map = ""
        counts = await self._identity()
        try:
            await check_clock(self.name, self._clock_us)
        except WrongDevice as error:
            self.incidents.note(error, latched=True)
            raise
        self._boot_id = counts["BOOT_ID"]
        self._connection = self.link.connections
        self._last_us = -1
        self.incidents.accepted()
        return DeviceInfo("cnc", f"{counts['N_AXES']}-axis controller", "", counts["BOOT_ID"], self._map)

    async def check_boot(self) -> None:
        """Raise ``Rebooted`` if the controller restarted since ``identify``."""
        counts = await self._identity()
        if self._boot_id is None:
            self._boot_id = counts["BOOT_ID"]
        if counts["BOOT_ID"] != self._boot_id:
            detail = f"boot id {counts['BOOT_ID']:#x} instead of {self._boot_id:#x}"
            remedy = "the controller restarted: check its tables, connect to it again, then measure again"
            error = Rebooted(self.name, "check boot id", detail, remedy)
            self.incidents.note(error, latched=True)
            raise error
        # Only now: until this succeeds, every status checks again, and an unverified device gets no command.
        self._connection = self.link.connections

    async def status(self) -> ControllerStatus:
        """Read the controller's status; raises the errors of `block`."""
        return (await self.block()).status

    async def block(self) -> reg.StatusBlock:
        """Read the status block in one request.

        Raises
        ------
        Rebooted
            The controller restarted since ``identify``.
        LinkDown, ReplyTimeout, BadFrame
            Communication failed.
        """
        words = await self.link.read_block(reg.STATUS)
        block = reg.decode_status(words, time.monotonic())
        # This block has no boot id: check it after a new connection, or when the clock went back.
        if self._boot_id is None or block.status.ctrl_us < self._last_us or self._connection != self.link.connections:
            await self.check_boot()
        self._last_us = block.status.ctrl_us
        return block

    async def table_format(self) -> TableFormat:
        """Read the unit and the size of the controller's table banks."""
        counts = await self._identity()
        return TableFormat(counts["TABLE_LSB_NM"], counts["BANK_SIZE"])

    async def close(self) -> None:
        """Close the link. Closing twice does nothing."""
        await self.link.close()

    async def _identity(self) -> dict[str, int]:
        counts = reg.IDENTITY.counts(await self.link.read_block(reg.IDENTITY))
        try:
            check_identity(self.name, counts, reg.MAP_VERSION)
            self._check_map(counts)
        except WrongDevice as error:
            self.incidents.note(error, latched=True)
            raise
        self.fifo_size = counts["FIFO_SIZE"]
        return counts

    async def _clock_us(self) -> int:
        return reg.decode_status(await self.link.read_block(reg.STATUS), time.monotonic()).status.ctrl_us

    def _check_map(self, counts: dict[str, int]) -> None:
        """Refuse a register map that this driver does not support, or that changed since ``identify``."""
        found = reg.fingerprint(counts)
        for name, expected in (("N_AXES", reg.AXES), ("BANK_SIZE", reg.BANK_REGISTERS)):
            if counts[name] != expected:
                detail = f"{name} is {counts[name]} instead of {expected} ({found})"
                raise WrongDevice(self.name, "identify", detail, "install the matching firmware, or the matching version of this program")
        if self._map and found != self._map:
            detail = f"its register map changed: {found}, it was {self._map}"
            raise WrongDevice(self.name, "identify", detail, "the controller has another firmware: connect again, and check its tables")
        self._map = found


class Banks(ControllerSession):
    """A controller with its two compensation banks."""

    def __init__(self, link: ModbusLink) -> None:
        super().__init__(link)
        self._bank_commands = asyncio.Lock()

    async def comp_status(self) -> CompStatus:
        """Read the compensation status, and verify that boot id and generation were the same before and after it.

        Raises
        ------
        DeviceFault
            Another program or the operator keeps changing banks.
        """
        for _ in range(_SEQLOCK_TRIES):
            before = await self._seqlock()
            words = await self.link.read_block(reg.COMP_STATUS)
            if await self._seqlock() == before:
                boot_id, gen = before
                return reg.decode_comp_status(words, boot_id=boot_id, gen=gen)
        detail = f"the tables changed during each of {_SEQLOCK_TRIES} reads"
        raise DeviceFault(self.name, "read compensation status", detail, "let no other program and no operator edit tables meanwhile")

    async def write_bank(self, bank: int, data: bytes, *, first: int = 0) -> None:
        """Write into the inactive bank from register ``first`` (even) on, in requests of up to 100 registers that never split a value.

        Read the bank back before relying on it.

        Raises
        ------
        Refused
            The bank is active, or the data does not fit.
        """
        base = self._base(bank, "write bank")
        self._within("write bank", first, len(data))
        words = words_of(data)
        for at in range(0, len(words), _WINDOW):
            await self.link.write(base + first + at, words[at : at + _WINDOW], ModbusOperation.NUMBERED)

    async def read_bank(self, bank: int, n_bytes: int | None = None, *, first: int = 0) -> bytes:
        """Read ``n_bytes`` of a bank from register ``first`` (even) on; None: up to the end of the image, as its header states it.

        Raises
        ------
        BadFrame
            The bank holds no image and ``n_bytes`` is None.
        Refused
            The range exceeds the bank.
        """
        base = self._base(bank, "read bank")
        if n_bytes is None:
            end = await self._length(bank, base)
        else:
            self._within("read bank", first, n_bytes)
            end = first + n_bytes // 2
        words: list[int] = []
        for at in range(first, end, _WINDOW):
            words += await self.link.read(base + at, min(_WINDOW, end - at), lead=at)
        return bytes_of(words)

    async def lease(self, owner: int, lease_ms: int, *, anyway: bool = False) -> None:
        """Take (or extend) the lease for changing banks for ``lease_ms`` ms; ``owner`` is any u32 but 0.

        If the status shows another owner, no command is sent, unless ``anyway`` is set to test whether the controller refuses.

        Raises
        ------
        Refused
            Another owner has the lease.
        """
        await self._bank_command(reg.LEASE, "take the lease", anyway=anyway, owner=owner, lease_ms=lease_ms)

    async def release(self, owner: int, *, anyway: bool = False) -> None:
        """Release the lease; ``anyway`` and errors as for `lease`."""
        await self._bank_command(reg.RELEASE, "release the lease", anyway=anyway, owner=owner)

    async def seal(self, bank: int, owner: int) -> None:
        """Have the controller check the bank's image and compute its CRC.

        Raises
        ------
        Refused
            Not a valid image, bank active, or the lease is not ours.
        """
        self._base(bank, "seal bank")
        await self._bank_command(reg.SEAL, f"seal bank {bank}", bank=bank, owner=owner)

    async def activate(self, bank: int, *, expect_crc: int, expect_gen: int, owner: int) -> None:
        """Make a sealed bank the active one, if CRC and generation are still the expected ones. Sent exactly once.

        Raises
        ------
        Refused
            Compare-and-swap, interlock or lease failed at the controller: nothing changed.
        ReplyTimeout, LinkDown, BadFrame
            The reply was lost, and the controller reports no execution or is unreachable: read ``comp_status`` before continuing.
        """
        self._base(bank, "activate bank")
        operation = f"activate bank {bank}"
        await self._bank_command(reg.ACTIVATE, operation, bank=bank, expect_crc=expect_crc, expect_gen=expect_gen, owner=owner)
        active = (await self._comp_counts())["ACTIVE_BANK"]
        if active != bank:
            raise DeviceFault(
                self.name, operation, f"the controller acknowledged, but bank {active} is active", "do not measure; look at the controller"
            )

    async def _bank_command(self, command: int, operation: str, *, anyway: bool = False, **fields: int) -> None:
        """Send a command to the banks and determine its outcome.

        If two programs use the same command number, the controller executes only the first command, but both programs see the acknowledge.
        The owner of the lease shows whose command was executed. A skipped command is sent again under another number, except ACTIVATE,
        which is left to the caller.
        """
        async with self._bank_commands:
            for _ in range(1 if command == reg.ACTIVATE else _TRIES):
                result, counts = await self._once(command, operation, fields, anyway=anyway)
                if not _passed_over(command, result, counts, fields):
                    break
            else:
                detail = "another program used the same command number: this command was not executed"
                raise DeviceFault(self.name, operation, detail, "let only one program write tables; read the status again, then decide")
        if command == reg.RELEASE and result == _LEASED and counts["LEASE_OWNER"] == 0:
            return  # some controls refuse to release a free lease
        if result:
            raise Refused(self.name, operation, reg.COMP_RESULT.get(result, f"result {result}"), "read the status again, then decide")

    async def _once(self, command: int, operation: str, fields: dict[str, int], *, anyway: bool) -> tuple[int, dict[str, int]]:
        await self.check_boot()
        counts = await self._comp_counts()
        if not anyway and command in (reg.LEASE, reg.RELEASE) and counts["LEASE_OWNER"] not in (0, fields["owner"]):
            return _LEASED, counts  # a request would use up the number of a command of the lease's owner
        number = next_number(counts["COMP_ACK_SEQ"])
        try:
            words = reg.encode_comp(number, command, **fields)
        except ValueError as error:
            raise Refused(self.name, operation, str(error)) from None

        async def write() -> None:
            await self.link.write(reg.COMP_ADDRESS, words, ModbusOperation.NUMBERED)

        async def acknowledge() -> tuple[int, int]:
            nonlocal counts
            connection = self.link.connections
            counts = await self._comp_counts()
            if connection != self.link.connections:
                await self.check_boot()  # after a restart the numbers begin anew and prove nothing
            return counts["COMP_ACK_SEQ"], counts["COMP_RESULT"]

        return await run_numbered(self.name, operation, number, write, acknowledge), counts

    async def _comp_counts(self) -> dict[str, int]:
        return reg.COMP_STATUS.counts(await self.link.read_block(reg.COMP_STATUS))

    async def _seqlock(self) -> tuple[int, int]:
        counts = reg.SEQLOCK.counts(await self.link.read_block(reg.SEQLOCK))
        return counts["BOOT_ID"], counts["GEN"]

    async def _length(self, bank: int, base: int) -> int:
        header = await self.link.read(base, _HEADER_WORDS)
        length = header[_LENGTH_WORD]
        if header[0] != _MAGIC or not _HEADER_WORDS <= length <= reg.BANK_REGISTERS:
            detail = f"bank {bank} holds no image (magic {header[0]:#06x}, length {length})"
            raise BadFrame(self.name, "read bank", detail, "the bank is empty or half written: give the number of bytes to read it anyway")
        return length

    def _within(self, operation: str, first: int, n_bytes: int) -> None:
        """Refuse a range that exceeds the bank, or that may split a 32-bit value."""
        if n_bytes % 2 or n_bytes <= 0 or first % 2 or not 0 <= first <= reg.BANK_REGISTERS - n_bytes // 2:
            detail = f"{n_bytes} bytes from register {first} on are not within the {reg.BANK_REGISTERS} registers of a bank"
            raise Refused(self.name, operation, detail)

    def _base(self, bank: int, operation: str) -> int:
        if bank not in (0, 1):
            raise Refused(self.name, operation, f"there is no bank {bank}", "use 0 or 1")
        return reg.BANK_BASE[bank]


def _passed_over(command: int, result: int, counts: dict[str, int], fields: dict[str, int]) -> bool:
    """Whether an acknowledge is for another program's command, because it contradicts the lease's owner or, for SEAL, the bank's state."""
    owner, holder = fields["owner"], counts["LEASE_OWNER"]
    if result == _LEASED:
        return holder == owner or (command == reg.LEASE and holder == 0)
    if result:
        return False
    if command == reg.SEAL:
        return reg.bank_state(counts[f"BANK_STATE_{fields['bank']}"]) not in _SEALED
    return (holder != owner) if command == reg.LEASE else (command == reg.RELEASE and holder == owner)
