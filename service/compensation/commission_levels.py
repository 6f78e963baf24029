"""Commissioning of a controller's capabilities: it must refuse some attempts and accept others, which proves each flag.

The inactive bank holds a copy of the table in force for every attempt. So the same corrections act as before, whatever the controller
wrongly accepts and wherever the test is interrupted. No person has to open, press or restart anything; capabilities that only such an
action could show are reported as not shown.

`Trial` attempts one operation and records whether it was refused. `while_moving` checks that an activation is refused while an axis moves:
it moves one axis slowly by a few millimetres, up if there is room, and back.
"""

from __future__ import annotations

import asyncio
import secrets
from collections.abc import Awaitable
from contextlib import suppress
from dataclasses import dataclass, field, fields

from abbe.drivers.api import BankState, CompStatus, Controller, ControllerStatus, Point, has_one_table
from abbe.drivers.errors import DeviceFault, Refused, run_to_end
from abbe.models.machine import AXES
from abbe.service.clock import Clock, SystemClock
from abbe.service.compensation.proved_levels import KIND, flags_of, identity, last_proof
from abbe.service.compensation.recover import recover
from abbe.service.domain.document import Doc
from abbe.service.errors import TableMismatch, TableRefused, UnsafeToMove
from abbe.service.push.journal import Capabilities
from abbe.service.sequences.control import tripped
from abbe.service.site import Site
from abbe.service.storage.store import Store
from abbe.service.tables.nine_tables import Base, read_base
from abbe.service.tables.push_journal import JournalView

LEASE_MS = 60_000
ID_WORD = 4
MOVE_MM, FEED_MM_MIN = 3.0, 60.0
TRIES = 6
MOVE_LIMIT_S, MOVES_WITHIN_S, TRIAL_POLL_S = 60.0, 5.0, 0.01
FLAG = "interlocks"


@dataclass(frozen=True, slots=True)
class FlagObservation:
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
        A controller that has been identified.
    base : Base
        The table in force when the test began, of which the test writes copies.
    owner, stranger : int
        Owner ids of the lease: this test, and a second owner that must be shut out.
    """

    controller: Controller
    clock: Clock
    base: Base
    owner: int
    stranger: int
    shown: list[FlagObservation] = field(default_factory=list)
    boots: set[int] = field(default_factory=set)

    def note(self, flag: str, what: str) -> None:
        """Record an observation for a flag."""
        self.shown.append(FlagObservation(flag, True, what))

    def fail(self, flag: str, what: str) -> None:
        """Record an observation against a flag."""
        self.shown.append(FlagObservation(flag, False, what))

    def judge(self, flag: str, ok: bool, good: str, bad: str) -> None:
        """Record an observation for (``ok``) or against a flag."""
        self.shown.append(FlagObservation(flag, ok, good if ok else bad))

    def expect_refusal(self, flag: str, why: str, what: str) -> None:
        """Record whether a forbidden operation was refused; ``why``: the refusal, empty if it was accepted."""
        self.judge(flag, bool(why), f"refuses {what}", f"accepts {what}")

    def check_counted(self, before: int, after: int, what: str) -> None:
        """Record whether the controller's generation counter rose by exactly one."""
        self.judge("generation", after == (before + 1) % 2**32, f"counts {what}", f"does not count {what} ({before} → {after})")

    def is_proved(self, flag: str) -> bool:
        """Whether there is an observation for a flag and none against it."""
        of_it = [s.ok for s in self.shown if s.flag == flag]
        return bool(of_it) and all(of_it)

    async def status(self) -> CompStatus:
        """Return the present state of the banks; record the controller's boot id."""
        now = await self.controller.comp_status()
        self.boots.add(now.boot_id)
        return now

    async def refusal_of(self, call: Awaitable[None]) -> str:
        """Attempt an operation; return the refusal, empty if it was accepted."""
        try:
            await call
        except Refused as error:
            return error.detail
        except DeviceFault:
            return ""  # acknowledged, whatever followed
        return ""

    async def rewrite(self) -> None:
        """Write one register pair of the inactive bank again, with the content that it already has."""
        other = 1 - (await self.status()).active_bank
        await self.controller.write_bank(other, self.base.image[2 * ID_WORD : 2 * ID_WORD + 4], first=ID_WORD)

    async def take_lease(self) -> None:
        """Take the lease, even from a second owner that the controller wrongly accepted."""
        if await self.refusal_of(self.controller.lease(self.owner, LEASE_MS)):
            await self.refusal_of(self.controller.release(self.stranger))
            await self.controller.lease(self.owner, LEASE_MS)

    async def seal_copy(self) -> CompStatus:
        """Take the lease and seal the copy in the inactive bank; return the state of the banks."""
        await self.take_lease()
        now = await self.status()
        other = 1 - now.active_bank
        if now.bank_state[other] is not BankState.SEALED or now.bank_crc[other] != self.base.crc:
            if await self.controller.read_bank(other, len(self.base.image)) != self.base.image:
                await self.controller.write_bank(other, self.base.image)
            gen = (await self.status()).gen
            await self.controller.seal(other, self.owner)
            now = await self.status()
            self.check_counted(gen, now.gen, "a seal")
        return now

    async def activate(self, now: CompStatus, *, crc: int | None = None, gen: int | None = None, owner: int | None = None) -> str:
        """Attempt to activate the copy, with right or wrong arguments; return the refusal, empty if it was accepted."""
        call = self.controller.activate(
            1 - now.active_bank,
            expect_crc=self.base.crc if crc is None else crc,
            expect_gen=now.gen if gen is None else gen,
            owner=self.owner if owner is None else owner,
        )
        return await self.refusal_of(call)


async def while_moving(t: Trial, site: Site) -> None:
    """Attempt a correct activation while an axis moves; afterwards the axis is back where it was.

    An answer after the axis has arrived shows nothing: the attempt is repeated on the way back, at most `TRIES` times in all.
    """
    status = await t.controller.status()
    trouble = tripped(status)
    if trouble is not None:
        t.fail(FLAG, f"not tried, because no axis may move now: {trouble.detail}")
        return
    x, y, z = (round(v, 5) for v in status.position_mm)
    home, there, why_not = (x, y, z), away(site, (x, y, z)), ""
    try:
        for k in range(TRIES):
            why_not = await _on_the_way(t, home if k % 2 else there)
            if not why_not:
                break
        else:
            t.fail(FLAG, f"not tried: {why_not}")
        await t.controller.move(home, feed_mm_min=10.0 * FEED_MM_MIN, timeout_s=MOVE_LIMIT_S)
    except (Refused, DeviceFault) as error:
        t.fail(FLAG, f"the axis did not move as commanded: {error.detail}")


async def _on_the_way(t: Trial, target: Point) -> str:
    """Move slowly and attempt an activation meanwhile; return the reason why the attempt showed nothing, empty if it showed something."""
    now = await t.seal_copy()
    move = asyncio.ensure_future(t.controller.move(target, feed_mm_min=FEED_MM_MIN, timeout_s=MOVE_LIMIT_S))
    try:
        if not await _moves(t, move):
            await move
            return "the axis was not seen moving"
        why = await t.activate(now)
        still = (await t.controller.status()).moving
        await move
        if not still:  # accepted or refused: it is unknown whether the axis still moved then
            return "the axis had arrived before the answer"
        t.expect_refusal(FLAG, why, "an activation while an axis moves")
    finally:
        await run_to_end(_stop(t, move))
    return ""


def away(site: Site, home: Point) -> Point:
    """Target of the move: up along the vertical axis, away from the table; down if the axis is at its top."""
    axis = AXES.index(str(site.doc.get("vertical_axis", "Z")))
    target = list(home)
    room = float(site.machine.stroke_mm[axis, 1]) - home[axis]
    target[axis] = round(home[axis] + (MOVE_MM if room >= MOVE_MM else -MOVE_MM), 5)
    return target[0], target[1], target[2]


async def _moves(t: Trial, move: asyncio.Future[ControllerStatus]) -> bool:
    end_s = t.clock.monotonic_s() + MOVES_WITHIN_S
    while not move.done() and t.clock.monotonic_s() < end_s:
        if (await t.controller.status()).moving:
            return True
        await t.clock.sleep(TRIAL_POLL_S)
    return False


async def _stop(t: Trial, move: asyncio.Future[ControllerStatus]) -> None:
    """Abort an interrupted move: no axis moves on, and no feed hold stays on."""
    if move.done():
        if not move.cancelled():
            move.exception()  # the interrupting error is the one to raise
        return
    move.cancel()
    await asyncio.wait([move])
    await t.controller.abort()


RESTART = "that a restart changes the boot id, and what it leaves in the banks: this test restarts nothing"
NOT_SHOWN = (
    "that the controller refuses an activation with the door open, with an e-stop or with drives off: this test asks nobody to cause these",
    "that a command repeated with its old number has no effect: the driver never repeats a command",
)
SHORT_LEASE_MS, RUNS_OUT_S, POLL_S = 300, 5.0, 0.05


@dataclass(frozen=True, slots=True)
class ProvedLevels:
    """The proved capabilities of a controller. ``shown``: every observation; ``not_shown``: capabilities that this test cannot show."""

    capabilities: Capabilities
    shown: tuple[FlagObservation, ...]
    not_shown: tuple[str, ...]
    identity: Doc
    solution_id: int

    def rows(self) -> list[tuple[str, bool, str]]:
        """Return for each flag its name, whether it is proved, and the observations for or against it as text."""
        found, one_table = flags_of(self.capabilities), any(s.flag == "can_disable" for s in self.shown)
        return [(name, ok, how(self.shown, name)) for name, ok in found.items() if (name == "can_disable") is one_table]


async def commission_levels(controller: Controller, store: Store, site: Site, clock: Clock | None = None) -> ProvedLevels:
    """Prove the capabilities of a controller. Makes one short move; the table in force stays the same.

    Raises
    ------
    TableRefused
        The control has one table: `commission_one_bank`.
    UnsafeToMove
        Another owner has the lease of the banks, or a push is under way.
    StillActive
        An interrupted push could not be finished (yet).
    TableMismatch
        The table in force does not match its CRC, or differs from the table before this test.
    DriverError
        The link failed, or the controller restarted meanwhile: begin again.
    """
    await recover(controller, store, site)  # the inactive bank may hold the table that an interrupted push rolls back to
    info = await controller.identify()
    if has_one_table(controller):
        raise TableRefused(
            "this control has one table, not two banks: during an exchange no table is in force, and no other program may write",
            "if that is acceptable, commission that lower level by name: abbe comp commission --one-bank",
        )
    base = await read_base(controller)
    if base.status.lease_owner:
        raise UnsafeToMove("another owner has the lease of the banks", "wait until the lease has run out, then begin again")
    owner = (secrets.randbits(15) + 1) << 16
    trial = Trial(controller, clock or SystemClock(), base, owner, owner ^ 1)
    earlier = await asyncio.to_thread(_earlier_boots, store, site)
    try:
        await _try_all(trial, site)
    finally:
        await run_to_end(_put_back(trial))
    await _boot_id(trial)
    other_boots = earlier - {info.boot_id}
    if other_boots:
        trial.note("boot_id", "it differs from the boot id of an earlier start")
    capabilities = Capabilities(**{f.name: trial.is_proved(f.name) for f in fields(Capabilities)})
    not_shown = (*(() if other_boots else (RESTART,)), *NOT_SHOWN)
    doc = {
        "identity": identity(info), "boot_id": info.boot_id, "flags": flags_of(capabilities), "level": capabilities.level,
        "shown": [[s.flag, s.ok, s.what] for s in trial.shown], "not_shown": list(not_shown),
    }  # fmt: skip
    solution_id = await store.write(keep_proof, store, site, doc)
    return ProvedLevels(capabilities, tuple(trial.shown), not_shown, identity(info), solution_id)


def how(shown: tuple[FlagObservation, ...], flag: str) -> str:
    """The observations that proved a flag, or those against it."""
    of_it = [s for s in shown if s.flag == flag]
    return "; ".join(s.what for s in of_it if not s.ok) or "; ".join(s.what for s in of_it) or "not tried"


def keep_proof(store: Store, site: Site, doc: Doc) -> int:
    """Store the document of a commissioning; return its number."""
    machine_id = store.machines.add(site.name, site.doc)
    number = sum(c.name.startswith(f"{KIND} ") for c in store.campaigns.all()) + 1
    return store.solutions.add(store.campaigns.add(machine_id, f"{KIND} {number}", {}), KIND, [], doc)


def _earlier_boots(store: Store, site: Site) -> set[int]:
    """Boot ids of earlier pushes and commissionings of this machine."""
    boots = {push.boot for push in JournalView.read(store, site.name, site.urls.control, origins=False).bases()}
    last = last_proof(store, site)
    return boots | ({int(last["boot_id"])} if last else set())


async def _try_all(t: Trial, site: Site) -> None:
    await t.take_lease()
    if not await _two_banks(t):
        return
    try:
        await _generation(t)
        await _lease(t)
        await _swap(t)
        await while_moving(t, site)
        await _right(t)
    except Refused as error:
        t.fail("two_banks", f"a copy of the table in force cannot be made ready: {error.detail}")


async def _boot_id(t: Trial) -> None:
    now = await t.status()
    if now.boot_id == 0:
        t.fail("boot_id", "it is zero")
    elif t.boots != {now.boot_id}:
        t.fail("boot_id", "it changed during the test")
    else:
        t.note("boot_id", "it is there and stays the same")


async def _two_banks(t: Trial) -> bool:
    """Check that there are two banks and that the active one refuses writes.

    The copy is marked by another table number, which does not change the corrections.
    """
    image, c = t.base.image, t.controller
    now = await t.status()
    begin, end = 2 * ID_WORD, 2 * ID_WORD + 4
    number = image[begin:end]
    marked = image[:begin] + bytes(b ^ 0x5A for b in number) + image[end:]
    why = await t.refusal_of(c.write_bank(1 - now.active_bank, marked))
    if why:
        t.fail("two_banks", f"the inactive bank refuses writes: {why}")
        return False
    apart = await c.read_bank(1 - now.active_bank, len(image)) == marked and await c.read_bank(now.active_bank, len(image)) == image
    t.judge(
        "two_banks",
        apart,
        "a write into the inactive bank changes only that bank",
        "after a write into the inactive bank, a bank holds something else than it should",
    )
    why = await t.refusal_of(c.write_bank(now.active_bank, number, first=ID_WORD))
    t.judge("two_banks", bool(why), "the active bank refuses writes", "the active bank accepts writes")
    if not apart:  # restore the number wherever it was written
        await t.refusal_of(c.write_bank(now.active_bank, number, first=ID_WORD))
    why = await t.refusal_of(c.write_bank(1 - now.active_bank, image))
    return not why and apart


async def _generation(t: Trial) -> None:
    one, two = await t.status(), await t.status()
    t.judge("generation", one.gen == two.gen, "it stays the same while no bank changes", "it changes although no bank was changed")
    for _ in range(2):
        gen = (await t.status()).gen
        await t.refusal_of(t.rewrite())
        t.check_counted(gen, (await t.status()).gen, "a write")


async def _lease(t: Trial) -> None:
    c = t.controller
    await t.refusal_of(c.release(t.owner))
    other = 1 - (await t.status()).active_bank
    t.expect_refusal("lease", await t.refusal_of(c.seal(other, t.owner)), "a seal without the lease")
    await t.refusal_of(t.rewrite())
    await t.take_lease()
    mine = (await t.status()).lease_owner == t.owner
    t.judge("lease", mine, "the status names its owner", "the status does not name its owner")
    t.expect_refusal("lease", await t.refusal_of(c.lease(t.stranger, 60_000, anyway=True)), "a lease for a second owner")
    t.expect_refusal("lease", await t.refusal_of(c.release(t.stranger, anyway=True)), "a release by a second owner")
    t.expect_refusal("lease", await t.refusal_of(c.seal(1 - (await t.status()).active_bank, t.stranger)), "a seal by a second owner")
    now = await t.seal_copy()
    t.expect_refusal("lease", await t.activate(now, owner=t.stranger), "an activation by a second owner")
    now = await t.seal_copy()
    await t.refusal_of(c.release(t.owner))
    t.expect_refusal("lease", await t.activate(now), "an activation without the lease")
    await t.refusal_of(c.lease(t.owner, SHORT_LEASE_MS))
    end_s = t.clock.monotonic_s() + RUNS_OUT_S
    while (await t.status()).lease_owner and t.clock.monotonic_s() < end_s:
        await t.clock.sleep(POLL_S)
    t.judge("lease", not (await t.status()).lease_owner, "it runs out", "it does not run out")


async def _swap(t: Trial) -> None:
    now = await t.seal_copy()
    t.expect_refusal("swap_compares", await t.activate(now, crc=t.base.crc ^ 0xFFFF), "an activation with another CRC")
    now = await t.seal_copy()
    t.expect_refusal("swap_compares", await t.activate(now, gen=(now.gen - 1) % 2**32), "an activation with another generation")
    before = await t.seal_copy()
    await t.refusal_of(t.rewrite())
    await t.seal_copy()
    t.expect_refusal("swap_compares", await t.activate(before), "an activation after the bank was written again")


async def _right(t: Trial) -> None:
    """Check that a correct activation is accepted: otherwise a controller that refuses everything would pass."""
    now = await t.seal_copy()
    other = 1 - now.active_bank
    why = await t.activate(now)
    after = await t.status()
    if after.active_bank == other:
        t.note("swap_compares", "a correct activation is accepted")
        t.check_counted(now.gen, after.gen, "an activation")
    elif after.bank_state[other] in (BankState.LAID_ASIDE, BankState.UNKNOWN):
        t.note("swap_compares", "a correct activation is accepted, effective after the next start")
        await t.refusal_of(t.rewrite())  # a write discards the laid-aside copy
    else:
        t.fail("swap_compares", f"a correct activation is refused as well: {why or 'it was acknowledged, but nothing changed'}")


async def _put_back(t: Trial) -> None:
    """Activate the original bank, or at least the same table, and release the lease. The copy stays in the inactive bank."""
    now = await t.status()
    if now.active_bank != t.base.status.active_bank or now.bank_crc[now.active_bank] != t.base.crc:
        with suppress(Refused):  # if refused, the same table acts from the other bank
            await t.activate(await t.seal_copy())
    await t.refusal_of(t.controller.release(t.owner))
    now = await t.status()
    if now.lease_owner in (t.owner, t.stranger):
        await t.refusal_of(t.controller.release(now.lease_owner))
    in_force = await t.controller.read_bank(now.active_bank, len(t.base.image))
    if in_force != t.base.image:
        raise TableMismatch("the table in force differs from the one before this test", "look at the controller; write the table again")
