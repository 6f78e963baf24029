"""The journal of a campaign: it records what cannot be undone, so that another process can resume.

Kinds of lines: ``begun`` (plan's hash and source, controller's boot id, table, process), ``hand`` (a person was asked to do a manual step,
and when it was done), ``run`` (a run of a test was opened), ``point`` (a point was read), ``done`` (a test is complete), ``waits`` and
``goes-on`` (pause, suspension), ``incident`` (a link failed, or recovered), ``ended``. ``docs/decisions/0016-checkpoints.md`` gives the use
of each.
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, Protocol, TypeVar

from abbe.service.capture.ingest import may_pass
from abbe.service.capture.recorder import CATCH_UP_S
from abbe.service.domain.document import Doc, record
from abbe.service.domain.measured import CheckpointRecord, Owner
from abbe.service.errors import StoreError
from abbe.service.storage.store import Store

BEGUN, HAND, RUN, POINT, DONE, WAITS, GOES_ON, ENDED = "begun", "hand", "run", "point", "done", "waits", "goes-on", "ended"
INCIDENT = "incident"
DETECTED, OUTCOME = "detected", "outcome"
"""The two lines of an incident: its detection and its outcome."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BegunLine:
    """A process began to measure a campaign: hash and source of the plan, start of the controller, active table."""

    plan: str
    source: Doc = field(default_factory=dict)
    boot_id: int
    table_crc: int
    owner: Owner | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class HandLine:
    """A manual step of a test: ``phase`` is "asked" or "done"; ``what``: class of the step; ``ctrl_us``: when it was done, None before."""

    test: str
    setup: str
    mounting: int
    step: int
    what: str
    phase: str
    ctrl_us: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class RunLine:
    """A run of a test was opened in a mounting of its set-up."""

    run: int
    test: str
    setup: str
    mounting: int


@dataclass(frozen=True, slots=True, kw_only=True)
class IncidentLine:
    """A link failed (`DETECTED`) or recovered (`OUTCOME`, with its ``state`` and the number of single errors)."""

    link: str
    device: str
    code: str
    text: str
    phase: str
    run: str
    state: str = ""
    times: int = 1


Line = TypeVar("Line", BegunLine, HandLine, RunLine, IncidentLine)
_KINDS: dict[type[Any], str] = {BegunLine: BEGUN, HandLine: HAND, RunLine: RUN, IncidentLine: INCIDENT}


def lines_of(journal: Iterable[CheckpointRecord], kind: type[Line]) -> list[Line]:
    """Return all lines of one kind, oldest first.

    Raises
    ------
    Unusable
        Another version wrote a line in another form.
    """
    return [record(kind, one.doc, "the campaign's journal") for one in journal if one.kind == _KINDS[kind]]


LONGEST_S = CATCH_UP_S
"""Longest retry of a write: as long as samples may wait for the database."""
AGAIN_S = 0.2


class Journal(Protocol):
    """Destination of checkpoints."""

    async def add(self, kind: str, **doc: Any) -> None:
        """Write a line; on return it is on disk."""
        ...


class StoreJournal:
    """The journal in the database."""

    def __init__(self, store: Store, campaign_id: int, longest_s: float = LONGEST_S) -> None:
        self._store, self.campaign, self.longest_s = store, campaign_id, longest_s

    async def add(self, kind: str, **doc: Any) -> None:
        """Write a line; on return it is on disk. Retries a locked database for ``longest_s``, then raises StoreError."""
        clock = asyncio.get_running_loop().time
        until_s = clock() + self.longest_s
        while True:
            try:
                await self._store.write(self._store.checkpoints.add, self.campaign, kind, doc)
                return
            except StoreError as error:
                if not may_pass(error) or clock() > until_s:
                    raise
            await asyncio.sleep(AGAIN_S)


class NoJournal:
    """Discards all lines: for tests that never resume."""

    async def add(self, kind: str, **doc: Any) -> None:
        """Do nothing."""


UNKNOWN = "no outcome"
"""Outcome of an incident that was open when the process ended."""


@dataclass(slots=True)
class Trouble:
    """All incidents of one code on one link.

    ``times``: number of detections; ``ends``: number of each outcome; ``errors``: known number of single errors; ``runs``: affected
    runs; ``last``: the latest text.
    """

    link: str
    device: str
    code: str
    times: int = 0
    errors: int = 0
    ends: dict[str, int] = field(default_factory=dict)
    runs: list[str] = field(default_factory=list)
    last: str = ""


def troubles(journal: Iterable[CheckpointRecord]) -> list[Trouble]:
    """Group the incidents of a journal by link, device and code, in order of first occurrence."""
    found: dict[tuple[str, str, str], Trouble] = {}
    for line in lines_of(journal, IncidentLine):
        key = (line.link, line.device, line.code)
        trouble = found.setdefault(key, Trouble(*key))
        trouble.last = line.text
        if line.phase == DETECTED:
            trouble.times += 1
        elif line.phase == OUTCOME:
            trouble.ends[line.state] = trouble.ends.get(line.state, 0) + 1
            trouble.errors += line.times
        if line.run not in trouble.runs:
            trouble.runs.append(line.run)
    for trouble in found.values():
        if (missing := trouble.times - sum(trouble.ends.values())) > 0:
            trouble.ends[UNKNOWN] = missing
    return list(found.values())


def not_written(journal: Iterable[CheckpointRecord]) -> int:
    """Return the number of incidents that did not reach the database in time."""
    return sum(int(one.doc.get("incidents_not_written", 0)) for one in journal if one.kind == ENDED)
