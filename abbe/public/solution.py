"""Solve a campaign: error motions with uncertainty, deviation anywhere in the volume, compensation tables."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from abbe.models.arrays import F2
from abbe.models.compensation.nine_tables import nine_tables
from abbe.models.compensation.tables import NineTables, quantise
from abbe.public.answers import Estimate, Picture
from abbe.service.campaign_data.campaign_folder import Campaign
from abbe.service.domain.machine import Rules
from abbe.service.errors import TableRefused
from abbe.service.identification.removal import campaign_table, remove_effects, table_line
from abbe.service.identification.solve import ProgressText, solve_runs
from abbe.service.identification.solve_report import Assessment, assess, solution_of, solution_verdict
from abbe.service.rendering.document_page import write_document
from abbe.service.rendering.model import MotionCurve
from abbe.service.rendering.plots.tables import motion_bands
from abbe.service.report.report import solution_report
from abbe.service.report.report_measured import SolutionResult
from abbe.service.report.solution_sections import motion_curves, parameter_rows


@dataclass(frozen=True, eq=False)
class Deviation:
    """Deviation of the tool from its commanded position, mm; best-fit rigid motion over the strokes removed.

    Attributes
    ----------
    value_mm : array, shape (n, 3)
        Tool relative to the workpiece, mean of both directions of motion.
    U_mm : array, shape (n, 3)
        Expanded uncertainty of each component at 95 %.
    """

    value_mm: F2
    U_mm: F2


class Solution:
    """Error motions of a machine from the runs of a campaign; result of `solve`."""

    def __init__(self, campaign: Campaign, found: Assessment, table: str = "") -> None:
        self.campaign = campaign
        self.table = table
        """The compensation table in force during the runs, and whether its side effects are subtracted; empty without one."""
        self._found = found

    @property
    def model(self) -> str:
        """Model of the solution: ``"rigid6"`` or ``"rigid21"`` (see `solve`)."""
        return self._found.joint.model

    @property
    def verdict(self) -> str:
        """One line: how far this solution can be trusted, and what limits it."""
        verdict = solution_verdict(self._found)
        return f"{verdict.word}: {verdict.text}"

    @property
    def flags(self) -> tuple[str, ...]:
        """Doubts about single runs, one line each; while there are any, `tables` refuses."""
        return tuple(f.line for f in self._found.solved.flags)

    @property
    def not_observable(self) -> tuple[str, ...]:
        """What these runs cannot determine, and which measurement would."""
        return tuple(g.text for g in self._found.observability.hidden)

    @cached_property
    def parameters(self) -> dict[str, Estimate]:
        """Estimates by name: mean scales (``"EXX"``, µm/m) and squareness (``"C0Y"``, µrad), lost motion, then cups, bars, mirrors."""
        status = {m.name: m.status for m in self._found.observability.motions}
        return {
            row.name: Estimate(row.value, row.u, row.unit, status.get(row.name, "observed"))
            for row in parameter_rows(self._found.joint)
            if row.value is not None and row.u is not None
        }

    @cached_property
    def motions(self) -> dict[str, MotionCurve]:
        """Error motions (ISO 230-1 names) over their strokes: ``position_mm``, ``value``, ``u`` (k = 1), ``unit``, ``status``."""
        return {curve.name: curve for curve in motion_curves(self._found)}

    def deviation(self, points_mm: ArrayLike) -> Deviation:
        """Predict the deviation at commanded positions, shape (n, 3) or (3,).

        Raises
        ------
        ValueError
            The shape is wrong, or a number is not finite.
        """
        points = np.atleast_2d(np.asarray(points_mm, dtype=np.float64))
        if points.ndim != 2 or points.shape[1] != 3:
            raise ValueError(f"points_mm: expected shape (n, 3) or (3,), got {np.shape(points_mm)}")
        bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
        if bad.size:
            raise ValueError(f"points_mm: row {bad[0] + 1} holds a number that is not finite")
        predicted = self._found.predict(points)
        return Deviation(predicted.deviation_mm, predicted.expanded_mm)

    def tables(self, counts: tuple[int, int, int], *, unit_mm: float = 1e-4) -> NineTables:
        """Return nine compensation tables (corrections in mm), rounded to the control's unit. Nothing is written to any machine.

        Parameters
        ----------
        counts : (int, int, int)
            Grid points of X, Y and Z.
        unit_mm : float
            Unit of a table value in the control, mm.

        Raises
        ------
        TableRefused
            A flag is open, or the solution is not good enough for a table.
        """
        verdict = solution_verdict(self._found)
        if self.flags:
            raise TableRefused(f"no tables from a solution with open flags: {self.flags[0]}", "look at that run first; nothing was written")
        if verdict.sign == "bad":
            raise TableRefused(
                f"no tables from a solution that is {verdict.word}: {verdict.reasons[0]}", "measure more; nothing was written"
            )
        return quantise(nine_tables(self._found.joint, counts, sources=self._found.sources), unit_mm)

    def plot(self) -> Picture:
        """Plot the error motions over their strokes with bands of U (k = 2)."""
        curves = list(self.motions.values())
        units = dict.fromkeys(c.unit for c in curves)
        return Picture("".join(motion_bands([c for c in curves if c.unit == unit], key=f"motions{i}") for i, unit in enumerate(units)))

    def report(self, target: str | Path) -> None:
        """Write the report that ``abbe solve --report`` writes, as ``.html``, ``.pdf``, ``.csv`` or ``.json``.

        Raises
        ------
        FileFormatError
            The file name has another ending, or the file cannot be written.
        """
        made = datetime.now(UTC).isoformat(timespec="seconds")
        result = SolutionResult(solution_of(self._found), account=self._found)
        write_document(solution_report(None, self.campaign, result, made, Rules()), Path(target))

    def __repr__(self) -> str:
        return f"<abbe.Solution of {self.campaign.name}: {self.model}, {self.verdict}>"


def solve(
    campaign: Campaign, *, model: Literal["rigid6", "rigid21", "auto"] | None = None, progress: ProgressText | None = None
) -> Solution:
    """Estimate the error motions from the runs with the role ``identify``, after checking each run for consistency.

    Parameters
    ----------
    model : str, optional
        ``"rigid6"``: three scales and three squareness; ``"rigid21"``: 21 error motions; ``"auto"``: the model that predicts left-out
        set-ups and regions of the volume best. None: rigid21, or rigid6 with a flag if the readings are too few.
    progress : callable, optional
        Receives one line of text per stage, e.g. ``print``.

    Raises
    ------
    NotObservable
        No run has the role identify.
    CampaignRefused, InstrumentsDisagree
        The data of a run, bar or mirror contradict its description; the message names it and the remedy.
    """
    known = remove_effects(None, campaign, campaign_table(None, campaign))
    tools = campaign.doc.get("instruments")
    solved = solve_runs(campaign.site, known.campaign.runs, model=model, instruments=tools, progress=progress)
    found = assess(solved, unknown_table=bool(known.not_removed))
    return Solution(campaign, found, table_line(known.in_force) if known.in_force is not None else known.not_removed)
