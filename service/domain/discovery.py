"""A search for what a campaign's model lacks: where it started from, and the states that it reached."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from abbe.service.domain.finding import Finding, GapUm

State = Literal["FITTED", "SUSPICIOUS", "PROPOSED", "TESTING", "EXPLAINED", "UNEXPLAINED"]
PROGRAM = "abbe discover"


@dataclass(frozen=True, slots=True, kw_only=True)
class SearchBase:
    """What a stored search goes out from.

    ``model_version``: of the model whose effects were taken out of the readings; ``after``: the version that was the current one when the
    search was opened; ``continues``: number of the ended search that this one continues after more was measured.
    """

    model_version: int | None = None
    after: int | None = None
    continues: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class FindingSource:
    """Where a finding comes from: campaign, machine and runs by their digests, versions of the programs."""

    campaign: str
    machine_digest: str
    runs: Mapping[str, str] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True)
class SearchStart:
    """The runs that are searched, the present model, and what is odd about single runs."""

    source: FindingSource
    present_model: tuple[str, ...] = ()
    model_version: int | None = None
    known_effects: tuple[str, ...] = ()
    flags: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Judgement:
    """What the runs say that only judge.

    ``proved``: None where they cannot judge; ``closed``: how much of their ``gap`` closes; ``against``: why the names are not believed.
    """

    rule: str
    proved: bool | None
    closed: float | None = None
    gap: GapUm | None = None
    against: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class DiscoveryStep:
    """A state that a discovery reached, who decided so, and why.

    ``start``: of the first state; ``finding``: of the one that follows it; ``judged``: of the test by runs that only judge and of what
    follows from it; ``not_added``: why what was explained does not enter the model book.
    """

    state: State
    why: str
    decided_by: str = PROGRAM
    start: SearchStart | None = None
    finding: Finding | None = None
    judged: Judgement | None = None
    not_added: str | None = None
