"""What a machine file says about its controller for NC programs, and what is taken for granted where it says nothing."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

USUAL_MEMORY_KIB: Mapping[str, float] = {"fanuc": 256.0, "iso": 256.0}
"""Program memory that a control without its own disk is taken to have where the machine file does not say it; an assumption of ours."""


@dataclass(frozen=True, slots=True)
class NcSettings:
    """``[nc]`` of the machine file: acceleration along the path, the row of the tool table that stands for what is in the spindle (None:
    the operator writes it), and program memory by dialect."""

    acceleration_mm_s2: float = 500.0
    heidenhain_tool: int | None = None
    memory_kib: Mapping[str, float] = field(default_factory=dict)

    def memory_of(self, dialect: str) -> float | None:
        """Program memory in KiB, None where there is no limit to speak of."""
        return self.memory_kib.get(dialect, USUAL_MEMORY_KIB.get(dialect))
