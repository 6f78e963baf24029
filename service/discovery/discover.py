"""The discovery workflow: fit, suspect, propose, test, explain or leave unexplained. It is stored and resumes where it was stopped.

The search itself (`search`) is one pure computation that takes seconds (`abbe.models.discovery.discover`). The journal stores the finding
with the first state that follows from it, so that nothing is computed twice. It stores the new model version with the last state.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace

from abbe.models.arrays import F1
from abbe.models.discovery.answer import Discovery
from abbe.models.discovery.case import Case
from abbe.models.effects.effect import Effect
from abbe.service.campaign_data.campaign_checks import check_files, check_readings, copy_issues, refuse
from abbe.service.campaign_data.campaign_folder import Campaign
from abbe.service.campaign_data.decimation import lines_of, thinned, thinning
from abbe.service.campaign_data.provenance import code_digest, machine_digest, run_digest, versions, whole_run_digest
from abbe.service.clock import SystemClock
from abbe.service.discovery.changed_since import ReferenceSolution
from abbe.service.discovery.discovery_states import ENDS, FOLLOWS, after_fit, entering
from abbe.service.discovery.finding import finding_of
from abbe.service.domain.discovery import DiscoveryStep, FindingSource, SearchStart
from abbe.service.domain.discovery_file import FoundThinning
from abbe.service.domain.finding import Finding
from abbe.service.domain.model_book import ModelBook, ModelVersion
from abbe.service.domain.progress import Progress, ProgressSink
from abbe.service.domain.run import Run
from abbe.service.effects.axis_test import SLOW_DRIFT, is_axis_test
from abbe.service.effects.effect_sums import readings_of, without
from abbe.service.effects.model_book import applies, extended_book
from abbe.service.errors import NotObservable
from abbe.service.identification.removal import NO_TABLE, CampaignTable, remove_table, table_line
from abbe.service.identification.solve import ALL_READINGS
from abbe.service.runs.cases import case_of
from abbe.service.runs.observations import run_data

Search = Callable[[Case, tuple[Effect, ...], ProgressSink], Discovery]
"""Function that searches a case for effects of the catalogue and reports to a progress sink."""
Thin = Callable[[list[Run]], list[Run]]


@dataclass(frozen=True)
class DiscoveryJob:
    """Input of a discovery.

    ``campaign``: as measured. ``runs``: its runs, decimated (`abbe.service.campaign_data.decimation`) and without the effect of an active
    table; ``table_mm``: this effect by run. ``case``: these runs, also without the effects of the model book's version ``base``; ``known``:
    labels of these effects; ``known_mm``: their contributions by run. ``effects``: the catalogue. ``flags``: doubtful features of single
    runs, and effects that decimation hides. ``thinning``: the decimation in numbers, None if no run was decimated. ``since``: the
    solution to compare with.

    ``expected_version``: version that must still be current when this discovery adds a version: the newest at its start, or the version
    that the continued discovery added.
    """

    campaign: Campaign
    runs: list[Run]
    case: Case
    effects: tuple[Effect, ...]
    base: ModelVersion | None
    known_mm: dict[str, F1]
    known: tuple[str, ...]
    flags: tuple[str, ...]
    thinning: FoundThinning | None = None
    expected_version: int | None = None
    table_mm: dict[str, F1] = field(default_factory=dict)
    since: ReferenceSolution | None = None

    @property
    def source(self) -> FindingSource:
        """Origin of a finding: campaign, digests of runs and machine, program versions."""
        runs = {r.run_id: run_digest(r) for r in self.campaign.runs}
        digest = machine_digest(self.case.machine)
        return FindingSource(campaign=self.campaign.name, machine_digest=digest, runs=runs, versions=versions())

    @property
    def digest(self) -> str:
        """SHA-256 of all columns and roles, the campaign's head, catalogue and program; equal for equal searches."""
        head = {k: self.campaign.doc.get(k) for k in ("machine", "current_model", "instruments", "temperature_sensors")}
        runs = sorted(whole_run_digest(r) for r in self.runs)
        files = {e.name: code_digest(e.signal) for e in self.effects}
        content = [asdict(self.source), head, runs, sorted(self.case.includes), files]
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _without_artefacts(campaign: Campaign) -> tuple[Campaign, list[str]]:
    """Leave out points of artefacts: only a solution of the poses separates errors of the part from errors of the machine."""
    artefacts = [r.run_id for r in campaign.runs if r.is_artefact]
    if not artefacts:
        return campaign, []
    if len(artefacts) == len(campaign.runs):
        raise NotObservable(
            f"campaign {campaign.name} has only points of artefacts, which the search does not read",
            f"`abbe discover {campaign.name}` separates errors of the part from errors of the machine, without a search",
        )
    return campaign.without(artefacts), [f"points of artefacts were left out of the search: {', '.join(artefacts)}"]


def prepare(
    campaign: Campaign,
    effects: tuple[Effect, ...],
    base: ModelVersion | None = None,
    *,
    table: CampaignTable = NO_TABLE,
    since: ReferenceSolution | None = None,
    thin: Thin = thinned,
) -> DiscoveryJob:
    """Check a campaign's runs and subtract the effects of the model book.

    Parameters
    ----------
    base : ModelVersion, optional
        Current version of the machine's model. A version for another geometry is flagged and not used.
    table : CampaignTable
        The table that was active during the measurement. Its effect beyond smooth corrections is subtracted from the readings and flagged.
    since : ReferenceSolution, optional
        An earlier solution; the finding then includes the changes since.
    thin : function
        Decimates runs to the number of readings that a search can process.

    Raises
    ------
    CampaignRefused
        The data of a run contradict its description.
    NotObservable
        No run has the role identify, or all are points of artefacts.
    ModelUnknown
        The book contains an effect that is not in the catalogue.
    """
    campaign, flags = _without_artefacts(campaign)
    flags += _checked(campaign)
    left = remove_table(campaign, table.table)
    flags += [table_line(left.removed)] if left.removed is not None else [table.why] if table.why else []
    runs = thin(left.runs)
    hidden = thinning(left.runs, runs)
    table_mm = {} if left is campaign else _difference_mm(thin(campaign.runs), runs)
    flags += lines_of(hidden) if hidden is not None else ()
    case = case_of(campaign.doc, campaign.site.machine, runs)
    expected_version = None if base is None else base.version
    if base is not None and base.book.machine_digest != machine_digest(case.machine):
        flags.append(f"model version {base.version} of {base.machine} is for another geometry and was not used")
        base = None
    known = [] if base is None else [e for e in base.book.effects if applies(e, campaign.name)]
    known_mm = readings_of(known, effects, case)
    labels = tuple(e.label for e in known)
    return DiscoveryJob(
        campaign, runs, without(case, known_mm), effects, base, known_mm, labels, tuple(flags), hidden, expected_version, table_mm, since
    )


def _difference_mm(measured: list[Run], corrected: list[Run]) -> dict[str, F1]:
    """Return measured minus corrected readings of each run, mm."""
    pairs = [(before, after) for before, after in zip(measured, corrected, strict=True) if not before.is_sealed]
    return {before.run_id: before.columns.readings_mm - after.columns.readings_mm for before, after in pairs}


def _checked(campaign: Campaign) -> list[str]:
    used = [r for r in campaign.runs if r.identifies]
    if not used:
        raise NotObservable("no run of this campaign has the role identify", "measure an identification campaign first")
    flags = check_files(campaign.site.doc, used)
    flags += copy_issues([*used, *(r for r in campaign.runs if r.role == "holdout")])
    refuse(flags)
    # Wrong units, signs and axes are refused. A run that merely disagrees with the others is not flagged: the search looks for the reason.
    refuse(check_readings(campaign.site.machine, [run_data(r, blocks=ALL_READINGS) for r in used]))
    return [f.line for f in flags]


class DiscoveryJournal:
    """States of one discovery in order, in memory only; `StoredJournal` writes them to the store."""

    def __init__(self) -> None:
        self.steps: list[DiscoveryStep] = []
        self.version: int | None = None

    def write(self, step: DiscoveryStep, model: ModelBook | None = None) -> None:
        """Append a state.

        Raises
        ------
        ValueError
            The state cannot follow the last one.
        """
        last = self.steps[-1].state if self.steps else None
        if step.state not in FOLLOWS[last]:
            raise ValueError(f"{step.state} cannot follow {last}")
        self._persist(len(self.steps), step, model)
        self.steps.append(step)

    def _persist(self, seq: int, step: DiscoveryStep, model: ModelBook | None) -> None:
        """Write the state to the store; does nothing in memory."""

    @property
    def id(self) -> int | None:
        """Number of the discovery in the store; None if it is not stored."""
        return None

    @property
    def finding(self) -> Finding | None:
        """The finding; None before the search ends."""
        return next((step.finding for step in self.steps if step.finding is not None), None)

    @property
    def ended(self) -> bool:
        """Whether the discovery reached its last state."""
        return bool(self.steps) and self.steps[-1].state in ENDS


def discover(job: DiscoveryJob, journal: DiscoveryJournal, search: Search, progress: ProgressSink) -> Finding:
    """Run a discovery from the last state of its journal to its end, and return the finding.

    Raises
    ------
    StoreError
        Another process is working on the same discovery.
    ModelMovedOn
        The model got a new version after this search began. Nothing is added; the finding stays in the journal.
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
    """Whether this step adds the finding to the model book."""
    return step.state == "EXPLAINED" and bool(finding.effects) and step.not_added is None


def _version(job: DiscoveryJob, journal: DiscoveryJournal, finding: Finding) -> ModelBook:
    """Return the model book, extended by those effects of a proved finding that shift readings."""
    return extended_book(job.base, replace(finding, effects=entering(finding)), job.source, journal.id, job.effects)


def search(case: Case, effects: tuple[Effect, ...], sink: ProgressSink) -> Discovery:
    """Find effects that a case's model lacks (`abbe.models.discovery.discover`), and report progress and remaining time to ``sink``.

    A positioning test of one axis is first searched for a drift of its repeats (`abbe.service.discovery.axis_search`).
    """
    from abbe.models.discovery.discover import discover
    from abbe.service.discovery.axis_search import axis_discovery

    clock = SystemClock()
    begun = clock.monotonic_s()

    def report(text: str, share: float) -> None:
        spent = clock.monotonic_s() - begun
        sink(Progress("discover", share, 1.0, spent * (1.0 - share) / share if share > 0.0 else None, text))

    found = (axis_discovery if is_axis_test(case) else discover)(case, effects, progress=report)
    sink(Progress("discover", 1.0, 1.0, 0.0, "done"))
    return found
