"""Current state known to the core: the running check, the devices, the broker. Kept in memory; results are in the store."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from datetime import datetime

from abbe.service.clock import Clock
from abbe.service.domain.device_status import DeviceStatus
from abbe.service.domain.progress import Progress, RunningCheck
from abbe.service.domain.schedule import Schedule
from abbe.service.scheduler.ports import Doc


class Board:
    """Current state, reported by the job and the publisher; ``devices``: role and URL of each device of the machine file."""

    def __init__(self, devices: Mapping[str, str], clock: Clock) -> None:
        self._clock = clock
        self._devices_before: list[DeviceStatus] = []
        self.devices = [DeviceStatus(role=role, url=url, state="not used yet") for role, url in devices.items()]
        self.job: RunningCheck | None = None
        self.mqtt_connected = False
        self.mqtt_dropped = 0
        self.attention: list[str] = []
        self.changes = 0

    def job_started(self, schedule: Schedule, at_utc: datetime) -> None:
        """Note that a check begins."""
        self.changes += 1
        self.job = RunningCheck(schedule=schedule.name, recipe=schedule.recipe, since_utc=at_utc)
        self._devices_before = self.devices
        self.devices = [replace(device, state="in use", at_utc=at_utc, text="") for device in self.devices]

    def job_progress(self, progress: Progress) -> None:
        """Note the progress of the check."""
        if self.job is not None:
            self.job = replace(self.job, **{field.name: getattr(progress, field.name) for field in fields(Progress)})

    def job_ended(self, doc: Doc | None) -> None:
        """Note how the check ended. A check that was stopped or failed proves nothing about the devices that it does not name."""
        self.changes += 1
        self.job = None
        cause = doc["cause"] if doc is not None else None
        if doc is None or cause is not None:
            self.devices = [self._blamed(device, cause) for device in self._devices_before]
        else:
            now = self._clock.utc()
            self.devices = [replace(device, state="answered", at_utc=now, text="") for device in self.devices]

    def _blamed(self, device: DeviceStatus, cause: Doc | None) -> DeviceStatus:
        if cause is None or cause["device"] not in {device.role, device.url}:
            return device
        return replace(device, state="fault", at_utc=self._clock.utc(), text=cause["what"])

    def changed(self) -> None:
        """Note another change, such as in what needs a person."""
        self.changes += 1

    def broker(self, connected: bool) -> None:
        """Note whether the broker is connected."""
        if connected != self.mqtt_connected:
            self.changes += 1
            self.mqtt_connected = connected

    def messages_dropped(self, count: int) -> None:
        """Note that waiting messages were dropped because the broker was away for too long."""
        self.changes += 1
        self.mqtt_dropped += count
