"""The discovery workflow: fit, suspect, propose, test, explain or say that nothing explains. Persistent: killed anywhere, it goes on there.

The search itself is one pure computation of seconds (`abbe.models.discovery.discover`). Its finding is written together with the first
state that follows from it, so that nothing is computed twice; the version of the model that it brings, together with the last.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from abbe.models.arrays import F1
from abbe.models.discovery.answer import Discovery
from abbe.models.discovery.case import Case
from abbe.models.effects.effect import Effect
from abbe.service.campaign_data.campaign_checks import check_files, check_readings, refuse
from abbe.service.campaign_data.campaign_folder import Campaign
from abbe.service.campaign_data.copied_runs import copies
from abbe.service.campaign_data.decimation import lines_of, thinned, thinning
from abbe.service.campaign_data.provenance import code_digest, machine_digest, run_digest, versions, whole_run_digest
from abbe.service.discovery.changed_since import Since
from abbe.service.discovery.discovery_states import ENDS, FOLLOWS, after_fit, entering
from abbe.service.discovery.finding import finding_of
from abbe.service.domain.discovery import DiscoveryStep, FindingSource, SearchStart
from abbe.service.domain.discovery_file import FoundThinning
from abbe.service.domain.finding import Finding
from abbe.service.domain.model_book import ModelBook, ModelVersion
from abbe.service.domain.progress import ProgressSink
from abbe.service.effects.axis_test import SLOW_DRIFT
from abbe.service.effects.known_effects import applies, readings_of, without
from abbe.service.effects.model_book import grown
from abbe.service.errors import NotObservable
from abbe.service.identification.solve import ALL_READINGS
from abbe.service.identification.table_removal import NO_TABLE, TableThen, as_left, table_line
from abbe.service.runs.cases import case_of
from abbe.service.runs.observations import run_data

Search = Callable[[Case, tuple[Effect, ...], ProgressSink], Discovery]
"""The computation: case, catalogue, whom to tell how far it is."""


Thin = Callable[[list[dict[str, Any]]], list[dict[str, Any]]]


@dataclass(frozen=True)
class DiscoveryJob:
    """What a discovery works on.

    ``campaign``: as measured; ``runs``: its runs, long ones as means (`abbe.service.campaign_data.decimation`), less what a table in force
    did; ``case``: the same with effects that the model book knows taken out of the readings; ``known_mm``: these, per run; ``known``: their
    labels; ``base``: the version of the book they are from; ``flags``: what is odd about single runs, and what thinning hides;
    ``thinning``: that in figures, None where nothing was thinned; ``seen``: the version that has to be the current one when a new one is
    added - ``base``, unless that is of another geometry, or the discovery goes on with one that has added a version of the same readings
    itself; ``table_mm``: what a table in force did, per run, where it was taken out; ``since``: the solution that it is compared with.
    """

    campaign: Campaign
    runs: list[dict[str, Any]]
    case: Case
    effects: tuple[Effect, ...]
    base: ModelVersion | None
    known_mm: dict[str, F1]
    known: tuple[str, ...]
    flags: tuple[str, ...]
    thinning: FoundThinning | None = None
    seen: int | None = None
    table_mm: dict[str, F1] = field(default_factory=dict)
    since: Since | None = None

    @property
    def source(self) -> FindingSource:
        """Where a finding comes from: campaign, runs by their digests, machine, program."""
        runs = {r["run_id"]: run_digest(r) for r in self.campaign.runs}
        digest = machine_digest(self.case.machine)
        return FindingSource(campaign=self.campaign.name, machine_digest=digest, runs=runs, versions=versions())

    @property
    def digest(self) -> str:
        """SHA-256 of all columns and roles, the campaign's head, catalogue and program: the same search has the same."""
        head = {k: self.campaign.doc.get(k) for k in ("machine", "current_model", "instruments", "temperature_sensors")}
        runs = sorted(whole_run_digest(r) for r in self.runs)
        files = {e.name: code_digest(e.signal) for e in self.effects}
        words = [asdict(self.source), head, runs, sorted(self.case.includes), files]
        return hashlib.sha256(json.dumps(words, sort_keys=True).encode()).hexdigest()


def prepare(
    campaign: Campaign,
    effects: tuple[Effect, ...],
    base: ModelVersion | None = None,
    *,
    table: TableThen = NO_TABLE,
    since: Since | None = None,
    thin: Thin = thinned,
) -> DiscoveryJob:
    """Check a campaign's runs and take out what the model book knows.

    Parameters
    ----------
    base : ModelVersion, optional
        Current version of the machine's model. A version of another geometry is not used, and that is flagged.
    table : TableThen
        In force while it was measured: what it did beyond smooth corrections is taken out of the readings, and flagged.
    since : Since, optional
        The solution from before that it is compared with: what has changed since is found beside what is missing.
    thin : function
        From runs to runs with as many readings as the search shall hold.

    Raises
    ------
    CampaignRefused
        A run cannot be what it says.
    NotObservable
        There is no run to identify from.
    ModelUnknown
        The book knows an effect that this catalogue does not.
    """
    flags = _checked(campaign)
    left = as_left(campaign, table.table)
    flags += [table_line(left.removed)] if left.removed is not None else [table.why] if table.why else []
    runs = thin(left.runs)
    hidden = thinning(left.runs, runs)
    table_mm = {} if left is campaign else _between(thin(campaign.runs), runs)
    flags += lines_of(hidden) if hidden is not None else ()
    case = case_of(campaign.doc, campaign.site.machine, runs)
    seen = None if base is None else base.version
    if base is not None and base.book.machine_digest != machine_digest(case.machine):
        flags.append(f"model version {base.version} of {base.machine} is of another geometry and was not used")
        base = None
    known = [] if base is None else [e for e in base.book.effects if applies(e, campaign.name)]
    known_mm = readings_of(known, effects, case)
    labels = tuple(e.label for e in known)
    return DiscoveryJob(
        campaign, runs, without(case, known_mm), effects, base, known_mm, labels, tuple(flags), hidden, seen, table_mm, since
    )


def _between(measured: list[dict[str, Any]], less: list[dict[str, Any]]) -> dict[str, F1]:
    """What was taken out of the readings of each run, mm."""
    pairs = [(a, a["columns"]["deviation_mm"], b["columns"]["deviation_mm"]) for a, b in zip(measured, less, strict=True)]
    return {run["run_id"]: np.subtract(before, after, dtype=np.float64) for run, before, after in pairs if before is not None}


def _checked(campaign: Campaign) -> list[str]:
    used = [r for r in campaign.runs if r["role"] == "identify"]
    if not used:
        raise NotObservable("no run of this campaign has the role identify", "measure an identification campaign first")
    flags = check_files(campaign.site.doc, used)
    flags += copies([*used, *(r for r in campaign.runs if r["role"] == "holdout")])
    refuse(flags)
    # Units, signs and exchanged axes are refused; that a run does not fit the others is what is looked for here and no flag.
    refuse(check_readings(campaign.site.machine, [run_data(r, blocks=ALL_READINGS) for r in used]))
    return [f.line for f in flags]


class DiscoveryJournal:
    """States of one discovery, in order; this one forgets them with the process. `StoredJournal` keeps them."""

    def __init__(self) -> None:
        self.steps: list[DiscoveryStep] = []
        self.version: int | None = None

    def write(self, step: DiscoveryStep, model: ModelBook | None = None) -> None:
        """Append a state.

        Raises
        ------
        ValueError
            It cannot follow the last one.
        """
        last = self.steps[-1].state if self.steps else None
        if step.state not in FOLLOWS[last]:
            raise ValueError(f"{step.state} cannot follow {last}")
        self._keep(len(self.steps), step, model)
        self.steps.append(step)

    def _keep(self, seq: int, step: DiscoveryStep, model: ModelBook | None) -> None:
        """Nothing is kept."""

    @property
    def id(self) -> int | None:
        """Number of the discovery in the store."""
        return None

    @property
    def finding(self) -> Finding | None:
        """What the search found, as soon as it has."""
        return next((step.finding for step in self.steps if step.finding is not None), None)

    @property
    def ended(self) -> bool:
        """Whether it came to an end."""
        return bool(self.steps) and self.steps[-1].state in ENDS


def discover(job: DiscoveryJob, journal: DiscoveryJournal, search: Search, progress: ProgressSink) -> Finding:
    """Take a discovery from wherever its journal stands to its end, and give what was found.

    Raises
    ------
    StoreError
        Another process works on the same discovery.
    ModelMovedOn
        The model has a version that this search has not known. Nothing was added; the finding is kept in the journal.
    """
    if not journal.steps:
        start = SearchStart(
            source=job.source,
            present_model=tuple(sorted(job.case.includes)),
            model_version=None if job.base is None else job.base.version,
            known_effects=job.known,
            flags=job.flags,
        )
        journal.write(DiscoveryStep(state="FITTED", why="runs checked, present model stated", start=start))
    finding = journal.finding
    if finding is None:
        found = search(job.case, job.effects, progress)
        finding = finding_of(found, job.case, (*job.effects, SLOW_DRIFT), job.known_mm, job.thinning)
        if job.since is not None:
            finding = replace(finding, changed=job.since.compare(job.campaign, entering(finding)))
    for step in list(after_fit(finding))[len(journal.steps) - 1 :]:
        journal.write(step, _version(job, journal, finding) if _enters(step, finding) else None)
    return finding


def _enters(step: DiscoveryStep, finding: Finding) -> bool:
    """Whether a finding enters the model book with this step."""
    return step.state == "EXPLAINED" and bool(finding.effects) and step.not_added is None


def _version(job: DiscoveryJob, journal: DiscoveryJournal, finding: Finding) -> ModelBook:
    """The model's version that a proved finding brings: with what moves readings, and nothing that was only seen beside it."""
    return grown(job.base, replace(finding, effects=entering(finding)), job.source, journal.id, job.effects)
