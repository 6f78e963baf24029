"""How a time is stored."""

from __future__ import annotations

from datetime import UTC, datetime

from abbe.service.errors import StoreError


def utc_text(moment: datetime) -> str:
    """Write a moment in UTC, ISO 8601 with microseconds (``2026-11-21T03:34:03.000000Z``): text order is time order.

    Raises
    ------
    StoreError
        The moment has no time zone.
    """
    if moment.tzinfo is None:
        raise StoreError(f"time {moment.isoformat()} has no time zone", "give one")
    return moment.astimezone(UTC).isoformat(timespec="microseconds").replace("+00:00", "Z")
