"""A control that is only listened to: it shows positions and states, or nothing at all. It never moves and holds no tables.

`abbe listen` then works with a digital read-out, with a PLC that holds three positions, and with a control that has no interface at all.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import NoReturn

from abbe.drivers.api import NOTHING_HOLDS, CompStatus, Condition, ControllerStatus, DeviceInfo, Point, TableFormat
from abbe.drivers.described.source import CountSnapshot, DeviceSource, meanings, physical
from abbe.drivers.device_file import DeviceFile
from abbe.drivers.errors import DeviceFault, NotProved, ReplyTimeout
from abbe.drivers.links.incidents import Incidents

CONDITIONS = {
    "e-stop": Condition.ESTOP,
    "door open": Condition.DOOR_OPEN,
    "alarm": Condition.ALARM,
    "moving": Condition.MOVING,
    "in position": Condition.IN_POSITION,
    "measure now": Condition.IN_POSITION,
    "nc program": Condition.NC_PROGRAM,
}
STUCK_S = 0.5
"""A counter is stuck if it does not change for longer than ``update_s`` of the device file plus this time, s."""
UNKNOWN: Point = (float("nan"), float("nan"), float("nan"))
"""Position of a control that shows none."""


class ListenedControl:
    """A control behind a device file. Without a device file (``source`` is None) its position is unknown. Its clock is this computer's."""

    only_listens = True

    def __init__(self, file: DeviceFile | None, source: DeviceSource | None) -> None:
        self.file, self.source = file, source
        self.name = "the control" if source is None else source.name
        self.incidents = Incidents() if source is None else source.incidents
        self._counted: tuple[float | None, float] = (None, 0.0)

    async def identify(self) -> DeviceInfo:
        """Identify the device; errors as for its wire."""
        if self.source is None:
            return DeviceInfo("cnc", "not connected", "", 0, "")
        return await self.source.identify()

    async def status(self) -> ControllerStatus:
        """Read position and states; the time is this computer's, at the arrival.

        Raises
        ------
        DeviceFault
            The device reports a position that is not valid.
        ReplyTimeout
            No answer, or the counter of the positions is stuck.
        Rebooted, WrongDevice, LinkDown, BadFrame
            The device restarted or is another one, or communication failed.
        """
        if self.source is None or self.file is None:
            now_s = time.monotonic()
            return _status(now_s, NOTHING_HOLDS, UNKNOWN)
        snapshot = await self.source.snapshot()
        found = meanings(self.file, snapshot.counts)
        if wrong := found & {"fault", "out of range"}:
            raise DeviceFault(self.name, "read status", ", ".join(sorted(wrong)), "clear this condition at the device")
        holds = NOTHING_HOLDS
        for meaning in found & CONDITIONS.keys():
            holds |= CONDITIONS[meaning]
        self._check_renewed(snapshot)
        x, y, z = (physical(self.file, snapshot.counts, axis) for axis in "xyz")
        return _status(snapshot.host_s, holds, (x, y, z))

    async def close(self) -> None:
        """Close the link. Closing twice does nothing."""
        if self.source is not None:
            await self.source.close()

    def _check_renewed(self, snapshot: CountSnapshot) -> None:
        """Refuse positions if their counter has not changed for longer than the device may show old values."""
        count = snapshot.counts.get("counter")
        if count is None or count != self._counted[0]:
            self._counted = (count, snapshot.host_s)
        elif snapshot.host_s - self._counted[1] > STUCK_S + (0.0 if self.file is None else self.file.limits.update_s or 0.0):
            detail = f"its counter is stuck at {count:g}: the device repeats old positions"
            raise ReplyTimeout(self.name, "read status", detail, "check that the program in the device runs")

    def _refuse(self, operation: str, what: str) -> NoReturn:
        raise NotProved(self.name, operation, f"Abbe can only read this control: {what}", "use a control with a driver that can do this")

    async def comp_status(self) -> CompStatus:
        """Raise NotProved: no compensation table is visible."""
        self._refuse("read compensation status", "it shows no compensation tables")

    async def table_format(self) -> TableFormat:
        """Raise NotProved."""
        self._refuse("read table format", "it holds no compensation tables")

    async def move(self, target_mm: Point, *, feed_mm_min: float, timeout_s: float) -> ControllerStatus:
        """Raise NotProved: a person starts the NC program."""
        self._refuse("move", "it takes no motion commands")

    async def hold(self) -> None:
        """Raise NotProved."""
        self._refuse("hold", "it takes no motion commands")

    async def abort(self) -> None:
        """Raise NotProved."""
        self._refuse("abort", "it takes no motion commands")

    async def load_path(self, points_mm: Sequence[Point]) -> None:
        """Raise NotProved."""
        self._refuse("load path", "it takes no motion commands")

    async def start_path(self, *, feed_mm_min: float) -> None:
        """Raise NotProved."""
        self._refuse("start path", "it takes no motion commands")

    async def lease(self, owner: int, lease_ms: int, *, anyway: bool = False) -> None:
        """Raise NotProved: two banks, read-back and compare-and-swap are missing."""
        self._refuse("lease", _NO_TABLES)

    async def release(self, owner: int, *, anyway: bool = False) -> None:
        """Raise NotProved."""
        self._refuse("release", _NO_TABLES)

    async def read_bank(self, bank: int, n_bytes: int | None = None, *, first: int = 0) -> bytes:
        """Raise NotProved."""
        self._refuse("read bank", _NO_TABLES)

    async def write_bank(self, bank: int, data: bytes, *, first: int = 0) -> None:
        """Raise NotProved."""
        self._refuse("write bank", _NO_TABLES)

    async def seal(self, bank: int, owner: int) -> None:
        """Raise NotProved."""
        self._refuse("seal", _NO_TABLES)

    async def activate(self, bank: int, *, expect_crc: int, expect_gen: int, owner: int) -> None:
        """Raise NotProved."""
        self._refuse("activate", _NO_TABLES)


_NO_TABLES = "it proves neither two banks nor read-back nor compare-and-swap, so Abbe writes no table into it"


def _status(host_s: float, conditions: Condition, position_mm: Point) -> ControllerStatus:
    return ControllerStatus(host_s, round(host_s * 1e6), conditions, position_mm, 0, 0, 0, 100, 0)
