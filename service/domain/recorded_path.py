"""The path in recording."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from abbe.service.domain.bounds import Number, Word


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedPath:
    """A path that is being recorded. ``angle_deg``: about the axis of the test, at even parts of the path's length, not wrapped.

    ``number`` 0: no path is being recorded.
    """

    number: Number = 0
    run: Word = ""
    test: Word = ""
    radius_mm: float = 0.0
    feed_mm_min: float = 0.0
    rate_hz: Number = 0
    duration_s: float = 0.0
    angle_deg: Annotated[tuple[float, ...], Field(max_length=1000)] = ()
