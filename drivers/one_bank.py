"""Presents a control with one table as a control with two banks (level 1), because a push needs two.

The table that acts is bank "active"; the other bank is memory of this process, where a new table is staged and read back while the old one
acts. `OneBankTables.activate` switches compensation off, writes the table, reads it back in full and switches compensation on again. The
control itself refuses writes while its table acts, and refuses to switch on a table without the expected CRC. So a mixture of two tables
never acts. An interruption leaves compensation off; the push then restores the old table from its journal. A crash loses the staged
table and the lease: they exist only in this process.

This is weaker than two banks (docs/decisions/0044-one-table.md): no table acts during the exchange; Abbe checks the interlocks before each
switch, but the control does not check them at that instant; there is no lease, so no other program may write tables; if the origin of the
content is unknown, a person must decide.
"""

from __future__ import annotations

import zlib
from typing import Any

from abbe.drivers.api import WRONG_STATES, BankState, CompStatus, Condition, OneBank
from abbe.drivers.errors import DeviceFault, DriverError, Refused

LEASE_MS = 60_000
TRIES = 4
CHUNK_WORDS = 100
FORBIDDEN = (
    Condition.ESTOP | Condition.DOOR_OPEN | Condition.ALARM | Condition.MOVING | Condition.PATH_RUNNING | Condition.NC_PROGRAM
    | Condition.SPINDLE
)  # fmt: skip
NEEDED = Condition.REMOTE | Condition.REFERENCED
_MAGIC, _HEADER_BYTES = b"\xab\xbe", 8


def image_in(store: bytes) -> bytes:
    """Return the image at the beginning of a table store; empty if there is none (`abbe.drivers.tables`)."""
    length = 2 * int.from_bytes(store[6:8], "big") if store[:2] == _MAGIC and len(store) >= _HEADER_BYTES else 0
    return store[:length] if length <= len(store) else b""


class OneBankTables:
    """The calls of `abbe.drivers.api.TableController` about tables, on a control with one table."""

    def __init__(self, control: OneBank, *, chunk_words: int = CHUNK_WORDS) -> None:
        self._c, self._chunk = control, 2 * chunk_words
        self._active = 0
        self._staged: bytearray | None = None
        self._sealed = False
        self._owner = 0
        self.one_bank_control = control

    def __getattr__(self, name: str) -> Any:
        """Pass everything that is not about tables on to the control."""
        return getattr(self.one_bank_control, name)

    async def comp_status(self) -> CompStatus:
        """Read state and table until two reads agree. The generation is a CRC of both.

        Raises
        ------
        DeviceFault
            State or table keep changing.
        """
        state, store = await self._c.table_state(), await self._c.read_table()
        for _ in range(TRIES):
            before, (state, store) = (state, store), (await self._c.table_state(), await self._c.read_table())
            if before == (state, store):
                break
        else:
            raise DeviceFault("one table", "read table", f"the table changed during each of {TRIES} reads")
        image = image_in(store)
        mine = BankState.OFF if not state.acts else BankState.SEALED if image else BankState.WRITING
        crc = zlib.crc32(image) if mine is BankState.SEALED else 0
        other = BankState.EMPTY if self._staged is None else BankState.SEALED if self._sealed else BankState.WRITING
        other_crc = zlib.crc32(self._staged) if self._sealed and self._staged is not None else 0
        gen = zlib.crc32(bytes([state.acts]) + store)
        crcs, states = ((crc, other_crc), (mine, other)) if self._active == 0 else ((other_crc, crc), (other, mine))
        return CompStatus(state.boot_id, gen, self._active, crcs, states, self._owner, LEASE_MS if self._owner else 0)

    async def lease(self, owner: int, lease_ms: int, *, anyway: bool = False) -> None:
        """Take the lease of this process.

        Raises
        ------
        Refused
            Another owner has the lease.
        """
        if self._owner not in (0, owner):
            raise Refused("one table", "take the lease", "another push of this process has the lease")
        self._owner = owner

    async def release(self, owner: int, *, anyway: bool = False) -> None:
        """Give the lease back, if ``owner`` has it."""
        self._owner = 0 if self._owner == owner else self._owner

    async def read_bank(self, bank: int, n_bytes: int | None = None, *, first: int = 0) -> bytes:
        """Read the control's table (active bank) or the staged one. ``n_bytes`` None: the whole image, of the length in its header."""
        whole = await self._c.read_table() if bank == self._active else bytes(self._staged or b"")
        return image_in(whole) if n_bytes is None else whole[2 * first : 2 * first + n_bytes]

    async def write_bank(self, bank: int, data: bytes, *, first: int = 0) -> None:
        """Stage a part of a table.

        Raises
        ------
        Refused
            The bank is active.
        """
        if bank == self._active:
            raise Refused("one table", "write bank", "the bank is active")
        staged = self._staged or bytearray()
        staged.extend(bytes(max(0, 2 * first + len(data) - len(staged))))
        staged[2 * first : 2 * first + len(data)] = data
        self._staged, self._sealed = staged, False

    async def seal(self, bank: int, owner: int) -> None:
        """Close the staged table.

        Raises
        ------
        Refused
            The staged table has no image, or another session holds the lease.
        """
        if owner != self._owner or bank == self._active or not self._staged or image_in(bytes(self._staged)) != self._staged:
            raise Refused("one table", f"seal bank {bank}", "no table is staged in this bank, or another owner has the lease")
        self._sealed = True

    async def activate(self, bank: int, *, expect_crc: int, expect_gen: int, owner: int) -> None:
        """Exchange the control's table for the staged one, with compensation off meanwhile.

        Raises
        ------
        Refused
            Nothing was changed: lease, CRC, generation or an interlock are not as expected.
        DeviceFault
            Compensation is off and the new table does not act.
        LinkDown, ReplyTimeout, BadFrame
            The outcome is unknown: read ``comp_status``.
        """
        new = bytes(self._staged or b"")
        if owner != self._owner or bank == self._active or not self._sealed or zlib.crc32(new) != expect_crc:
            raise Refused("one table", "exchange", "the staged table is not the expected one, or another owner has the lease")
        try:
            old = image_in(await self._c.read_table())
            now = await self.comp_status()
            await self._safe()
        except (DriverError, TimeoutError) as error:
            raise Refused("one table", "exchange", f"nothing was sent: {error}") from error
        if now.gen != expect_gen:
            raise Refused("one table", "exchange", "the control's table or its switch was changed")
        acted = now.bank_state[now.active_bank] is not BankState.OFF
        if acted:
            await self._c.switch(on=False, expect_crc=now.bank_crc[now.active_bank])
        self._staged, self._sealed = None, False  # from here on only the control and the journal know
        try:
            await self._exchange(new, expect_crc)
        except Refused as error:
            raise DeviceFault("one table", "exchange", f"compensation is off: {error.detail}") from error
        self._active = bank
        if acted and zlib.crc32(old) == now.bank_crc[1 - bank]:
            self._staged, self._sealed = bytearray(old), True

    async def _exchange(self, new: bytes, crc: int) -> None:
        for at in range(0, len(new), self._chunk):
            await self._c.write_table(new[at : at + self._chunk], first=at // 2)
        found = (await self._c.read_table())[: len(new)]
        if found != new and (await self._c.read_table())[: len(new)] != new:
            raise DeviceFault("one table", "exchange", "the control does not hold what was written; compensation is off")
        await self._safe()
        await self._c.switch(on=True, expect_crc=crc)

    async def _safe(self) -> None:
        """Refuse while an axis moves, a program runs or an interlock is open."""
        conditions = (await self._c.status()).conditions
        wrong = (conditions & FORBIDDEN) | (NEEDED & ~conditions)
        if wrong:
            raise Refused("one table", "exchange", f"not safe now: {'; '.join(WRONG_STATES[flag] for flag in wrong)}")
