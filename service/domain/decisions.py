"""Stored decisions on tables: proposals, approvals, rejections. One record is one row."""

from __future__ import annotations

from dataclasses import dataclass

from abbe.service.domain.document import DocumentRow


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
