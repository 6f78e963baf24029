"""What the JSON interface answers, declared: the OpenAPI document and the page are both made from these."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from abbe.service.domain.device_status import DeviceStatus
from abbe.service.domain.running_check import RunningCheck


class _Answer(BaseModel):
    model_config = ConfigDict(extra="ignore", frozen=True)


class Cause(_Answer):
    """Why a check could not be completed."""

    code: str
    what: str
    remedy: str = ""
    device: str = ""


class Verified(_Answer):
    """Which measurement stands behind the table in force.

    ``verified``: a check was measured with it, whatever its verdict, or the push that brought it was measured before and after.
    ``unverified``: an earlier verdict says nothing of the machine now; ``text`` says since what.
    """

    state: Literal["verified", "unverified", "unknown"] = "unknown"
    why: Literal["check", "push", "rollback", "accepted", "changed", "other", "open", "never", "journal"] = "never"
    number: int = 0
    utc: datetime | None = None
    text: str = ""
    changes: Annotated[list[datetime], Field(default_factory=list)]


class Verification(_Answer):
    """One check. Figures end in their unit; uncertainties are expanded, k = 2. ``push``: the one that it decided on, 0 for none."""

    id: int
    machine: str
    schedule: str
    recipe: str
    slot_utc: datetime
    started_utc: datetime
    duration_s: float
    verdict: Literal["pass", "fail", "cannot tell"]
    values: dict[str, float | None]
    uncertainties: dict[str, float | None]
    limits: dict[str, float | None]
    campaign: str = ""
    runs: Annotated[list[str], Field(default_factory=list)]
    text: str
    cause: Cause | None = None
    push: int = 0


class Due(_Answer):
    """What comes next of one schedule."""

    schedule: str
    recipe: str
    due_utc: datetime
    timezone: str
    cron_words: str
    words: str


class Mqtt(_Answer):
    """The way to the broker."""

    configured: bool
    broker: str = ""
    connected: bool = False
    waiting: int = 0
    dropped: int = 0


class Alarm(_Answer):
    """An alarm that is active, or that nobody has acknowledged. ``signals``: figures behind it; ``outcome``: what was done so far."""

    alarm: int
    state: Literal["raised", "acknowledged", "cleared"]
    recipe: str
    schedule: str
    text: str
    signals: list[dict[str, str | float | None]]
    raised_utc: datetime
    acknowledged_by: str = ""
    cleared_utc: datetime | None = None
    outcome: str = ""
    proposal: int | None = None


class Status(_Answer):
    """Everything the page shows. ``revision`` changes when more than the progress of a running check has changed; ``attention``: what needs
    a person now; ``verified``: whether the last verdict is of the table in force."""

    machine: str
    version: str
    now_utc: datetime
    revision: str
    job: RunningCheck | None
    devices: list[DeviceStatus]
    next_due: list[Due]
    mqtt: Mqtt
    alarms: Annotated[list[Alarm], Field(default_factory=list)]
    last: list[Verification]
    attention: Annotated[list[str], Field(default_factory=list)]
    verified: Annotated[Verified, Field(default_factory=lambda: Verified(changes=[]))]


class Verifications(_Answer):
    """Checks, newest first."""

    verifications: list[Verification]


class Health(_Answer):
    """The process answers, or is ready to work."""

    status: Literal["ok"] = "ok"


class Problem(_Answer):
    """RFC 9457 problem details."""

    type: str = "about:blank"
    title: str
    status: int
    detail: str = ""
    code: str = ""
