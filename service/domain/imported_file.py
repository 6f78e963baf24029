"""Facts, besides the runs, of a campaign made of other programs' files: origin, readings without a run, stated figures."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import Field, model_validator

from abbe.service.domain.machine import FileObject


class SourceFile(FileObject):
    """One file that was imported.

    ``sha256``: digest of its bytes; ``said``: the facts that it states, as text; ``unknown``: facts that neither file nor answers state.
    """

    file: str
    format: str
    sha256: str = Field(pattern="^[0-9a-f]{64}$")
    said: dict[str, str] = Field(default_factory=dict)
    unknown: list[str] = Field(default_factory=list)


class OtherReadings(FileObject):
    """Readings of one axis that belong to no run, one list per column.

    ``angle``: readings of an angular instrument, rad; ``mean``: means of both directions as a file states them, mm; their ``direction``
    is 0. ``resolution``: smallest step of the readings, rad or mm.
    """

    kind: Literal["angle", "mean"]
    file: str
    setup_id: str
    axis: Literal["X", "Y", "Z"]
    position_mm: list[float]
    direction: list[Literal[1, 0, -1]]
    deviation: list[float]
    resolution: float = Field(0.0, ge=0.0)

    @model_validator(mode="after")
    def _equally_long(self) -> Self:
        if not len(self.position_mm) == len(self.direction) == len(self.deviation):
            raise ValueError("expected as many positions as directions and deviations")
        return self


class StatedFigure(FileObject):
    """One result that a file states. Its uncertainty is unknown: the file holds none."""

    file: str
    group: str
    symbol: str
    name: str
    value: float
    unit: str
