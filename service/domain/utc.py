"""Format of stored times."""

from __future__ import annotations

from datetime import UTC, datetime

from abbe.service.errors import StoreError


def utc_text(time: datetime) -> str:
    """Write a time in UTC, ISO 8601 with microseconds (``2026-11-21T03:34:03.000000Z``): text order is time order.

    Raises
    ------
    StoreError
        The time has no time zone.
    """
    if time.tzinfo is None:
        raise StoreError(f"time {time.isoformat()} has no time zone", "give one")
    return time.astimezone(UTC).isoformat(timespec="microseconds").replace("+00:00", "Z")
