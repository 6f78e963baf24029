"""Stored results of runs (solutions, tables, checks, discoveries, models), and decisions on proposed tables. One record is one row."""

from __future__ import annotations

from dataclasses import dataclass, field

from abbe.service.domain.document import Doc, DocumentRow, HistoryRow


@dataclass(frozen=True, slots=True, kw_only=True)
class SolutionRecord(DocumentRow):
    """The result of a solver from some runs."""

    campaign_id: int
    kind: str
    run_ids: list[int]


@dataclass(frozen=True, slots=True, kw_only=True)
class TableRecord(DocumentRow):
    """A compensation table as the controller would hold it. ``solution_id`` None: a test step, or a restored table."""

    machine_id: int
    solution_id: int | None
    image: bytes = field(repr=False)
    crc: int


@dataclass(frozen=True, slots=True)
class VerificationRecord:
    """Result of a check of the machine. ``campaign_id``: the campaign that was measured for it."""

    id: int
    machine_id: int
    campaign_id: int | None
    verdict: str
    doc: Doc
    utc: str


@dataclass(frozen=True, slots=True, kw_only=True)
class DiscoveryRecord(DocumentRow):
    """One search for effects that a campaign's model lacks. ``digest``: digest of readings, model and program, equal for equal searches."""

    campaign_id: int
    digest: str


@dataclass(frozen=True, slots=True, kw_only=True)
class StepRecord(HistoryRow):
    """One state that a discovery reached, with its evidence."""

    discovery_id: int
    state: str


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelRecord(DocumentRow):
    """One version of a machine's model. Never changed; ``version`` counts from 1; ``discovery_id`` None: a person made it."""

    machine: str
    version: int
    discovery_id: int | None


@dataclass(frozen=True, slots=True)
class NewVersion:
    """A new version of a machine's model. ``after``: the version that must be current when it is stored; None: there is no version yet."""

    machine: str
    after: int | None
    doc: Doc


@dataclass(frozen=True, slots=True, kw_only=True)
class ProposalRecord(DocumentRow):
    """Proposed tables with all their sources. Never changed; ``digest``: SHA-256 of ``doc``."""

    machine: str
    solution_id: int
    digest: str


@dataclass(frozen=True, slots=True, kw_only=True)
class ProposalDecision:
    """A person's decision on a proposal. Never changed after writing; the database gives ``id`` and ``utc``.

    ``name``: the name that the person gave; ``login``: the account.
    """

    id: int = 0
    proposal_id: int
    name: str
    login: str
    utc: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class ProposalApproval(ProposalDecision):
    """An approval of the tables of this ``digest`` until ``expiry`` (UTC)."""

    digest: str
    expiry: str


@dataclass(frozen=True, slots=True, kw_only=True)
class ProposalRejection(ProposalDecision):
    """A rejection with its reason."""

    reason: str
