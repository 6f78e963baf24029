"""Results of a check."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import datetime
from typing import Literal

Verdict = Literal["pass", "fail", "cannot tell"]


@dataclass(frozen=True, slots=True, kw_only=True)
class CheckFailure:
    """Why a check could not be completed."""

    code: str
    what: str
    remedy: str = ""
    device: str = ""


@dataclass(frozen=True, slots=True)
class CheckFigure:
    """One figure of a check, in the unit at the end of its name. ``expanded``: its uncertainty, k = 2; None: unknown."""

    name: str
    value: float | None
    expanded: float | None
    limit: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Verification:
    """One check. Figures end in their unit; uncertainties are expanded, k = 2. ``push``: the push that it decided, 0 for none."""

    id: int
    machine: str
    schedule: str
    recipe: str
    slot_utc: datetime
    started_utc: datetime
    duration_s: float
    verdict: Verdict
    values: dict[str, float | None]
    uncertainties: dict[str, float | None]
    limits: dict[str, float | None]
    campaign: str = ""
    runs: list[str] = field(default_factory=list)
    text: str
    cause: CheckFailure | None = None
    push: int = 0

    @property
    def figures(self) -> tuple[CheckFigure, ...]:
        """The figures of the check, in their order."""
        found = self.values.items()
        return tuple(CheckFigure(name, value, self.uncertainties.get(name), self.limits.get(name)) for name, value in found)


@dataclass(frozen=True, slots=True)
class CheckResult:
    """Result of a check. ``values``, ``uncertainties`` (expanded, k = 2) and ``limits`` are in µm, by the name of the figure."""

    verdict: Verdict
    values: dict[str, float]
    uncertainties: dict[str, float]
    limits: dict[str, float]
    run_labels: list[str]
    campaign: str
    started_utc: datetime
    duration_s: float
    text: str
    comparable: bool = True
    """Whether the figures can be compared with other checks: the air was within its limits, and every certificate valid."""
