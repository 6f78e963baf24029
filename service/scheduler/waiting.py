"""A due slot that has not started yet, and what keeps it from starting."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import NamedTuple

from abbe.service.domain.schedule import Schedule


class Hindrance(NamedTuple):
    """What keeps a slot from starting: the state of the slot if this lasts too long, and its sentence."""

    state: str
    text: str


@dataclass(slots=True)
class Waiting:
    """One claimed slot that waits to start. ``alarmed``: an alarm about the wait was raised."""

    schedule: Schedule
    slot: datetime
    hindrance: Hindrance | None = None
    alarmed: bool = False

    @property
    def grace_ends(self) -> datetime:
        """When the slot is late."""
        return self.slot + timedelta(seconds=self.schedule.grace_s)

    @property
    def until(self) -> datetime | None:
        """When the slot is dropped; None: never, it will be caught up."""
        return self.grace_ends if self.schedule.catch_up == "skip" else None


def busy(name: str) -> Hindrance:
    """Another check has the machine."""
    return Hindrance("skipped: busy", f"{name!r} was still running")


def maintenance(name: str) -> Hindrance:
    """A maintenance window is open."""
    return Hindrance("missed: maintenance", f"it lies in the maintenance window {name!r}")


def not_ready(text: str) -> Hindrance:
    """A precondition of the schedule is not met."""
    return Hindrance("missed: not ready", text)
