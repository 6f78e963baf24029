"""A device of the machine file."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from typing import Literal

from abbe.service.domain.bounds import Text, Word


@dataclass(frozen=True, slots=True, kw_only=True)
class DeviceStatus:
    """State of a device of the machine file, and when it last answered. It is not polled between checks."""

    role: Word
    url: Text
    state: Literal["not used yet", "in use", "answered", "fault"]
    at_utc: datetime | None = None
    text: Text = ""
