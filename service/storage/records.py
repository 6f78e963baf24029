"""What the store gives back: plain frozen values, one per table row."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from abbe.service.storage.owner import Owner

Doc = dict[str, Any]
"""A JSON object."""

RUNNING = "running"
INCOMPLETE = "incomplete"
INTERRUPTED = "interrupted"
DISK_FULL = "disk_full"
FINISHED = ("complete", "stopped", "aborted", "failed", INTERRUPTED, DISK_FULL)


@dataclass(frozen=True, slots=True)
class MachineRecord:
    """A machine as it was described at some time; another description is another record."""

    id: int
    name: str
    doc: Doc
    doc_hash: str
    created_utc: str


@dataclass(frozen=True, slots=True)
class CampaignRecord:
    """Runs that belong together: one machine, one clock zero."""

    id: int
    machine_id: int
    name: str
    doc: Doc
    created_utc: str


@dataclass(frozen=True, slots=True)
class RunRecord:
    """One measured sequence. ``status`` is what was written, ``visible_status`` what a person should be told."""

    id: int
    campaign_id: int
    campaign: str
    label: str
    test: str
    role: str
    status: str
    reason: str
    start_doc: Doc
    end_doc: Doc | None
    started_utc: str
    ended_utc: str | None
    owner: Owner

    @property
    def visible_status(self) -> str:
        """``"incomplete"`` when the run was never finished and its process is gone, else ``status``."""
        return INCOMPLETE if self.status == RUNNING and self.owner.is_gone() else self.status


@dataclass(frozen=True, slots=True)
class ChunkRecord:
    """Samples as they arrived, checked against their CRC-32. Never changed after writing."""

    run_id: int
    channel: str
    seq: int
    n: int
    codec: str
    crc32: int
    payload: bytes = field(repr=False)
    first_host_s: float
    last_host_s: float
    first_device_us: int
    last_device_us: int


@dataclass(frozen=True, slots=True)
class CheckpointRecord:
    """One line of a campaign's journal. Never changed after writing; ``seq`` counts from 0."""

    id: int
    campaign_id: int
    seq: int
    kind: str
    doc: Doc
    utc: str


@dataclass(frozen=True, slots=True)
class PushEntryRecord:
    """One transition of a push, chained by ``prev`` to the entry before it of the same machine. Never changed after writing."""

    id: int
    machine: str
    push: int
    seq: int
    state: str
    doc: Doc
    utc: str
    prev: str
    digest: str


@dataclass(frozen=True, slots=True)
class ProposalRecord:
    """Tables that somebody proposed, with everything they were made from. Never changed; ``digest``: SHA-256 of ``doc``."""

    id: int
    machine: str
    solution_id: int
    doc: Doc
    digest: str
    created_utc: str


@dataclass(frozen=True, slots=True)
class ApprovalRecord:
    """Somebody's yes to a proposal until ``expiry`` (UTC). ``name``: as given; ``login``: of the account; ``digest``: what it binds."""

    id: int
    proposal_id: int
    name: str
    login: str
    digest: str
    expiry: str
    utc: str


@dataclass(frozen=True, slots=True)
class SolutionRecord:
    """What a solver found from some runs."""

    id: int
    campaign_id: int
    kind: str
    run_ids: list[int]
    doc: Doc
    created_utc: str


@dataclass(frozen=True, slots=True)
class TableRecord:
    """A compensation table as the controller would hold it."""

    id: int
    machine_id: int
    solution_id: int | None
    image: bytes = field(repr=False)
    crc: int
    doc: Doc
    created_utc: str


@dataclass(frozen=True, slots=True)
class VerificationRecord:
    """Result of a check of the machine."""

    id: int
    machine_id: int
    campaign_id: int | None
    verdict: str
    doc: Doc
    utc: str


@dataclass(frozen=True, slots=True)
class DiscoveryRecord:
    """One search for what a campaign's model lacks. ``digest``: of readings, model and program; the same search has the same."""

    id: int
    campaign_id: int
    digest: str
    doc: Doc
    created_utc: str


@dataclass(frozen=True, slots=True)
class StepRecord:
    """One state that a discovery reached, with what was known then. Never changed after writing; ``seq`` counts from 0."""

    id: int
    discovery_id: int
    seq: int
    state: str
    doc: Doc
    utc: str


@dataclass(frozen=True, slots=True)
class ModelRecord:
    """One version of a machine's model. Never changed; ``version`` counts from 1. ``discovery_id``: what brought it, None for a person."""

    id: int
    machine: str
    version: int
    discovery_id: int | None
    doc: Doc
    created_utc: str


@dataclass(frozen=True, slots=True)
class NewVersion:
    """A version of a machine's model on its way in. ``after``: the version that has to be the current one then; None: none at all."""

    machine: str
    after: int | None
    doc: Doc


@dataclass(frozen=True, slots=True)
class AlarmEntryRecord:
    """One line of what became of a machine's alarm. Never changed; ``alarm`` counts from 1 for each machine, ``seq`` from 0."""

    id: int
    machine: str
    alarm: int
    seq: int
    kind: str
    doc: Doc
    utc: str


@dataclass(frozen=True, slots=True)
class SlotRecord:
    """One slot of a schedule and what became of it. ``reason``: the sentence to ``state``; ``finished_utc``: None while it is open."""

    id: int
    schedule: str
    slot_utc: str
    state: str
    reason: str
    claimed_utc: str
    finished_utc: str | None


@dataclass(frozen=True, slots=True)
class HeartbeatRecord:
    """What the service of a machine said of itself last."""

    machine: str
    doc: Doc
    seen_utc: str
    owner: Owner


@dataclass(frozen=True, slots=True)
class OutboxRecord:
    """A message that must reach the broker some day."""

    id: int
    topic: str
    payload: bytes
    created_utc: str


@dataclass(frozen=True, slots=True)
class ImportedRun:
    """A run on its way in from an exchange file, with its channels packed."""

    label: str
    test: str
    role: str
    start_doc: Doc
    n: int
    codec: str
    payload: bytes = field(repr=False)
