"""What a campaign's journal tells of trouble on its links, in a few lines: what, where, how often, and how it ended."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from abbe.service.domain.measured import CheckpointRecord
from abbe.service.sequences.journal import DETECTED, ENDED, INCIDENT, OUTCOME

UNKNOWN = "no outcome"
"""The process ended before the trouble did."""


@dataclass(slots=True)
class Trouble:
    """All incidents of one code on one link.

    ``times``: how often it was noticed; ``ends``: how often it ended how; ``errors``: single errors that belonged to it, as far as is
    known; ``runs``: that it happened to; ``last``: the latest text.
    """

    link: str
    device: str
    code: str
    times: int = 0
    errors: int = 0
    ends: Counter[str] = field(default_factory=Counter)
    runs: list[str] = field(default_factory=list)
    last: str = ""

    def doc(self) -> dict[str, Any]:
        """As JSON object."""
        more = {"times": self.times, "errors": self.errors, "ends": dict(self.ends), "runs": self.runs, "last": self.last}
        return {"link": self.link, "device": self.device, "code": self.code} | more


def troubles(journal: Iterable[CheckpointRecord]) -> list[Trouble]:
    """The incidents of a journal, in the order in which each kind came first."""
    found: dict[tuple[str, str, str], Trouble] = {}
    for one in journal:
        if one.kind == INCIDENT:
            doc = one.doc
            key = (str(doc["link"]), str(doc["device"]), str(doc["code"]))
            trouble = found.setdefault(key, Trouble(*key))
            trouble.last = str(doc["text"])
            if doc["phase"] == DETECTED:
                trouble.times += 1
            elif doc["phase"] == OUTCOME:
                trouble.ends[str(doc["state"])] += 1
                trouble.errors += int(doc.get("times", 1))
            if doc["run"] not in trouble.runs:
                trouble.runs.append(str(doc["run"]))
    for trouble in found.values():
        if (missing := trouble.times - trouble.ends.total()) > 0:
            trouble.ends[UNKNOWN] = missing
    return list(found.values())


def not_written(journal: Iterable[CheckpointRecord]) -> int:
    """Incidents that the database did not take in time."""
    return sum(int(one.doc.get("incidents_not_written", 0)) for one in journal if one.kind == ENDED)
