"""Plan a campaign: the measurements that reduce the uncertainty most in the available minutes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from abbe.models.machine import Machine
from abbe.models.planning.search import COVERAGE
from abbe.public.answers import Picture
from abbe.service.campaigns.plan import PlannedCampaign, describe, plan_for, plan_picture, plan_report, read_instruments
from abbe.service.domain.machine import DeviceUrls, machine_doc
from abbe.service.domain.progress import ProgressSink, ignore_progress
from abbe.service.files import write_page
from abbe.service.rendering.document_page import write_document
from abbe.service.sequences.steps import CampaignPlan
from abbe.service.site import Site

NAME = "planned"


@dataclass(frozen=True, eq=False)
class Plan:
    """Result of `plan`.

    Attributes
    ----------
    campaign : CampaignPlan
        What would be measured, in order: for `simulate`.
    U_mm : float
        Expected worst expanded uncertainty (k = 2) of the deviation in the inner 80 % of the volume: a lower bound of what `solve` will
        state.
    steps : tuple of (str, float, float)
        Each measurement in words, minutes until it is done, and expected worst U (k = 2) of the deviation afterwards, mm.
    not_observable : tuple of str
        What this campaign cannot determine, and the measurement that could.
    """

    campaign: CampaignPlan
    U_mm: float
    steps: tuple[tuple[str, float, float], ...]
    not_observable: tuple[str, ...]
    _site: Site
    _planned: PlannedCampaign

    @property
    def minutes(self) -> float:
        """Time of the whole plan, set-ups included."""
        return self._planned.plan.minutes

    def plot(self) -> Picture:
        """Draw the set-ups in the volume."""
        return Picture(plan_picture(self._site, self._planned))

    def save(self, target: str | Path) -> None:
        """Write the recipe (``.toml``) for ``abbe measure --recipe``.

        Raises
        ------
        FileFormatError
            The file cannot be written.
        """
        write_page(self._planned.text, Path(target))

    def report(self, target: str | Path) -> None:
        """Write the report that ``abbe plan --picture`` writes, as ``.html``, ``.pdf``, ``.csv`` or ``.json``.

        Raises
        ------
        FileFormatError
            The file name has another ending, or the file cannot be written.
        """
        write_document(plan_report(self._site, self._planned), Path(target))

    def __repr__(self) -> str:
        return f"<abbe.Plan: {len(self.steps)} measurements, {self.minutes:.0f} min, U = {self.U_mm * 1e3:.2g} µm>"


def plan(
    machine: Machine,
    *,
    minutes: float = 60.0,
    goal_mm: float | None = None,
    instruments: str | Path | None = None,
    progress: ProgressSink = ignore_progress,
) -> Plan:
    """Choose the measurements that lower U most in the available minutes. Nothing moves.

    Parameters
    ----------
    minutes : float
        Available, set-ups included.
    goal_mm : float, optional
        Wanted worst U (k = 2) of the deviation; the plan ends when it is reached.
    instruments : str or Path, optional
        File of the bars, noise and set-up times, as ``abbe plan --instruments`` reads it; default: usual ones.
    progress : callable, optional
        Receives `abbe.service.domain.progress.Progress` objects, each a line of text as `str`; e.g. ``print``.

    Raises
    ------
    ConfigError
        No plan is possible: too few minutes, too small strokes, or a mistake in the file.
    """
    site = Site(NAME, machine, machine_doc(NAME, machine), DeviceUrls())
    tools = read_instruments(None if instruments is None else Path(instruments))
    goal_um = None if goal_mm is None else goal_mm * 1e3
    planned = plan_for(site, minutes=minutes, goal_um=goal_um, tools=tools, progress=progress)
    steps = tuple((describe(s.test), s.until_min, COVERAGE * s.u_worst_mm) for s in planned.plan.steps)
    return Plan(planned.campaign, COVERAGE * planned.plan.u_worst_mm, steps, tuple(planned.plan.open_questions), site, planned)
