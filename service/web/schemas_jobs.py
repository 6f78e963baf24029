"""What the JSON interface takes and says about jobs, and what it tells live."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from service.web.schemas import Device, Job


class _Answer(BaseModel):
    model_config = ConfigDict(extra="ignore", frozen=True)


class NewJob(BaseModel):
    """What is to be done now."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    recipe: Annotated[str, Field(min_length=1, max_length=200)]


class JobState(_Answer):
    """A check since the service began. ``state``: running, pausing, paused, …; once it has ended ``done: VERDICT`` or ``interrupted``."""

    id: str
    recipe: str
    schedule: str
    who: str
    state: str
    text: str
    begun_utc: datetime
    ended_utc: datetime | None
    verification: int | None


class JobList(_Answer):
    """The latest jobs, newest first, and what can be started."""

    recipes: list[str]
    jobs: list[JobState]


class Live(_Answer):
    """One event of ``/api/v1/live``."""

    event: Literal["moment"] = "moment"
    revision: int
    job: Job | None
    devices: list[Device]
    mqtt_connected: bool
    attention: list[str]
