"""What the JSON interface takes and says about jobs, and what it tells live."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from abbe.service.campaigns.builtin_recipes import USUAL_HZ
from abbe.service.web.schemas import Device, Job

LONGEST_RECIPE = 180
"""The channel takes words of 200 characters, and the rate stands behind the name."""


class _Answer(BaseModel):
    model_config = ConfigDict(extra="ignore", frozen=True)


class NewJob(BaseModel):
    """What is to be done now."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    recipe: Annotated[str, Field(min_length=1, max_length=LONGEST_RECIPE)]
    rate_hz: Annotated[int, Field(ge=1, le=1000, description="Ball-bar samples per second; has to divide 1000")] = USUAL_HZ


class JobState(_Answer):
    """A job since the service began: a check or full campaign, what follows from an alarm, or a rollback that a person ordered.

    ``state``: running, asking, pausing, paused, …; once it has ended ``done: VERDICT`` of a check, ``done: kept``
    (``rolled back``, ``refused``, ``stopped``, ``failed``, ``open``) of a push, ``done: proposed`` (``ended``, ``failed``,
    ``stopped``) of a campaign or an investigation, or ``interrupted``. A rollback is a push of the table from before: ``kept`` means that
    this one is in force again. ``asking``: a person has to do what ``ask`` says and say so under the number ``prompt``. ``solution`` and
    ``proposal``: what a campaign has left in the store.
    """

    id: str
    kind: Literal["check", "campaign", "investigation", "push", "rollback"]
    recipe: str
    schedule: str
    who: str
    state: str
    text: str
    begun_utc: datetime
    ended_utc: datetime | None
    verification: int | None
    prompt: int = 0
    ask: str = ""
    solution: int | None = None
    proposal: int | None = None


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
