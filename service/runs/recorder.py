"""Protocol for the receiver of a run's samples; `abbe.service.capture` implements it."""

from __future__ import annotations

from typing import Any, Protocol

from abbe.drivers.api import BarBatch, BarTap


class Recorder(Protocol):
    """Receives and stores the data of one run."""

    def tap(self) -> BarTap:
        """Return the receiver of every sample of a new stream."""
        ...

    async def add_bar(self, batch: BarBatch) -> None:
        """Account for a batch that the tap received; raises if its samples are not safe, so that the motion stops."""
        ...

    async def flush(self) -> None:
        """Wait until all data received so far are on the disk."""
        ...

    async def add_record(self, record: dict[str, Any]) -> None:
        """Store one record of the laser, or of another instrument with single readings."""
        ...
