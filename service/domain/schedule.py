"""The timetable: what runs when, under which conditions, and what comes next."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Literal

from abbe.service.domain.bounds import Word

FIRST_UTC = datetime(2026, 1, 1, tzinfo=UTC)
"""Intervals are counted from here unless the machine file names another instant."""


@dataclass(frozen=True, slots=True)
class Needs:
    """What has to be so before a check starts.

    Parameters
    ----------
    idle : bool
        Controller ready, nothing moves, no NC program, spindle off.
    warm_min : float
        So many of the last 60 minutes the spindle turned or an axis moved, min.
    air : bool
        Air temperature (of the laser) inside the machine file's window.
    operator : str
        ``present`` or ``absent`` by the staffed hours, or ``any``.
    """

    idle: bool = False
    warm_min: float = 0.0
    air: bool = False
    operator: Literal["any", "present", "absent"] = "any"


@dataclass(frozen=True, slots=True)
class Schedule:
    """One line of the machine file's timetable.

    Parameters
    ----------
    name : str
        Unique within the machine; part of the key that makes a slot run once.
    cron : str
        Five fields (minute hour day month weekday, 1 = Monday), or six with seconds first. Empty where ``every_h`` is given.
    timezone : str
        IANA name, for example ``Europe/Berlin``.
    recipe : str
        What to run.
    grace_s : float
        A slot may start so late: found later, or kept from starting for longer, it is a missed one.
    every_h : float
        Interval, h; 0: by ``cron``.
    first_utc : datetime
        One slot of the interval; the others are whole intervals away from it.
    catch_up : str
        Missed slots: ``skip`` records each with its reason; ``once`` does so too, and runs once for all of them.
    needs : Needs
        Preconditions.
    on_alarm : str
        ``propose``: what an alarm of this schedule's recipe asks for is measured and proposed; ``none``.
    """

    name: Word
    cron: Word
    timezone: Word
    recipe: Word
    grace_s: float = 300.0
    every_h: float = 0.0
    first_utc: datetime = FIRST_UTC
    catch_up: Literal["skip", "once"] = "skip"
    needs: Needs = Needs()
    on_alarm: Literal["none", "propose"] = "none"


@dataclass(frozen=True, slots=True, kw_only=True)
class DueSlot:
    """What comes next of one schedule."""

    schedule: Schedule
    slot_utc: datetime
