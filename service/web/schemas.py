"""Types that only HTTP has: list envelopes, request bodies, problems. Envelopes contain records of the read model."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from abbe.service.domain.document import WORD
from abbe.service.domain.progress import DeviceStatus, JobState
from abbe.service.domain.push_entry import PushTransition
from abbe.service.domain.service_records import AuditEvent
from abbe.service.domain.verification import Verification
from abbe.service.queries.measured import CampaignSummary, MachineDescription, RunSummary
from abbe.service.queries.people import UserSummary
from abbe.service.queries.results import DiscoverySummary, SolutionSummary
from abbe.service.queries.tables import ProposalSummary
from abbe.service.queries.timetable import ScheduleState
from abbe.service.sequences.recipes.campaigns import USUAL_HZ
from abbe.service.storage.repositories.pages import LARGEST
from abbe.service.web.catalogue import ErrorEntry

LONGEST_RECIPE = 180
"""The channel limits names to 200 characters, and the rate follows the name."""


class ApiAnswer(BaseModel):
    """Base of all answers. Times are UTC, ISO 8601; names end with units."""

    model_config = ConfigDict(extra="ignore", frozen=True)


class ListPage(ApiAnswer):
    """A page of a list, newest first."""

    next_cursor: Annotated[int | None, Field(description="`cursor` of the next page; null: this is the last page.")]


class MachineList(ListPage):
    """Machines, newest description first."""

    machines: Sequence[MachineDescription]


class CampaignList(ListPage):
    """Campaigns."""

    campaigns: Sequence[CampaignSummary]


class RunList(ListPage):
    """Runs."""

    runs: Sequence[RunSummary]


class SolutionList(ListPage):
    """Solutions."""

    solutions: Sequence[SolutionSummary]


class DiscoveryList(ListPage):
    """Searches for missing effects."""

    discoveries: Sequence[DiscoverySummary]


class ProposalList(ListPage):
    """Proposals."""

    proposals: Sequence[ProposalSummary]


class PushJournal(ListPage):
    """The journal of pushes."""

    entries: Sequence[PushTransition]


class CheckList(ListPage):
    """Checks of all machines."""

    verifications: Sequence[Verification]


class LatestChecks(ApiAnswer):
    """Checks of this service's machine, newest first."""

    verifications: Sequence[Verification]


class DeviceList(ApiAnswer):
    """Devices of this service's machine, as last known: the request does not contact them."""

    machine: str
    devices: Sequence[DeviceStatus]


class Recipe(ApiAnswer):
    """A builtin recipe that a schedule can name."""

    name: str
    about: str


class RecipeList(ApiAnswer):
    """Builtin recipes."""

    recipes: Sequence[Recipe]


class ErrorList(ApiAnswer):
    """All error codes with their meanings."""

    errors: Sequence[ErrorEntry]


class Timetable(ApiAnswer):
    """The timetable of this service's machine."""

    machine: str
    schedules: Sequence[ScheduleState]


class JobList(ApiAnswer):
    """The latest jobs, newest first, and the recipes that can be started."""

    recipes: Sequence[str]
    jobs: Sequence[JobState]


class UserList(ApiAnswer):
    """All users."""

    users: Sequence[UserSummary]


class AuditList(ApiAnswer):
    """Records, oldest first."""

    records: Sequence[AuditEvent]


class Me(ApiAnswer):
    """The current user. ``csrf_token`` is empty for tokens and onlookers."""

    name: str
    role: str
    permissions: list[str]
    csrf_token: str


class StopToken(ApiAnswer):
    """The value of the header ``X-CSRF-Token`` for a stop; empty for tokens."""

    csrf_token: str


class Decision(ApiAnswer):
    """A decision on a proposal. ``expiry``: end of an approval."""

    proposal: int
    decision: Literal["approved", "rejected"]
    by: str
    utc: str
    expiry: str | None = None
    reason: str | None = None


class Health(ApiAnswer):
    """The process answers, or is ready to work."""

    status: Literal["ok"] = "ok"


class Problem(ApiAnswer):
    """RFC 9457 problem details."""

    type: str = "about:blank"
    title: str
    status: int
    detail: str = ""
    code: str = ""


class RequestBody(BaseModel):
    """Base of all bodies of requests."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class NewJob(RequestBody):
    """A recipe to measure now."""

    recipe: Annotated[str, Field(min_length=1, max_length=LONGEST_RECIPE)]
    rate_hz: Annotated[int, Field(ge=1, le=1000, description="Ball-bar samples per second; has to divide 1000")] = USUAL_HZ
    alarm: Annotated[int, Field(ge=0, le=LARGEST, description="Number of the alarm whose cause a full campaign looks for; 0: none")] = 0
    resume: Annotated[
        str,
        Field(
            max_length=WORD,
            description="The last full campaign of this recipe, if it was interrupted: complete runs are kept, every other set-up is "
            "mounted anew. Whoever asks for it states that nothing was repaired, adjusted or moved at the machine since",
        ),
    ] = ""


class ApproveBody(RequestBody):
    """Longest validity of the approval."""

    hours: Annotated[float, Field(ge=0.01, le=720.0)] = 24.0


class RejectBody(RequestBody):
    """Reason of a rejection, for the proposer."""

    reason: Annotated[str, Field(min_length=1, max_length=500)]


class RollbackBody(RequestBody):
    """The table to remove: its push, its CRC-32 as `/table` shows it, and the reason. Refused if another table is in force."""

    push: Annotated[int, Field(ge=1, le=2**31 - 1)]
    crc: Annotated[str, Field(pattern="^[0-9A-Fa-f]{8}$")]
    reason: Annotated[str, Field(min_length=1, max_length=500, pattern=r"\S")]


class PushBody(RequestBody):
    """An empty body: the approval determines the pushed tables."""
