"""Find effects that the model of a machine lacks, and prove them on runs outside the fit."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from abbe.models.effects.effect import Effect
from abbe.public.answers import Estimate
from abbe.service.campaign_data.campaign_folder import Campaign
from abbe.service.discovery.discover import DiscoveryJob, DiscoveryJournal, prepare, search
from abbe.service.discovery.discover import discover as run_discovery
from abbe.service.discovery.effect_pages import unit
from abbe.service.domain.finding import Finding
from abbe.service.domain.progress import ProgressSink, ignore_progress
from abbe.service.effects.effect_catalogue import catalogue, checked
from abbe.service.rendering.document_page import write_document
from abbe.service.report.report_discovery import found_report


@dataclass(frozen=True, eq=False)
class DiscoveryAnswer:
    """Result of `discover`.

    Attributes
    ----------
    verdict : str
        ``"named"``, ``"none"`` (measurement and simulation agree), or ``"unknown"`` (the catalogue does not explain the difference).
    proved : bool
        Whether runs that were never fitted confirm the named effects.
    effects : dict
        Signed strength with standard uncertainty by label, e.g. ``"backlash:X"``.
    gap : dict
        For each role of runs (``"identify"``, ``"holdout"``): rms of the differences between measured and simulated readings, simulated
        without the effects (``before_um``) and with them (``after_um``); and the noise that no model removes (``floor_um``).
    next_measurement : dict or None
        The most informative next measurement: what it ``adds``, which effects it ``separates``, how many ``minutes`` it takes, and ``why``.
    """

    verdict: str
    proved: bool
    effects: dict[str, Estimate]
    gap: dict[str, dict[str, float]]
    next_measurement: dict[str, Any] | None
    _job: DiscoveryJob
    _journal: DiscoveryJournal
    _finding: Finding

    def report(self, target: str | Path) -> None:
        """Write the report that ``abbe discover --report`` writes, as ``.html``, ``.pdf``, ``.csv`` or ``.json``.

        Raises
        ------
        FileFormatError
            The file name has another ending, or the file cannot be written.
        """
        made = datetime.now(UTC).isoformat(timespec="seconds")
        write_document(found_report(self._job, self._journal, self._finding, made), Path(target))

    def __repr__(self) -> str:
        return f"<abbe.Answer: {self.verdict}, {', '.join(self.effects) or 'no effect'}>"


def discover(campaign: Campaign, *, effects: tuple[Effect, ...] = (), progress: ProgressSink | None = None) -> DiscoveryAnswer:
    """Find where measurement and simulation disagree, and name the missing effect.

    Parameters
    ----------
    effects : tuple of Effect
        Additional effects to search for beside the catalogue; each must pass the self-test.
    progress : callable, optional
        Receives `abbe.service.domain.progress.Progress` objects, each a line of text as `str`; e.g. ``print``. None: nobody.

    Raises
    ------
    EffectPluginBroken
        One of ``effects`` fails the self-test, or reuses a name of the catalogue.
    NotObservable, CampaignRefused
        No run has the role identify, or the data of a run contradict its description.
    """
    known = catalogue()
    job = prepare(campaign, (*known, *checked(effects, {e.name for e in known})))
    journal = DiscoveryJournal()
    finding = run_discovery(job, journal, search, progress or ignore_progress)
    found = {e.label: Estimate(e.strength, e.u_strength, unit(e.unit), "observed") for e in finding.effects}
    gap = {role: asdict(one) for role, one in finding.gaps.items()}
    following = None if finding.next_test is None else asdict(finding.next_test)
    return DiscoveryAnswer(finding.verdict, finding.proved, found, gap, following, job, journal, finding)
