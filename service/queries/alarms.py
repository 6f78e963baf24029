"""Alarms for people: the history of an alarm with the persons behind it, the alarms of a check, and the steps from an alarm to a report.

The steps (check, cause, proposal, approval, push, proof, report) follow from the store alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Literal, TypeVar

from abbe.service.domain.service_records import AlarmEntryRecord, AlarmKind
from abbe.service.errors import JournalChanged
from abbe.service.queries.checks import checks
from abbe.service.queries.reader import Reader, StoredResult
from abbe.service.queries.results import DiscoverySummary, discoveries
from abbe.service.queries.status import AlarmSummary, summaries
from abbe.service.queries.tables import ProposalSummary, proposals, tables
from abbe.service.storage.store import Store
from abbe.service.tables.push_journal import PushSummary
from abbe.service.verification.alarm_states import Alarm, folded, step_of_order


@dataclass(frozen=True, slots=True, kw_only=True)
class AlarmLine:
    """One entry of an alarm. ``who``: the person, empty for the service; ``verification``, ``until_utc``: None if the entry has none."""

    kind: AlarmKind
    utc: datetime
    who: str
    text: str
    verification: int | None = None
    until_utc: datetime | None = None


def alarm_lines(store: Store, machine: str, number: int) -> list[AlarmLine]:
    """The entries of an alarm, newest first."""
    return [_line(one) for one in reversed(store.alarms.entries(machine)) if one.alarm == number]


def _line(one: AlarmEntryRecord) -> AlarmLine:
    facts = one.facts
    return AlarmLine(
        kind=one.kind,
        utc=datetime.fromisoformat(one.utc),
        who=facts.name,
        text=facts.text or facts.comment or facts.reason,
        verification=facts.verification,
        until_utc=facts.until_utc,
    )


def alarms_of_check(store: Store, machine: str, verification: int) -> list[AlarmSummary]:
    """The alarms that a check raised, held or cleared."""
    entries = store.alarms.entries(machine)
    numbers = {one.alarm for one in entries if one.facts.verification == verification}
    return [one for one in summaries(folded(entries), every=True) if one.alarm in numbers]


Result = TypeVar("Result", bound=StoredResult)
Step = Literal["alarm", "check", "cause", "proposal", "approval", "push", "proof", "report"]
StepState = Literal["done", "now", "waiting", "failed", "skipped"]
SEARCHED = ("EXPLAINED", "PROPOSED", "FITTED", "UNEXPLAINED")
"""States of a search that has found a cause, or has excluded all known causes."""
APPROVED = ("approved", "pushed", "kept", "rolled back")
LATEST = 20
MOST_PATHS = 5


@dataclass(frozen=True, slots=True, kw_only=True)
class PathStep:
    """One step.

    ``number``: number of its alarm, check, search, proposal or push; None before that exists. ``recipe``: recipe that the step measures.
    """

    key: Step
    state: StepState
    number: int | None = None
    recipe: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class AlarmPath:
    """The steps of one alarm, from its check to the report. ``begins``: first step of a search that is ordered now."""

    alarm: int
    steps: Sequence[PathStep]
    begins: AlarmKind

    @property
    def now(self) -> PathStep | None:
        """The next step; None: everything is done, or a step failed."""
        return next((step for step in self.steps if step.state == "now"), None)


def path_of_alarm(reader: Reader, number: int) -> AlarmPath | None:
    """The steps of an alarm of this service's machine; None: there is no such alarm."""
    return next((_AlarmHistory(reader, entries).path(one) for one, entries in _alarms(reader) if one.number == number), None)


def path_with(reader: Reader, key: Step, number: int) -> AlarmPath | None:
    """The steps of the newest alarm whose step ``key`` concerns object ``number``, e.g. proposal 3; None: there is none."""
    for one, entries in _alarms(reader)[:MOST_PATHS]:
        found = _AlarmHistory(reader, entries).path(one)
        if any(step.key == key and step.number == number for step in found.steps):
            return found
    return None


def _alarms(reader: Reader) -> list[tuple[Alarm, list[AlarmEntryRecord]]]:
    """The alarms with their entries, newest first."""
    every = reader.store.alarms.entries(reader.machine)
    return [(one, [e for e in every if e.alarm == one.number]) for one in reversed(folded(every))]


class _AlarmHistory:
    """Stored records about the steps of one alarm. Records that name the alarm are used first, then later records."""

    def __init__(self, reader: Reader, entries: Sequence[AlarmEntryRecord]) -> None:
        self._reader, self._entries = reader, entries

    def path(self, alarm: Alarm) -> AlarmPath:
        found = list(self._steps(alarm))
        first = next((k for k, (_, state, _, _) in enumerate(found) if state == "waiting"), len(found))
        late = any(state == "failed" for _, state, _, _ in found[:first])
        steps = [
            PathStep(key=key, state="now" if k == first and not late else state, number=number, recipe=recipe)
            for k, (key, state, number, recipe) in enumerate(found)
        ]
        return AlarmPath(alarm=alarm.number, steps=steps, begins=step_of_order(alarm))

    def _steps(self, alarm: Alarm) -> Iterator[tuple[Step, StepState, int | None, str]]:
        proposal, search = self._proposal(alarm), self._search(alarm)
        push, proof = self._push(proposal), self._cleared()
        later: StepState = "waiting" if alarm.active or proposal is not None else "skipped"
        failed = alarm.last(AlarmKind.ENDED) is not None and proposal is None
        yield "alarm", "done" if alarm.acknowledged_by else "waiting", alarm.number, ""
        yield "check", "done", self._raising(alarm), ""
        searched = search is not None and search.state in SEARCHED
        yield (
            "cause",
            "done" if searched else "skipped" if proposal is not None else "failed" if failed else later,
            None if search is None else search.number,
            "",
        )
        number = None if proposal is None else proposal.number
        yield "proposal", "done" if proposal is not None else "failed" if failed else later, number, ""
        state = "" if proposal is None else proposal.state
        against = state in {"refused", "rejected", "expired", "superseded", "changed"}
        yield "approval", "done" if state in APPROVED else "failed" if against else later, number, ""
        word = "" if push is None else push.word
        bad = word in {"rolled back", "refused", "failed", "stopped", "interrupted"}
        yield "push", "done" if word == "kept" else "failed" if bad else later, None if push is None else push.push, ""
        proof = proof or (None if push is None or word != "kept" else self._check_after(alarm, push))
        yield "proof", "done" if proof is not None else "waiting", proof, alarm.recipe
        yield "report", "waiting", proof, ""

    def _raising(self, alarm: Alarm) -> int:
        """The latest check that raised or held the alarm."""
        kinds = (AlarmKind.RAISED, AlarmKind.CONTINUED)
        held = [e.facts.verification for e in self._entries if e.kind in kinds]
        return (held[-1] if held else None) or alarm.verification

    def _cleared(self) -> int | None:
        return next((e.facts.verification for e in self._entries if e.kind is AlarmKind.CLEARED), None)

    def _search(self, alarm: Alarm) -> DiscoverySummary | None:
        entry = alarm.last(AlarmKind.DISCOVERED)
        found = discoveries(self._reader, None, self._reader.machine, None, LATEST)[0]
        return self._of_alarm(found, alarm, None if entry is None else entry.facts.discovery)

    def _proposal(self, alarm: Alarm) -> ProposalSummary | None:
        entry = alarm.last(AlarmKind.PROPOSED)
        found = proposals(self._reader, self._reader.machine, None, LATEST)[0]
        return self._of_alarm(found, alarm, None if entry is None else entry.facts.proposal)

    def _push(self, proposal: ProposalSummary | None) -> PushSummary | None:
        if proposal is None:
            return None
        try:
            found = tables(self._reader).pushes
        except JournalChanged:
            return None
        return next((push for push in found if push.proposal == proposal.number), None)

    def _check_after(self, alarm: Alarm, push: PushSummary) -> int | None:
        """The first check of the alarm's recipe that passed after a push."""
        later = [
            one.id
            for one in checks(self._reader, self._reader.machine, "pass", None, LATEST)[0]
            if one.recipe == alarm.recipe and not one.push and one.started_utc.isoformat() > push.ended
        ]
        return min(later, default=None)

    def _of_alarm(self, found: Sequence[Result], alarm: Alarm, known: int | None) -> Result | None:
        """The result whose number the alarm states; if it states none, the newest since the last order to search, else since the alarm."""
        if known is not None:
            return next((one for one in found if one.number == known), None)
        ordered = alarm.last(AlarmKind.ORDERED)
        since = alarm.raised_utc if ordered is None else datetime.fromisoformat(ordered.utc)
        return next((one for one in found if datetime.fromisoformat(one.created_utc) > since), None)
