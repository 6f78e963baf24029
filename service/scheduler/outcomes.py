"""Waiting slots, and outcomes of slots without a normal run: state (at most 30 characters), code of the alarm, and a sentence for people.

The job writes ``done: <verdict>``; ``interrupted`` is also written when the service is stopped. All others are made here:
``missed: <how> late`` (moving a machine hours after the planned time would surprise anyone next to it), ``skipped: busy``,
``missed: maintenance``, ``missed: not ready``, ``skipped: newer slot``, ``missed: see <slot>`` (one run stands for several slots),
``missed: whole span`` (too many to list).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import NamedTuple

from abbe.service.domain.schedule import Schedule


class Hindrance(NamedTuple):
    """Obstacle to the start of a slot: the state of the slot if the obstacle lasts too long, and a sentence."""

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
        """Time at which the grace period of the slot ends."""
        return self.slot + timedelta(seconds=self.schedule.grace_s)

    @property
    def until(self) -> datetime | None:
        """Time at which the slot is dropped; None: the slot is never dropped, but caught up."""
        return self.grace_ends if self.schedule.catch_up == "skip" else None


def busy(name: str) -> Hindrance:
    """Return the hindrance: another check uses the machine."""
    return Hindrance("skipped: busy", f"{name!r} was still running")


def maintenance(name: str) -> Hindrance:
    """Return the hindrance: a maintenance window is open."""
    return Hindrance("missed: maintenance", f"it lies in the maintenance window {name!r}")


def not_ready(text: str) -> Hindrance:
    """Return the hindrance: a precondition of the schedule is not met."""
    return Hindrance("missed: not ready", text)


class SlotOutcome(NamedTuple):
    """Outcome of a slot: state for the ledger, code of the alarm, and a sentence for ledger and alarm."""

    state: str
    code: str
    text: str


def found_late(schedule: Schedule, slot: datetime, late: timedelta) -> SlotOutcome:
    """Return the outcome of a slot that no service started in time."""
    allowed = span(timedelta(seconds=schedule.grace_s))
    how = span(late)
    return SlotOutcome(
        f"missed: {how} late", "SCH-001", f"{_slot(schedule.name, slot)} was missed: it was found {how} late, the limit is {allowed}"
    )


def overrun(name: str, slot: datetime) -> SlotOutcome:
    """Return the outcome of a slot that came due while the schedule's previous check still ran."""
    return SlotOutcome("skipped: busy", "SCH-002", f"{_slot(name, slot)} was skipped: {name!r} was still running")


def kept_from_starting(waiting: Waiting, hindrance: Hindrance) -> SlotOutcome:
    """Return the outcome of a slot that waited until its grace period ended."""
    verb = hindrance.state.partition(":")[0]
    code = "SCH-002" if verb == "skipped" else "SCH-001"
    return SlotOutcome(hindrance.state, code, f"{_slot(waiting.schedule.name, waiting.slot)} was {verb}: {hindrance.text}")


def superseded(waiting: Waiting, newer: datetime) -> SlotOutcome:
    """Return the outcome of a slot that was still waiting when the next slot of its schedule came due."""
    text = f"{_slot(waiting.schedule.name, waiting.slot)} was skipped: slot {newer:%F %R} UTC is due as well"
    why = f"; it had to wait because {waiting.hindrance.text}" if waiting.hindrance is not None else ""
    return SlotOutcome("skipped: newer slot", "SCH-002", text + why)


def stood_for(waiting_name: str, slot: datetime, by: datetime, hindrance: Hindrance | None = None) -> SlotOutcome:
    """Return the outcome of a slot that the run of a later slot replaces."""
    why = f"; it had to wait because {hindrance.text}" if hindrance is not None else ""
    return SlotOutcome(
        f"missed: see {by:%FT%RZ}", "SCH-005", f"{_slot(waiting_name, slot)} was missed: the run of slot {by:%F %R} UTC replaces it{why}"
    )


def broken_off(name: str, slot: datetime) -> SlotOutcome:
    """Return the outcome if the service ended, for example by a power cut, while the check ran; the check is not repeated."""
    return SlotOutcome("interrupted", "SCH-007", f"{_slot(name, slot)} was interrupted: the service ended while it ran")


def stopped(name: str, slot: datetime) -> SlotOutcome:
    """Return the outcome if the service was stopped while the check ran; it is recorded at once, not at the next start."""
    return SlotOutcome("interrupted", "SCH-007", f"{_slot(name, slot)} was interrupted: the service was stopped while it ran")


def whole_span(name: str, first: datetime, last: datetime) -> SlotOutcome:
    """Return the common outcome of more slots than are recorded one by one."""
    return SlotOutcome(
        "missed: whole span", "SCH-004", f"{name}: every slot from {first:%F %R} to {last:%F %R} UTC was missed; they are too many to list"
    )


def caught_up(name: str, instead: Sequence[datetime], by: datetime) -> tuple[str, str]:
    """Return the code and text of the single alarm for all missed slots that one run replaces."""
    slots = (
        f"{len(instead)} slots from {instead[0]:%F %R} to {instead[-1]:%F %R} UTC were"
        if len(instead) > 1
        else f"slot {instead[0]:%F %R} UTC was"
    )
    return "SCH-005", f"{name}: {slots} missed; the run of slot {by:%F %R} UTC makes up for this"


def still_waits(waiting: Waiting, hindrance: Hindrance) -> tuple[str, str]:
    """Return the code and text of the alarm for an overdue slot that cannot start yet."""
    return "SCH-006", f"{_slot(waiting.schedule.name, waiting.slot)} is late and waits: {hindrance.text}"


def _slot(name: str, slot: datetime) -> str:
    return f"{name}: slot {slot:%F %R} UTC"


def span(length: timedelta) -> str:
    """Return a duration as text, in whole seconds, minutes, hours or days."""
    seconds = length.total_seconds()
    if seconds < 120:
        return f"{seconds:.0f} s"
    if seconds < 7200:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.0f} h" if seconds < 172800 else f"{seconds / 86400:.0f} days"
