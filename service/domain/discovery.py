"""A discovery, the search for effects that a campaign's model lacks: its start and the states that it reached."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from abbe.service.domain.finding import Finding, GapUm

State = Literal["FITTED", "SUSPICIOUS", "PROPOSED", "TESTING", "EXPLAINED", "UNEXPLAINED"]
PROGRAM = "abbe discover"


@dataclass(frozen=True, slots=True, kw_only=True)
class SearchBase:
    """Start of a stored search.

    ``model_version``: version of the model whose effects were removed from the readings; ``after``: version that was current when the
    search was opened; ``continues``: id of the ended search that this one continues with more measurements.
    """

    model_version: int | None = None
    after: int | None = None
    continues: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class FindingSource:
    """Source of a finding: campaign, digests of machine and runs, versions of the programs."""

    campaign: str
    machine_digest: str
    runs: Mapping[str, str] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True)
class SearchStart:
    """The searched runs, the present model, and remarks on single runs."""

    source: FindingSource
    present_model: tuple[str, ...] = ()
    model_version: int | None = None
    known_effects: tuple[str, ...] = ()
    flags: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Judgement:
    """Verdict of the judging runs, to which nothing was fitted.

    ``proved``: whether they confirm the named effects, None if they cannot judge; ``closed``: share of their ``gap`` that the
    effects close; ``against``: why the effects are not confirmed.
    """

    rule: str
    proved: bool | None
    closed: float | None = None
    gap: GapUm | None = None
    against: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class DiscoveryStep:
    """A state that a discovery reached, who decided it, and why.

    ``start`` belongs to the first state, ``finding`` to the second, ``judged`` to TESTING and the state after it. ``not_added``: why an
    explained effect does not enter the model book.
    """

    state: State
    why: str
    decided_by: str = PROGRAM
    start: SearchStart | None = None
    finding: Finding | None = None
    judged: Judgement | None = None
    not_added: str | None = None
