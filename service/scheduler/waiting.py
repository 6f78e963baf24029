"""A slot that is due and has not started yet, and what keeps it."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import NamedTuple

from abbe.service.domain.schedule import Schedule


class Hindrance(NamedTuple):
    """What the slot ends as if this lasts too long, and the sentence to it."""

    state: str
    text: str


@dataclass(slots=True)
class Waiting:
    """One claimed slot on its way. ``told``: an alarm has said that it waits."""

    schedule: Schedule
    slot: datetime
    hindrance: Hindrance | None = None
    told: bool = False

    @property
    def grace_ends(self) -> datetime:
        """When it is late."""
        return self.slot + timedelta(seconds=self.schedule.grace_s)

    @property
    def until(self) -> datetime | None:
        """When it is given up; None: never, it is caught up some time."""
        return self.grace_ends if self.schedule.catch_up == "skip" else None


def busy(name: str) -> Hindrance:
    """Another check has the machine."""
    return Hindrance("skipped: busy", f"{name!r} was still running")


def maintenance(name: str) -> Hindrance:
    """A maintenance window is open."""
    return Hindrance("missed: maintenance", f"it lies in the maintenance window {name!r}")


def not_ready(text: str) -> Hindrance:
    """The machine is not as the schedule needs it."""
    return Hindrance("missed: not ready", text)
