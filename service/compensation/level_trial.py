"""The bench of `commission_levels`: tries one thing on a controller and notes whether it was refused."""

from __future__ import annotations

from collections.abc import Awaitable
from dataclasses import dataclass, field

from abbe.drivers.api import BankState, CompStatus, Controller
from abbe.drivers.errors import DeviceFault, Refused
from abbe.service.clock import Clock
from abbe.service.tables.base_table import Base

LEASE_MS = 60_000
ID_WORD = 4


@dataclass(frozen=True, slots=True)
class Shown:
    """One observation, for or against a flag of `Capabilities`."""

    flag: str
    ok: bool
    what: str


@dataclass
class Trial:
    """A controller under test.

    Parameters
    ----------
    controller : Controller
        Identified.
    clock : Clock
        For waiting.
    base : Base
        The table in force when the test began; all copies are of it.
    owner, stranger : int
        Two owners of the lease.
    """

    controller: Controller
    clock: Clock
    base: Base
    owner: int
    stranger: int
    shown: list[Shown] = field(default_factory=list)
    boots: set[int] = field(default_factory=set)

    def note(self, flag: str, what: str) -> None:
        """Something speaks for a flag."""
        self.shown.append(Shown(flag, True, what))

    def fail(self, flag: str, what: str) -> None:
        """Something speaks against a flag."""
        self.shown.append(Shown(flag, False, what))

    def judge(self, flag: str, ok: bool, good: str, bad: str) -> None:
        """Something speaks for or against a flag."""
        self.shown.append(Shown(flag, ok, good if ok else bad))

    def refused(self, flag: str, why: str, what: str) -> None:
        """Note whether what must not happen was refused (``why``, empty when it was accepted)."""
        self.judge(flag, bool(why), f"refuses {what}", f"accepts {what}")

    def counted(self, before: int, after: int, what: str) -> None:
        """Note whether the generation counted one change."""
        self.judge("generation", after == (before + 1) % 2**32, f"counts {what}", f"does not count {what} ({before} → {after})")

    def proved(self, flag: str) -> bool:
        """Whether something speaks for a flag and nothing against it."""
        of_it = [s.ok for s in self.shown if s.flag == flag]
        return bool(of_it) and all(of_it)

    async def status(self) -> CompStatus:
        """The banks now."""
        now = await self.controller.comp_status()
        self.boots.add(now.boot_id)
        return now

    async def accepts(self, call: Awaitable[None]) -> str:
        """Do something; why it was refused, empty when it was not."""
        try:
            await call
        except Refused as error:
            return error.detail
        except DeviceFault:
            return ""  # acknowledged, whatever became of it
        return ""

    async def write_again(self) -> None:
        """Write into the bank at rest, in one request, what it holds."""
        other = 1 - (await self.status()).active_bank
        await self.controller.write_bank(other, self.base.image[2 * ID_WORD : 2 * ID_WORD + 4], first=ID_WORD)

    async def hold(self) -> None:
        """Have the lease, also where a controller let a second owner take it."""
        if await self.accepts(self.controller.lease(self.owner, LEASE_MS)):
            await self.accepts(self.controller.release(self.stranger))
            await self.controller.lease(self.owner, LEASE_MS)

    async def sealed(self) -> CompStatus:
        """Have the lease, and the copy sealed in the bank at rest; the banks then."""
        await self.hold()
        now = await self.status()
        other = 1 - now.active_bank
        if now.bank_state[other] is not BankState.SEALED or now.bank_crc[other] != self.base.crc:
            if await self.controller.read_bank(other, len(self.base.image)) != self.base.image:
                await self.controller.write_bank(other, self.base.image)
            gen = (await self.status()).gen
            await self.controller.seal(other, self.owner)
            now = await self.status()
            self.counted(gen, now.gen, "a seal")
        return now

    async def activate(self, now: CompStatus, *, crc: int | None = None, gen: int | None = None, owner: int | None = None) -> str:
        """Try to bring the copy into force, right or wrong; why it was refused, empty when it was not."""
        call = self.controller.activate(
            1 - now.active_bank,
            expect_crc=self.base.crc if crc is None else crc,
            expect_gen=now.gen if gen is None else gen,
            owner=self.owner if owner is None else owner,
        )
        return await self.accepts(call)
