"""Stored results of runs: solutions, tables, checks, discoveries, models. One record is one row."""

from __future__ import annotations

from dataclasses import dataclass, field

from abbe.service.domain.document import Doc


@dataclass(frozen=True, slots=True)
class SolutionRecord:
    """The result of a solver from some runs."""

    id: int
    campaign_id: int
    kind: str
    run_ids: list[int]
    doc: Doc
    created_utc: str


@dataclass(frozen=True, slots=True)
class TableRecord:
    """A compensation table as the controller would hold it. ``solution_id`` None: it was read back from the controller."""

    id: int
    machine_id: int
    solution_id: int | None
    image: bytes = field(repr=False)
    crc: int
    doc: Doc
    created_utc: str


@dataclass(frozen=True, slots=True)
class VerificationRecord:
    """Result of a check of the machine. ``campaign_id``: the campaign that was measured for it."""

    id: int
    machine_id: int
    campaign_id: int | None
    verdict: str
    doc: Doc
    utc: str


@dataclass(frozen=True, slots=True)
class DiscoveryRecord:
    """One search for what a campaign's model lacks. ``digest``: of readings, model and program, equal for equal searches."""

    id: int
    campaign_id: int
    digest: str
    doc: Doc
    created_utc: str


@dataclass(frozen=True, slots=True)
class StepRecord:
    """One state that a discovery reached, with its evidence. Never changed after writing; ``seq`` counts from 0."""

    id: int
    discovery_id: int
    seq: int
    state: str
    doc: Doc
    utc: str


@dataclass(frozen=True, slots=True)
class ModelRecord:
    """One version of a machine's model. Never changed; ``version`` counts from 1; ``discovery_id`` None: a person made it."""

    id: int
    machine: str
    version: int
    discovery_id: int | None
    doc: Doc
    created_utc: str


@dataclass(frozen=True, slots=True)
class NewVersion:
    """A new version of a machine's model. ``after``: the version that must be current when it is stored; None: no version yet."""

    machine: str
    after: int | None
    doc: Doc
