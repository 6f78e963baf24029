"""What the interface answers about solutions, discoveries, proposals of tables and their way into the control."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from abbe.service.runs.discovery_file import DiscoveryFile
from abbe.service.runs.solution_file import SolutionFile
from abbe.service.web.api.shapes import Answer, NextCursor


class Solution(Answer):
    """What a solver found from some runs."""

    number: int
    campaign: str
    machine: str
    kind: str
    runs: list[int]
    created_utc: str


class Solutions(Answer):
    """Solutions, newest first."""

    solutions: list[Solution]
    next_cursor: NextCursor


class SolutionDetail(Solution):
    """A solution with every parameter, its standard uncertainty, and what the runs could not tell (``not_observable``)."""

    document: SolutionFile


class Discovery(Answer):
    """One search for what a campaign's model lacks."""

    number: int
    campaign: str
    machine: str
    created_utc: str


class Discoveries(Answer):
    """Searches, newest first."""

    discoveries: list[Discovery]
    next_cursor: NextCursor


class DiscoveryState(Answer):
    """One state that a search reached."""

    state: str
    utc: str
    why: str


class ChangeRival(Answer):
    """Another change that explains nearly as much: natural logarithm of how much less likely it is."""

    name: str
    less_evidence: float


class MotionChange(Answer):
    """An error motion that has changed. ``part``: linear (scale, squareness), or the shape, whose rms over the stroke is the value.

    ``u``: standard uncertainty; ``rivals``: what these runs cannot tell it from; ``halves``: by how many of two halves of the runs it was
    chosen without the other.
    """

    motion: str
    part: Literal["linear", "shape"]
    value: float
    u: float
    unit: Literal["um/m", "urad", "um"]
    evidence: float
    rivals: list[ChangeRival]
    halves: int


class ChangeGap(Answer):
    """Measured less the solution from before, rms over runs that did not choose what changed: without and with it, and noise."""

    before_um: float
    after_um: float
    floor_um: float


class ChangedSince(Answer):
    """What has changed since an earlier solution.

    ``gap``, ``judged``: None where too few set-ups judge; ``judged``: log of how much more likely runs are with what they did not choose;
    ``hidden_um_m``: how much each scale and squareness may have changed all the same; ``beside``: effects that were found in the same runs
    and may be the same thing; ``trouble``: why nothing could be told.
    """

    since: int
    changes: list[MotionChange]
    gap: ChangeGap | None
    judged: float | None
    hidden_um_m: dict[str, float]
    proved: bool
    beside: tuple[str, ...] = ()
    trouble: str = ""


class DiscoveryDetail(Discovery):
    """A search with its states and, once it has one, its answer; ``changed`` where an earlier solution could be compared."""

    states: list[DiscoveryState]
    answer: DiscoveryFile | None
    changed: ChangedSince | None


class Approval(Answer):
    """Somebody's yes. ``login``: the account that it came by."""

    name: str
    login: str
    utc: str
    expiry: str


class Rejection(Answer):
    """Somebody's no."""

    name: str
    login: str
    utc: str
    reason: str


Word = Literal["refused", "rejected", "proposed", "approved", "expired", "superseded", "pushed", "kept", "rolled back", "changed"]


class Proposal(Answer):
    """Tables that somebody proposed. ``state`` changed: the row is not what was stored, so nothing else can be said of it."""

    number: int
    machine: str
    solution: int
    created_utc: str
    state: Word
    why: str


class Proposals(Answer):
    """Proposals, newest first."""

    proposals: list[Proposal]
    next_cursor: NextCursor


class Predicted(Answer):
    """What the model promises: rms over the volume before and after, and the standard uncertainty of the improvement."""

    before: float
    after: float
    u_model: float


class ProposalDetail(Proposal):
    """A proposal with everything that is needed to judge it, but for the numbers of the tables (`diff`)."""

    campaign: str
    by: str
    valid_until: str
    predicted_rms_um: Predicted
    base_crc: str
    generation: int
    digest: str
    two_people: bool
    reasons: list[str]
    not_for_tables: list[str]
    approvals: list[Approval]
    rejections: list[Rejection]


class Curve(Answer):
    """One of the nine tables, before and after. ``u_um``: standard uncertainty of the new entries."""

    table: str
    moved: str
    corrected: str
    position_mm: list[float]
    old_um: list[float]
    new_um: list[float]
    u_um: list[float]
    largest_change_um: float
    at_mm: float


class Diff(Answer):
    """What a proposal changes, in numbers."""

    new: str
    old: str
    tables: list[Curve]


class _Asked(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class ApproveBody(_Asked):
    """For how long the approval holds, at most."""

    hours: Annotated[float, Field(ge=0.01, le=720.0)] = 24.0


class RejectBody(_Asked):
    """Why. The proposer reads it."""

    reason: Annotated[str, Field(min_length=1, max_length=500)]


class RollbackBody(_Asked):
    """Which table shall go: the push that brought it, its CRC-32 as `/table` shows it, and why. Refused if another one is in force."""

    push: Annotated[int, Field(ge=1, le=2**31 - 1)]
    crc: Annotated[str, Field(pattern="^[0-9A-Fa-f]{8}$")]
    reason: Annotated[str, Field(min_length=1, max_length=500, pattern=r"\S")]


class PushBody(_Asked):
    """Nothing has to be said: what is pushed is what was approved."""


class Decision(Answer):
    """What was decided, by whom. ``expiry``: of an approval."""

    proposal: int
    decision: Literal["approved", "rejected"]
    by: str
    utc: str
    expiry: str | None = None
    reason: str | None = None


class PushEntry(Answer):
    """One transition of one push in the journal of a machine, chained to the one before it."""

    number: int
    machine: str
    push: int
    seq: int
    state: str
    utc: str
    prev: str
    digest: str


class PushEntries(Answer):
    """The journal of pushes, newest first."""

    entries: list[PushEntry]
    next_cursor: NextCursor


class PushEntryDetail(PushEntry):
    """An entry with everything that became known with it; tables are hexadecimal images."""

    known: dict[str, Any]
