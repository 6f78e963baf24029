"""What the JSON interface takes and says about jobs, and what it tells live."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from abbe.service.campaigns.builtin_recipes import USUAL_HZ
from abbe.service.domain.device_status import DeviceStatus
from abbe.service.domain.job_state import JobState
from abbe.service.domain.running_check import RunningCheck

LONGEST_RECIPE = 180
"""The channel takes words of 200 characters, and the rate stands behind the name."""


class _Answer(BaseModel):
    model_config = ConfigDict(extra="ignore", frozen=True)


class NewJob(BaseModel):
    """What is to be done now."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    recipe: Annotated[str, Field(min_length=1, max_length=LONGEST_RECIPE)]
    rate_hz: Annotated[int, Field(ge=1, le=1000, description="Ball-bar samples per second; has to divide 1000")] = USUAL_HZ


class JobList(_Answer):
    """The latest jobs, newest first, and what can be started."""

    recipes: list[str]
    jobs: list[JobState]


class Live(_Answer):
    """One event of ``/api/v1/live``."""

    event: Literal["moment"] = "moment"
    revision: int
    job: RunningCheck | None
    devices: list[DeviceStatus]
    mqtt_connected: bool
    attention: list[str]
