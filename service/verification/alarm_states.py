"""Alarms as a pure state machine: raised, held, acknowledged, cleared; and the progress of the work on them.

An alarm belongs to one recipe of one machine and follows from its append-only lines (`AlarmEntryRecord`). A check with a signal raises
it. A check without a signal and with the verdict "pass" clears it (the verdict "cannot tell" does not). Every other check holds it.
Acknowledging is independent: a cleared alarm remains visible until a person acknowledges it. A person may shelve an alarm for a limited
time, in which it does not ask for attention (ISA-18.2, IEC 62682).
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Iterable
from dataclasses import dataclass, replace
from datetime import datetime
from typing import Literal

from abbe.service.domain.service_records import AlarmEntryRecord, AlarmFacts, AlarmKind, Signal

OF_WORK = (
    AlarmKind.ORDERED,
    AlarmKind.BEGUN,
    AlarmKind.MEASURED,
    AlarmKind.DISCOVERED,
    AlarmKind.PROPOSED,
    AlarmKind.FAILED,
    AlarmKind.ENDED,
    AlarmKind.PUSHING,
    AlarmKind.PUSHED,
)
PRIORITIES: tuple[frozenset[str], ...] = (frozenset({"limit"}), frozenset({"jump"}))
"""Kinds of signals that have the first and the second priority; every other kind has the third."""
TRIES = 2
"""Failures of a step, or unfinished campaigns, after which a person takes over."""
NO_ALARM = 0
"""Number under which pushes without an alarm are recorded."""


@dataclass(frozen=True, slots=True)
class FiredRule:
    """Signals of a check. ``judged``: whether its figures can be judged (measured, and within the allowed temperature)."""

    judged: bool
    verdict: str
    signals: tuple[Signal, ...] = ()

    @property
    def text(self) -> str:
        """The signals as one sentence."""
        return "; ".join(s.text for s in self.signals) or f"no signal, verdict {self.verdict}"


@dataclass(frozen=True, slots=True, kw_only=True)
class AlarmHead:
    """State of an alarm as all interfaces publish it.

    ``signals``: signals of the last check that raised or held it; ``verification``: number of that check; ``comment``: comment of the
    person who acknowledged it; ``shelved_until_utc``: end of its shelving, perhaps past.
    """

    recipe: str
    schedule: str
    text: str
    signals: tuple[Signal, ...]
    verification: int
    raised_utc: datetime
    acknowledged_by: str = ""
    acknowledged_utc: datetime | None = None
    comment: str = ""
    cleared_utc: datetime | None = None
    shelved_until_utc: datetime | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Alarm(AlarmHead):
    """Present state of an alarm: the result of all entries in its history.

    ``first``: signals of the check that raised it; ``last_seq``, ``judged_seq``: numbers of the last entry and of the entry of the last
    check.
    """

    number: int
    first: tuple[Signal, ...]
    last_seq: int
    active: bool = True
    judged_seq: int = 0
    work: tuple[AlarmEntryRecord, ...] = ()

    @property
    def word(self) -> Literal["raised", "acknowledged", "cleared", "closed"]:
        """``raised``, ``acknowledged``, ``cleared`` (not acknowledged) or ``closed``."""
        if self.active:
            return "acknowledged" if self.acknowledged_by else "raised"
        return "closed" if self.acknowledged_by else "cleared"

    @property
    def priority(self) -> Literal[1, 2, 3]:
        """1: a limit is exceeded by more than U; 2: a figure jumped; 3: a figure drifts, or a limit may be reached soon."""
        kinds = {signal.kind for signal in self.signals or self.first}
        return 1 if kinds & PRIORITIES[0] else 2 if kinds & PRIORITIES[1] else 3

    def last(self, *kinds: AlarmKind) -> AlarmEntryRecord | None:
        """The last line of one of these kinds."""
        return next((s for s in reversed(self.work) if s.kind in kinds), None)

    @property
    def outcome(self) -> str:
        """Latest result of the work on the alarm as a sentence; empty if there is none."""
        return self.work[-1].facts.text if self.work else ""


Note = Callable[[AlarmKind, AlarmFacts], Awaitable[Alarm]]
"""Writes a line of the alarm; returns the alarm including it."""


def after_check(now: Alarm | None, found: FiredRule) -> AlarmKind | None:
    """Return the effect of a check on the alarm of its recipe (``now``; None without an alarm). None: the check has no effect."""
    if not found.judged:
        return None
    if now is None or not now.active:
        return AlarmKind.RAISED if found.signals else None
    return AlarmKind.CLEARED if not found.signals and found.verdict == "pass" else AlarmKind.CONTINUED


def folded(lines: Iterable[AlarmEntryRecord]) -> list[Alarm]:
    """All alarms from their lines, oldest first. Lines of an alarm that was never raised are ignored."""
    found: dict[int, Alarm] = {}
    for line in lines:
        if line.kind is AlarmKind.RAISED:
            if line.alarm not in found and line.alarm != NO_ALARM:
                found[line.alarm] = _raised(line)
        elif line.alarm in found:
            found[line.alarm] = _followed(found[line.alarm], line)
    return [found[number] for number in sorted(found)]


def _raised(line: AlarmEntryRecord) -> Alarm:
    facts = line.facts
    return Alarm(
        number=line.alarm,
        recipe=facts.recipe,
        schedule=facts.schedule,
        raised_utc=datetime.fromisoformat(line.utc),
        first=facts.signals,
        signals=facts.signals,
        text=facts.text,
        verification=facts.verification or 0,
        last_seq=line.seq,
        judged_seq=line.seq,
    )


def _followed(alarm: Alarm, line: AlarmEntryRecord) -> Alarm:
    facts, kind = line.facts, line.kind
    alarm = replace(alarm, last_seq=line.seq)
    if kind is AlarmKind.ACKNOWLEDGED:
        if alarm.acknowledged_by:
            return alarm
        return replace(alarm, acknowledged_by=facts.name, acknowledged_utc=datetime.fromisoformat(line.utc), comment=facts.comment)
    if kind is AlarmKind.SHELVED:
        return replace(alarm, shelved_until_utc=facts.until_utc)
    if kind in OF_WORK:
        anew = kind is AlarmKind.ORDERED and _is_answered(alarm)
        return replace(alarm, work=(line,) if anew else (*alarm.work, line))
    if not alarm.active:
        return alarm
    alarm = replace(alarm, signals=facts.signals, text=facts.text, verification=facts.verification or 0, judged_seq=line.seq)
    return replace(alarm, active=False, cleared_utc=datetime.fromisoformat(line.utc)) if kind is AlarmKind.CLEARED else alarm


def is_open(alarm: Alarm) -> bool:
    """Whether an alarm needs attention: active, or not acknowledged."""
    return alarm.word != "closed"


def next_step(alarm: Alarm) -> AlarmKind | None:
    """Next step in the investigation of an alarm; None: nothing to do now.

    A failed step is retried once, after the next check that holds the alarm or when a person orders it. An interrupted step resumes from
    its lines. An order after an answer begins the work anew; after failures it keeps what is measured and found.
    """
    if not alarm.active or _is_answered(alarm) or _failures(alarm) >= TRIES:
        return None
    failed = alarm.last(AlarmKind.FAILED)
    if failed is not None and alarm.work[-1] is failed and alarm.judged_seq < failed.seq:
        return None
    return step_of_order(alarm)


def step_of_order(alarm: Alarm) -> AlarmKind:
    """Return the step with which a person's order would begin now."""
    if _is_answered(alarm) or alarm.last(AlarmKind.MEASURED) is None:
        return AlarmKind.MEASURED
    return AlarmKind.DISCOVERED if alarm.last(AlarmKind.DISCOVERED) is None else AlarmKind.PROPOSED


def step_alone(alarm: Alarm) -> AlarmKind | None:
    """Next step that the service does without a person, as `next_step`.

    Once a person has ordered the search, only another order starts a measurement: the person agreed to be at the machine then, not to a
    later start.
    """
    step = next_step(alarm)
    return None if step is AlarmKind.MEASURED and alarm.last(AlarmKind.ORDERED) is not None else step


def _is_answered(alarm: Alarm) -> bool:
    """Whether the investigation has ended with a proposal or with the reason why there is none."""
    return alarm.last(AlarmKind.PROPOSED, AlarmKind.ENDED) is not None


def _failures(alarm: Alarm) -> int:
    """Number of failures since the last order, or since the alarm was raised."""
    ordered = alarm.last(AlarmKind.ORDERED)
    return sum(line.kind is AlarmKind.FAILED and (ordered is None or line.seq > ordered.seq) for line in alarm.work)
