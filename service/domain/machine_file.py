"""The values that the machine file states, with their lines, and changes of them that a person asks for."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, is_dataclass, replace
from typing import Annotated, Literal, get_type_hints

from pydantic import Field

from abbe.service.domain.document import Number, Text, Word

Origin = Literal["default", "file", "environment"]
Looser = Literal["more", "higher", "less", "wider", "added", "later", "stated", "changed", "raised", "dropped"]
"""Which new value of a key allows more than the old one. ``more``: a larger value; ``less``: a smaller one; ``higher``: a larger one, or
none; ``wider``: a range that is not inside the old one, or none; ``added``: a list with further entries; ``later``: a later day, or the
first; ``stated``: any value, but not none; ``changed``: any other value; ``raised``: any other value, but not ``skip`` or ``none``;
``dropped``: any other value, if the old one was not ``any``."""
MOST_VALUES = 5000
ABOUT_BYTES = 80
"""Largest size of a value's JSON besides its key and its text, bytes."""


@dataclass(frozen=True, slots=True)
class Loosens:
    """Annotation of a key that a person may change on the page. ``when``: which new value allows more than the old one.

    A change that allows more needs a reason. No new value of a key without this annotation allows more.
    """

    when: Looser


def loosening(table: type) -> dict[str, Looser]:
    """Return, for each annotated key of a table of the machine file (dotted, e.g. ``needs.idle``), which new value allows more."""
    found: dict[str, Looser] = {}
    for key, hint in get_type_hints(table, include_extras=True).items():
        for one in getattr(hint, "__metadata__", ()):
            if isinstance(one, Loosens):
                found[key] = one.when
        if isinstance(hint, type) and is_dataclass(hint):
            found |= {f"{key}.{inner}": when for inner, when in loosening(hint).items()}
    return found


@dataclass(frozen=True, slots=True)
class StatedValue:
    """One value in force. ``key``: dotted; ``value``: as JSON, secrets masked; ``line``: its line in the file, 0 if it is not there."""

    key: Word
    value: Text
    origin: Origin
    line: Number


@dataclass(frozen=True, slots=True)
class FileEdit:
    """A wanted value. ``key``: dotted, tables of a list numbered from 1; ``value``: as JSON; ``null`` removes the key or table."""

    key: Word
    value: Text


@dataclass(frozen=True, slots=True)
class MachineFileSummary:
    """The machine file as the service read it at its start. ``sha256``: digest of the file; ``left_out``: number of values that ``values``
    lacks."""

    path: Text
    sha256: Word
    values: Annotated[tuple[StatedValue, ...], Field(max_length=MOST_VALUES)]
    left_out: Number = 0

    def within(self, most_bytes: int) -> MachineFileSummary:
        """The summary with as many values as fit into ``most_bytes`` of JSON: first those of the file and the environment, then
        defaults."""
        kept, room = set[int](), most_bytes - len(json.dumps(self.path)) - 4 * ABOUT_BYTES
        for k in sorted(range(len(self.values)), key=lambda k: self.values[k].origin == "default"):
            one = self.values[k]
            room -= len(json.dumps([one.key, one.value], ensure_ascii=False).encode()) + ABOUT_BYTES
            if room < 0 or len(kept) == MOST_VALUES:
                break
            kept.add(k)
        values = tuple(one for k, one in enumerate(self.values) if k in kept)
        return replace(self, values=values, left_out=self.left_out + len(self.values) - len(values))

    def sections(self) -> dict[str, list[StatedValue]]:
        """The values by section, in the order of the documentation; ``""``: keys above all sections."""
        found: dict[str, list[StatedValue]] = {}
        for one in self.values:
            head, dot, _ = one.key.partition(".")
            found.setdefault(head.partition("[")[0] if dot else "", []).append(one)
        return found


@dataclass(frozen=True, slots=True)
class CaptureSettings:
    """Settings of the capture.

    ``folder``: local folder for segments, empty: beside the SQLite file. ``reserve_bytes``: disk space reserved for closing a run on a full
    disk. ``keep``: keep segments although the database has everything.
    """

    folder: str = ""
    reserve_bytes: int = 16 << 20
    keep: bool = False


USUAL_MEMORY_KIB: Mapping[str, float] = {"fanuc": 256.0, "iso": 256.0}
"""Program memory by dialect, for controls without a disk of their own, if the machine file gives none."""


@dataclass(frozen=True, slots=True)
class NcSettings:
    """``[nc]`` of the machine file: acceleration along the path, row of the tool table for the holder in the spindle (None: the operator
    writes it), and program memory by dialect."""

    acceleration_mm_s2: float = 500.0
    heidenhain_tool: int | None = None
    memory_kib: Mapping[str, float] = field(default_factory=dict)

    def memory_of(self, dialect: str) -> float | None:
        """Return the program memory in KiB; None: no relevant limit."""
        return self.memory_kib.get(dialect, USUAL_MEMORY_KIB.get(dialect))
