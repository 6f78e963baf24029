"""Preconditions of a scheduled check, as far as devices and machine file show them. Nothing here moves or writes to the machine."""

from __future__ import annotations

from collections import deque
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass

from abbe.drivers.api import Condition, ControllerStatus
from abbe.drivers.errors import DriverError
from abbe.service.clock import Clock
from abbe.service.devices.session import DeviceUrls, lock_machine, open_session
from abbe.service.domain.schedule import Needs, Schedule, Window
from abbe.service.errors import AbbeError
from abbe.service.scheduler.ports import Readiness
from abbe.service.scheduler.slots import covering
from abbe.service.sequences.control import person_may_be_inside, tripped

LOOK_S = 60.0
"""Time between two looks at the controller if a schedule needs a warm machine, s."""
HOUR_S = 3600.0
WARMS = Condition.MOVING | Condition.PATH_RUNNING | Condition.NC_PROGRAM | Condition.SPINDLE
"""Conditions in which the machine warms up."""
MOVED_MM = 1e-4
"""An axis whose position differs by more than this from the last look has moved, mm."""


@dataclass(frozen=True, slots=True)
class DeviceReadings:
    """One reading of the devices: the controller's status, and the air temperature if there is a laser."""

    status: ControllerStatus
    air_c: float | None = None


Look = Callable[[bool], Awaitable[DeviceReadings]]
"""``await look(with_air)``: opens the devices, reads, closes them."""


def look_at(urls: DeviceUrls) -> Look:
    """Return a function that reads the devices behind ``urls``; it refuses while a job has the machine."""

    async def look(with_air: bool) -> DeviceReadings:
        with lock_machine(urls.cnc):
            pass  # released at once: a job that starts meanwhile must not be refused because of a look
        async with open_session(DeviceUrls(cnc=urls.cnc, laser=urls.laser if with_air else None)) as session:
            air = (await session.laser.peek()).air_temp_c if session.laser is not None else None
            return DeviceReadings(await session.controller.status(), air)

    return look


class Ready:
    """Checks the preconditions of schedules.

    Parameters
    ----------
    look : Look
        Reads the devices.
    schedules : sequence of Schedule
        All schedules: the machine is only watched if one of them needs it warm.
    air_c : tuple of float
        Window of the air temperature, degree C.
    staffed : sequence of Window
        When an operator is there.
    """

    def __init__(
        self, look: Look, schedules: Sequence[Schedule], air_c: tuple[float, float], staffed: Sequence[Window], clock: Clock
    ) -> None:
        self._look = look
        self._watches = any(schedule.needs.warm_min for schedule in schedules)
        self._air_c = air_c
        self._staffed = tuple(staffed)
        self._clock = clock
        self.active_s: deque[float] = deque()
        self.position_mm: tuple[float, ...] | None = None

    async def lack(self, schedule: Schedule) -> str:
        """Return the unmet precondition as one sentence, or an empty text. The devices are read only if a precondition needs them."""
        needs = schedule.needs
        if needs == Needs():
            return ""
        staffed = covering(self._staffed, self._clock.utc()) is not None
        if needs.operator == "present" and not staffed:
            return "no operator is there at this hour"
        if needs.operator == "absent" and staffed:
            return "an operator is there at this hour"
        if needs.warm_min and (minutes := self.active_min()) < needs.warm_min:
            return f"the machine is not warm: it was seen at work for {minutes:.0f} of the last 60 min, but {needs.warm_min:g} are needed"
        if not (needs.idle or needs.air or needs.operator == "absent"):
            return ""
        try:
            return self._of_devices(needs, await self._look(needs.air))
        except (DriverError, AbbeError, OSError) as trouble:
            return f"the devices cannot be read: {trouble}"

    def _of_devices(self, needs: Needs, readings: DeviceReadings) -> str:
        if needs.operator == "absent" and person_may_be_inside(readings.status):
            return "a person is at the machine: the door is open, or the mode is not remote"
        if needs.idle:
            trouble = tripped(readings.status)
            if trouble is not None:
                return f"the machine is not idle: {trouble.detail}"
            if readings.status.moving or readings.status.path_running:
                return "the machine is not idle: an axis moves"
        if needs.air:
            low, high = self._air_c
            if readings.air_c is None:
                return "the air temperature is not measured: the machine file has no laser"
            if not low <= readings.air_c <= high:
                return f"the air is at {readings.air_c:.1f} C, the limits are {low:g} to {high:g} C"
        return ""

    def active_min(self) -> float:
        """Return the number of minutes of the last 60 in which the machine was seen at work."""
        while self.active_s and self.active_s[0] <= self._clock.monotonic_s() - HOUR_S:
            self.active_s.popleft()
        return len(self.active_s) * LOOK_S / 60.0

    async def watch(self) -> None:
        """Read the controller each minute, forever, if a schedule needs a warm machine. After a failed reading no work is noted."""
        while self._watches:
            try:
                self._note((await self._look(False)).status)
            except (DriverError, AbbeError, OSError):
                self.position_mm = None
            await self._clock.sleep(LOOK_S)

    def continue_from(self, earlier: Readiness) -> None:
        """Take over the times at which the machine was seen at work."""
        if isinstance(earlier, Ready):
            self.active_s, self.position_mm = earlier.active_s, earlier.position_mm

    def _note(self, status: ControllerStatus) -> None:
        before, self.position_mm = self.position_mm, tuple(status.position_mm)
        moved = before is not None and max(abs(a - b) for a, b in zip(before, self.position_mm, strict=True)) > MOVED_MM
        if moved or status.conditions & WARMS:
            self.active_s.append(self._clock.monotonic_s())


class AlwaysReady:
    """Stand-in for timetables without preconditions: always ready."""

    async def lack(self, schedule: Schedule) -> str:
        """Return an empty sentence: every precondition is met."""
        return ""

    async def watch(self) -> None:
        """Return at once."""

    def continue_from(self, earlier: Readiness) -> None:
        """Ignore the history."""
