"""Conversation with a CNC controller: motion, status and compensation banks."""

from __future__ import annotations

from collections.abc import Sequence

from abbe.drivers.api import CompStatus, ControllerStatus, DeviceInfo, Point, TableFormat
from abbe.drivers.cnc import registers as reg
from abbe.drivers.cnc.banks import Banks
from abbe.drivers.cnc.motion import MotionCommands
from abbe.drivers.cnc.session import ControllerSession
from abbe.drivers.links.modbus_link import ModbusLink


class ModbusController:
    """A CNC controller with the register map of docs/protocols/cnc.md.

    Every method may raise ``LinkDown``, ``ReplyTimeout`` or ``BadFrame`` (the wire) and ``Rebooted`` (the controller restarted since
    ``identify``; call ``identify`` again to accept that). Methods may be called from several tasks at a time: only single requests exclude
    each other, so ``hold``, ``abort``, ``resume`` and ``status`` work while a move is pending.

    Parameters
    ----------
    link : ModbusLink
        Open link to the controller.
    """

    def __init__(self, link: ModbusLink) -> None:
        self._session = ControllerSession(link)
        self._motion = MotionCommands(self._session)
        self._banks = Banks(self._session)
        self.name = link.name
        self.incidents = link.incidents
        """Account of what went wrong on the link: one entry when it was noticed, one when it was over."""

    async def identify(self) -> DeviceInfo:
        """Ask the controller who it is, and accept its boot id as the one that counts from now on.

        Raises
        ------
        WrongDevice
            Canary registers or map version are not the protocol's.
        """
        return await self._session.identify()

    async def table_format(self) -> TableFormat:
        """Read in which unit and how large this controller stores tables."""
        return await self._session.table_format()

    async def status(self) -> ControllerStatus:
        """Read the controller's coherent status block."""
        return await self._session.status()

    async def move(self, target_mm: Point, *, feed_mm_min: float, timeout_s: float) -> ControllerStatus:
        """Move straight to a target and wait until the axes stand there.

        When this is cancelled, times out or fails while the axes move, a feed hold is sent before the error goes on to the caller.

        Parameters
        ----------
        target_mm : tuple of three float
            Commanded X, Y, Z in mm.
        feed_mm_min : float
            Feed in mm/min.
        timeout_s : float
            Longest time for the whole move, in host seconds.

        Returns
        -------
        ControllerStatus
            Status at the end, in position.

        Raises
        ------
        Refused
            Nothing moved: target beyond the strokes, interlock, busy, feed hold on.
        DeviceFault
            E-stop, alarm, door, feed hold or abort during the move.
        ReplyTimeout
            Not in position in time.
        """
        return await self._motion.move(target_mm, feed_mm_min=feed_mm_min, timeout_s=timeout_s)

    async def load_path(self, points_mm: Sequence[Point]) -> None:
        """Empty the controller's path and load these points (mm); nothing moves.

        Raises
        ------
        Refused
            Too many points, or one beyond the strokes.
        DeviceFault
            Another number of points arrived than was sent.
        """
        await self._motion.load_path(points_mm)

    async def start_path(self, *, feed_mm_min: float) -> None:
        """Start the loaded path at constant feed (mm/min) and return as soon as it runs; ``status`` tells how far it is.

        Raises
        ------
        Refused
            Interlock, busy, empty path, feed hold on.
        """
        await self._motion.start_path(feed_mm_min=feed_mm_min)

    async def hold(self) -> None:
        """Stop the axes on their path; ``resume`` goes on, ``abort`` gives up. Works at any time."""
        await self._motion.request_hold(reg.HOLD)

    async def resume(self) -> None:
        """Take feed hold back: an interrupted motion goes on."""
        await self._motion.request_hold(reg.RUN)

    async def abort(self) -> None:
        """Stop the axes, forget the motion and the path, and leave the controller ready for the next motion.

        Raises
        ------
        ReplyTimeout
            The axes still move seconds later.
        """
        await self._motion.abort()

    async def reset_alarm(self) -> None:
        """Reset the controller's alarm after its cause was removed.

        Raises
        ------
        Refused
            The cause is still there.
        """
        await self._motion.reset_alarm()

    async def comp_status(self) -> CompStatus:
        """Read the compensation status, with boot id and generation proven unchanged around it.

        Raises
        ------
        DeviceFault
            Another program or the operator keeps changing banks.
        """
        return await self._banks.status()

    async def lease(self, owner: int, lease_ms: int, *, anyway: bool = False) -> None:
        """Take (or prolong) the right to change banks for ``lease_ms`` ms; ``owner`` is any u32 but 0.

        While the status says that another owner has it, nothing is sent, unless ``anyway``: a trial of whether the controller refuses.

        Raises
        ------
        Refused
            Another owner has it.
        """
        await self._banks.lease(owner, lease_ms, anyway=anyway)

    async def release(self, owner: int, *, anyway: bool = False) -> None:
        """Give the lease back; ``anyway`` as for `lease`.

        Raises
        ------
        Refused
            Another owner has it.
        """
        await self._banks.release(owner, anyway=anyway)

    async def write_bank(self, bank: int, data: bytes, *, first: int = 0) -> None:
        """Write into the inactive bank from register ``first`` (even) on, in windows that never split a value.

        Up to 100 registers travel in one request. Read them back before trusting them.

        Raises
        ------
        Refused
            The bank is active, or the data does not fit.
        """
        await self._banks.write(bank, data, first=first)

    async def read_bank(self, bank: int, n_bytes: int | None = None, *, first: int = 0) -> bytes:
        """Read a bank from register ``first`` (even) on: ``n_bytes``, or to the end of the image that its header states.

        Raises
        ------
        BadFrame
            The bank holds no image and no length was given.
        Refused
            Not within the bank.
        """
        return await self._banks.read(bank, n_bytes, first=first)

    async def seal(self, bank: int, owner: int) -> None:
        """Let the controller check the bank's image and compute its CRC.

        Raises
        ------
        Refused
            Not a valid image, bank active, or the lease is not ours.
        """
        await self._banks.seal(bank, owner)

    async def activate(self, bank: int, *, expect_crc: int, expect_gen: int, owner: int) -> None:
        """Make a sealed bank the active one, if CRC and generation are still the expected ones. Sent exactly once.

        Raises
        ------
        Refused
            The controller's compare-and-swap, interlock or lease says no: nothing changed.
        ReplyTimeout, LinkDown, BadFrame
            The answer was lost and the controller says that nothing was executed, or cannot be asked: read ``comp_status`` before going on.
        """
        await self._banks.activate(bank, expect_crc=expect_crc, expect_gen=expect_gen, owner=owner)

    async def close(self) -> None:
        """Close the link. Closing twice does nothing."""
        await self._session.link.close()
