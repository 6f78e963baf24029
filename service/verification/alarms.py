"""Alarms in the store: read by pages and commands, acknowledged and shelved by people. `alarm_rules` says what raises them."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import timedelta

from abbe.service.domain.service_records import AlarmEntryRecord, AlarmFacts, AlarmKind
from abbe.service.errors import AlarmRefused, NotStored
from abbe.service.storage.store import Store
from abbe.service.verification.alarm_states import Alarm, folded


def alarms_of(store: Store, machine: str) -> list[Alarm]:
    """All alarms of a machine, oldest first."""
    return folded(store.alarms.entries(machine))


LONGEST_SHELF = timedelta(days=7)


def acknowledge(store: Store, machine: str, number: int, name: str, comment: str = "") -> Alarm:
    """Record that a person acknowledged an alarm, with an optional comment.

    Raises
    ------
    NotStored
        The alarm does not exist.
    AlarmRefused
        The alarm is already acknowledged.
    """
    one = alarm_numbered(store, machine, number)
    if one.acknowledged_by:
        raise AlarmRefused(
            f"alarm {number} of {machine} was acknowledged by {one.acknowledged_by} at {one.acknowledged_utc:%Y-%m-%d %H:%M:%S} UTC"
        )
    store.alarms.append(machine, number, one.last_seq + 1, AlarmKind.ACKNOWLEDGED, AlarmFacts(name=name, comment=comment))
    return alarm_numbered(store, machine, number)


def shelve(store: Store, machine: str, number: int, name: str, reason: str, hours: float) -> Alarm:
    """Record that a person shelves an alarm for some hours, with the reason; 0 hours end the shelving.

    Raises
    ------
    NotStored
        The alarm does not exist.
    AlarmRefused
        The reason is missing, the time is longer than `LONGEST_SHELF`, or the alarm is over and acknowledged.
    """
    one, time = alarm_numbered(store, machine, number), timedelta(hours=hours)
    if one.word == "closed":
        raise AlarmRefused(f"alarm {number} is over and acknowledged", "there is nothing to shelve")
    if not timedelta() <= time <= LONGEST_SHELF or (hours > 0 and not reason.strip()):
        raise AlarmRefused("shelving an alarm needs a reason and a time", f"give both; at most {LONGEST_SHELF.days} days")
    facts = AlarmFacts(name=name, reason=reason.strip(), until_utc=store.utcnow() + time)
    store.alarms.append(machine, number, one.last_seq + 1, AlarmKind.SHELVED, facts)
    return alarm_numbered(store, machine, number)


def alarm_numbered(store: Store, machine: str, number: int) -> Alarm:
    """One alarm by its number; raises `NotStored` if it does not exist."""
    found = next((one for one in alarms_of(store, machine) if one.number == number), None)
    if found is None:
        raise NotStored(f"{machine} has no alarm {number}", "`abbe alarm list` shows the open ones")
    return found


def active_alarm(store: Store, machine: str, recipe: str) -> Alarm | None:
    """The only active alarm of a recipe, or None."""
    return next((one for one in reversed(alarms_of(store, machine)) if one.active and one.recipe == recipe), None)


def last_seq(entries: Sequence[AlarmEntryRecord], number: int) -> int:
    """Number of the last line of an alarm; -1 for none."""
    return max((e.seq for e in entries if e.alarm == number), default=-1)
