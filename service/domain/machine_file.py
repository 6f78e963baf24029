"""What the machine file states, with the line of each value: for the screen that shows it, since the page cannot change it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from abbe.service.domain.bounds import Number, Text, Word

Origin = Literal["default", "file", "environment"]


@dataclass(frozen=True, slots=True)
class StatedValue:
    """One value in force. ``key``: dotted; ``value``: as JSON, secrets masked; ``line``: 0 unless it stands in the file."""

    key: Word
    value: Text
    origin: Origin
    line: Number


@dataclass(frozen=True, slots=True)
class MachineFileSummary:
    """The machine file as the service read it at its start. ``sha256``: of the file."""

    path: Text
    sha256: Word
    values: Annotated[tuple[StatedValue, ...], Field(max_length=5000)]

    def sections(self) -> dict[str, list[StatedValue]]:
        """The values by section, in the order of the documentation; ``""``: what stands above all sections."""
        found: dict[str, list[StatedValue]] = {}
        for one in self.values:
            head, dot, _ = one.key.partition(".")
            found.setdefault(head.partition("[")[0] if dot else "", []).append(one)
        return found
