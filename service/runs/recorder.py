"""What a runner gives its samples to. Who keeps them, and how safely, is another matter (abbe.service.capture)."""

from __future__ import annotations

from typing import Any, Protocol

from abbe.drivers.api import BarBatch, BarTap


class Recorder(Protocol):
    """Takes what one run produces."""

    def tap(self) -> BarTap:
        """What a new stream gives every sample to, before anybody else sees it."""
        ...

    async def add_bar(self, batch: BarBatch) -> None:
        """Hear of a batch that the tap has taken; raises when the samples are not safe, so that the motion stops."""
        ...

    async def flush(self) -> None:
        """Wait until everything given so far is on the disk."""
        ...

    async def add_record(self, record: dict[str, Any]) -> None:
        """Take one record of the laser, or of another instrument that is asked for single readings."""
        ...
