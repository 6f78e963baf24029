"""Alarms as a pure state machine: raised, held, acknowledged, cleared; and how far what was done about one has come.

An alarm belongs to one recipe of one machine and is the sum of its lines, which are only ever appended. It is raised by a check with a
signal, held by every check that does not clear it, and cleared by a check without a signal whose verdict is "pass": one that cannot tell
clears nothing. Whether a person acknowledged it is another question: a cleared alarm stays to be seen until somebody has.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any, Protocol

Doc = dict[str, Any]


class AlarmKind(StrEnum):
    """What a line says. The first four are of the alarm itself, the others of what the service does about it."""

    RAISED = "raised"
    HELD = "held"
    ACKNOWLEDGED = "acknowledged"
    CLEARED = "cleared"
    BEGUN = "begun"
    MEASURED = "measured"
    DISCOVERED = "discovered"
    PROPOSED = "proposed"
    FAILED = "failed"
    ENDED = "ended"
    PUSHING = "pushing"
    PUSHED = "pushed"


OF_WORK = (
    AlarmKind.BEGUN,
    AlarmKind.MEASURED,
    AlarmKind.DISCOVERED,
    AlarmKind.PROPOSED,
    AlarmKind.FAILED,
    AlarmKind.ENDED,
    AlarmKind.PUSHING,
    AlarmKind.PUSHED,
)
TRIES = 2
"""How often a step of an investigation may fail, or a campaign not come to its end, before a person takes over."""
NO_ALARM = 0
"""Number under which pushes are noted that no alarm has asked for."""


class AlarmLine(Protocol):
    """An entry of the store."""

    @property
    def alarm(self) -> int:
        """Which alarm."""
        ...

    @property
    def seq(self) -> int:
        """Number of the line."""
        ...

    @property
    def kind(self) -> str:
        """What it says."""
        ...

    @property
    def doc(self) -> Doc:
        """What is known."""
        ...

    @property
    def utc(self) -> str:
        """When."""
        ...


@dataclass(frozen=True, slots=True)
class Signal:
    """Why a check raises an alarm: one figure and one reason, with the figures behind it.

    ``kind``: ``limit`` (above its limit by more than U), ``jump``, ``drift``, ``days``. ``baseline``, ``baseline_u``: what the figure is
    compared with by ``jump`` and its standard uncertainty.
    """

    figure: str
    kind: str
    value: float
    expanded: float
    limit: float
    text: str
    baseline: float | None = None
    baseline_u: float | None = None


@dataclass(frozen=True, slots=True)
class FiredRule:
    """What a check says of alarms. ``judged``: whether its figures can be judged at all (it was measured, and in its air)."""

    judged: bool
    verdict: str
    signals: tuple[Signal, ...] = ()

    @property
    def text(self) -> str:
        """The reasons as one sentence."""
        return "; ".join(s.text for s in self.signals) or f"no signal, verdict {self.verdict}"


@dataclass(frozen=True, slots=True)
class AlarmStep:
    """One line about the work on an alarm."""

    kind: AlarmKind
    doc: Doc
    utc: str
    seq: int


@dataclass(frozen=True, slots=True)
class Alarm:
    """An alarm as its lines leave it. ``signals``: of the check that said something last; ``first``: of the one that raised it."""

    number: int
    recipe: str
    schedule: str
    raised_utc: str
    first: tuple[Doc, ...]
    signals: tuple[Doc, ...]
    text: str
    verification: int
    last_seq: int
    changed_utc: str
    active: bool = True
    held_seq: int = 0
    acknowledged_by: str = ""
    acknowledged_utc: str = ""
    cleared_utc: str = ""
    work: tuple[AlarmStep, ...] = field(default=())

    @property
    def word(self) -> str:
        """``raised``, ``acknowledged``, ``cleared`` (not acknowledged) or ``closed``."""
        if self.active:
            return "acknowledged" if self.acknowledged_by else "raised"
        return "closed" if self.acknowledged_by else "cleared"

    def last(self, *kinds: AlarmKind) -> AlarmStep | None:
        """The last line of one of these kinds."""
        return next((s for s in reversed(self.work) if s.kind in kinds), None)

    @property
    def outcome(self) -> str:
        """What the work on it came to so far, as a sentence; empty if there is none."""
        return str(self.work[-1].doc.get("text", "")) if self.work else ""


def after_check(now: Alarm | None, found: FiredRule) -> AlarmKind | None:
    """What a check does to the active alarm of its recipe (None: there is none); None: nothing."""
    if not found.judged:
        return None
    if now is None or not now.active:
        return AlarmKind.RAISED if found.signals else None
    return AlarmKind.CLEARED if not found.signals and found.verdict == "pass" else AlarmKind.HELD


def folded(lines: Iterable[AlarmLine]) -> list[Alarm]:
    """All alarms from their lines, oldest first. Lines that cannot follow (an alarm that was never raised) are left out."""
    found: dict[int, Alarm] = {}
    for line in lines:
        if line.kind == AlarmKind.RAISED:
            if line.alarm not in found and line.alarm != NO_ALARM:
                found[line.alarm] = _raised(line)
        elif line.alarm in found:
            found[line.alarm] = _followed(found[line.alarm], line)
    return [found[number] for number in sorted(found)]


def _raised(line: AlarmLine) -> Alarm:
    d = line.doc
    signals = tuple(d["signals"])
    return Alarm(
        line.alarm,
        d["recipe"],
        d["schedule"],
        line.utc,
        signals,
        signals,
        d["text"],
        d["verification"],
        line.seq,
        line.utc,
        held_seq=line.seq,
    )


def _followed(alarm: Alarm, line: AlarmLine) -> Alarm:
    d, kind = line.doc, AlarmKind(line.kind)
    alarm = replace(alarm, last_seq=line.seq, changed_utc=line.utc)
    if kind is AlarmKind.ACKNOWLEDGED:
        return alarm if alarm.acknowledged_by else replace(alarm, acknowledged_by=d["name"], acknowledged_utc=line.utc)
    if kind in OF_WORK:
        return replace(alarm, work=(*alarm.work, AlarmStep(kind, d, line.utc, line.seq)))
    if not alarm.active:
        return alarm
    alarm = replace(alarm, signals=tuple(d["signals"]), text=d["text"], verification=d["verification"], held_seq=line.seq)
    return replace(alarm, active=False, cleared_utc=line.utc) if kind is AlarmKind.CLEARED else alarm


def is_open(alarm: Alarm) -> bool:
    """Whether a person should see it: active, or not acknowledged."""
    return alarm.word != "closed"


def next_step(alarm: Alarm) -> AlarmKind | None:
    """What the service has to do next about an alarm that is to be investigated; None: nothing now.

    A try that failed is made once more, after the next check that holds the alarm; a try that was interrupted goes on where its lines end.
    """
    if not alarm.active or alarm.last(AlarmKind.PROPOSED, AlarmKind.ENDED) is not None:
        return None
    failed = alarm.last(AlarmKind.FAILED)
    often = sum(s.kind is AlarmKind.FAILED for s in alarm.work) >= TRIES
    if often or (failed is not None and alarm.work[-1] is failed and alarm.held_seq < failed.seq):
        return None
    if alarm.last(AlarmKind.DISCOVERED) is not None:
        return AlarmKind.PROPOSED
    return AlarmKind.DISCOVERED if alarm.last(AlarmKind.MEASURED) is not None else AlarmKind.MEASURED
