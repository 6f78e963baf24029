"""Settings of NC programs from the machine file, with their defaults."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

USUAL_MEMORY_KIB: Mapping[str, float] = {"fanuc": 256.0, "iso": 256.0}
"""Assumed program memory of a control without its own disk, where the machine file gives none."""


@dataclass(frozen=True, slots=True)
class NcSettings:
    """``[nc]`` of the machine file: acceleration along the path, row of the tool table for the holder in the spindle (None: the operator
    writes it), and program memory by dialect."""

    acceleration_mm_s2: float = 500.0
    heidenhain_tool: int | None = None
    memory_kib: Mapping[str, float] = field(default_factory=dict)

    def memory_of(self, dialect: str) -> float | None:
        """Program memory in KiB; None: no relevant limit."""
        return self.memory_kib.get(dialect, USUAL_MEMORY_KIB.get(dialect))
