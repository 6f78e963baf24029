"""Driver of a CNC controller: motion, status and compensation banks."""

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
    ``identify``; call ``identify`` again to accept that). Several tasks may call methods concurrently: only single requests exclude each
    other, so ``hold``, ``abort``, ``resume`` and ``status`` work while a move is pending.
    """

    def __init__(self, link: ModbusLink) -> None:
        self._session = ControllerSession(link)
        self._motion = MotionCommands(self._session)
        self._banks = Banks(self._session)
        self.name = link.name
        self.incidents = link.incidents
        """Incidents of the link: one entry for the detection, one for the outcome."""

    async def identify(self) -> DeviceInfo:
        """Read the identity of the controller, and accept its boot id as the current one.

        Raises
        ------
        WrongDevice
            Canary registers or map version do not match the protocol.
        """
        return await self._session.identify()

    async def table_format(self) -> TableFormat:
        """Read the unit and the size of the controller's table banks."""
        return await self._session.table_format()

    async def status(self) -> ControllerStatus:
        """Read the controller's coherent status block."""
        return await self._session.status()

    async def move(self, target_mm: Point, *, feed_mm_min: float, timeout_s: float) -> ControllerStatus:
        """Move straight to a target (commanded X, Y, Z in mm), wait until the axes stand there, and return that status.

        On cancellation, timeout (``timeout_s`` host seconds for the whole move) or failure while the axes move, a feed hold is sent before
        the error leaves.

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
        """Clear the controller's path and load these points (mm); nothing moves.

        Raises
        ------
        Refused
            Too many points, or one beyond the strokes.
        DeviceFault
            The controller received another number of points.
        """
        await self._motion.load_path(points_mm)

    async def start_path(self, *, feed_mm_min: float) -> None:
        """Start the loaded path at constant feed (mm/min) and return as soon as it runs; ``status`` shows its progress.

        Raises
        ------
        Refused
            Interlock, busy, empty path, feed hold on.
        """
        await self._motion.start_path(feed_mm_min=feed_mm_min)

    async def hold(self) -> None:
        """Stop the axes on their path; ``resume`` continues, ``abort`` gives up. Works at any time."""
        await self._motion.request_hold(reg.HOLD)

    async def resume(self) -> None:
        """Release feed hold: an interrupted motion continues."""
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
        """Reset the controller's alarm. Raises ``Refused`` while its cause persists."""
        await self._motion.reset_alarm()

    async def comp_status(self) -> CompStatus:
        """Read the compensation status, with boot id and generation verified as unchanged around it.

        Raises
        ------
        DeviceFault
            Another program or the operator keeps changing banks.
        """
        return await self._banks.status()

    async def lease(self, owner: int, lease_ms: int, *, anyway: bool = False) -> None:
        """Take (or extend) the lease for changing banks for ``lease_ms`` ms; ``owner`` is any u32 but 0.

        If the status shows another owner, nothing is sent, unless ``anyway``, which tests whether the controller refuses.

        Raises
        ------
        Refused
            Another owner has the lease.
        """
        await self._banks.lease(owner, lease_ms, anyway=anyway)

    async def release(self, owner: int, *, anyway: bool = False) -> None:
        """Release the lease; ``anyway`` and errors as for `lease`."""
        await self._banks.release(owner, anyway=anyway)

    async def write_bank(self, bank: int, data: bytes, *, first: int = 0) -> None:
        """Write into the inactive bank from register ``first`` (even) on, in requests of up to 100 registers that never split a value.

        Read the bank back before relying on it.

        Raises
        ------
        Refused
            The bank is active, or the data does not fit.
        """
        await self._banks.write(bank, data, first=first)

    async def read_bank(self, bank: int, n_bytes: int | None = None, *, first: int = 0) -> bytes:
        """Read a bank from register ``first`` (even) on: ``n_bytes``, or to the end of the image by its header.

        Raises
        ------
        BadFrame
            The bank holds no image and ``n_bytes`` is None.
        Refused
            The range exceeds the bank.
        """
        return await self._banks.read(bank, n_bytes, first=first)

    async def seal(self, bank: int, owner: int) -> None:
        """Have the controller check the bank's image and compute its CRC.

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
            Compare-and-swap, interlock or lease failed at the controller: nothing changed.
        ReplyTimeout, LinkDown, BadFrame
            The reply was lost, and the controller reports no execution or is unreachable: read ``comp_status`` before continuing.
        """
        await self._banks.activate(bank, expect_crc=expect_crc, expect_gen=expect_gen, owner=owner)

    async def close(self) -> None:
        """Close the link. Closing twice does nothing."""
        await self._session.link.close()
