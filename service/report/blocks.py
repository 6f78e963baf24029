"""Blocks that several reports share: before and after, parameters, residuals, runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from abbe.service.rendering.document import Block, PictureBlock, Section, TextTable
from abbe.service.rendering.model import SETUP_NOTE, Contribution, ParameterRow, ResidualSeries
from abbe.service.rendering.numbers import COVERAGE, NOT_AVAILABLE, finite, plain, tidy, with_uncertainty
from abbe.service.rendering.plots.bars import contribution_bars, uncertainty_bars
from abbe.service.rendering.plots.residuals import common_range, residual_plot

SIGNS = (
    "Signs: deviation = actual − nominal, tool relative to workpiece, coordinates as commanded (ISO 230-1). Correction = −deviation, added "
    "to the command."
)
U_OF = f"U (k = {tidy(COVERAGE)})"


@dataclass(frozen=True, slots=True)
class SummaryRow:
    """One figure before and after the correction; ``u_before``, ``u_after``: standard uncertainties. All in ``unit``."""

    name: str
    unit: str
    before: float | None
    after: float | None
    u_before: float | None = None
    u_after: float | None = None
    source: Literal["measured", "sealed truth of the simulator"] = "measured"

    @property
    def factor(self) -> float | None:
        """Improvement factor of the figure."""
        return self.before / self.after if finite(self.before) and finite(self.after) and self.after != 0.0 else None


@dataclass(frozen=True, slots=True)
class RunRow:
    """One run of a solution: rms of its residuals, and the rms expected from its noise, µm."""

    label: str
    test: str
    role: str
    values: int
    residual_rms_um: float | None
    expected_um: float | None
    outliers: int = 0


def stated(value: float | None, u: float | None) -> str:
    """Value ± U (k = 2), rounded together; the value alone where it has no uncertainty."""
    number, expanded = with_uncertainty(value, u)
    return number if expanded == NOT_AVAILABLE else f"{number} ± {expanded}"


def summary_table(rows: Sequence[SummaryRow]) -> TextTable:
    """Table of figures before and after the correction, with the columns that show the effect in bold."""
    head = ("Figure", "Before", "After", "Unit", "Smaller by", "Source")
    cells = [(r.name, stated(r.before, r.u_before), stated(r.after, r.u_after), r.unit, _times(r), r.source) for r in rows]
    return TextTable(head, cells, bold=("After", "Smaller by"))


def _times(row: SummaryRow) -> str:
    return f"{plain(row.factor, 2)} ×" if finite(row.factor) else NOT_AVAILABLE


def parameter_table(rows: Sequence[ParameterRow]) -> TextTable:
    """Table of parameters with U."""
    cells = [(r.name, *with_uncertainty(r.value, r.u), r.unit, r.note) for r in rows]
    return TextTable(("Parameter", "Value", U_OF, "Unit", "Note"), cells)


def parameter_pictures(rows: Sequence[ParameterRow], ranked: Sequence[Contribution]) -> list[Block]:
    """Pictures of the largest contributions and of the uncertainty of each machine parameter."""
    caption = (
        f"What contributes most, and how well each parameter is known. Whiskers: {U_OF}. A whisker that crosses zero: the data do not show "
        "that this error differs from zero."
    )
    machine = [r for r in rows if r.note != SETUP_NOTE]
    svgs = [*([contribution_bars(ranked)] if ranked else []), *uncertainty_bars(machine)]
    return [PictureBlock(caption, svgs, "flow")] if svgs else []


def setup_section(rows: Sequence[ParameterRow]) -> list[Block]:
    """Parameters of cups, bars and mirrors as a folded section; an empty list if there are none."""
    setup = [r for r in rows if r.note == SETUP_NOTE]
    if not setup:
        return []
    pictures = uncertainty_bars(setup, key="setup")
    drawn = [PictureBlock(f"The same with {U_OF}.", pictures, "flow")] if pictures else []
    title = f"Parameters of the set-up, found along with the machine's: {len(setup)}"
    return [Section(title, [parameter_table(setup), *drawn], folded=True)]


def picture_section(pictures: Sequence[PictureBlock]) -> list[Section]:
    """The pictures of a report as a section; an empty list if there are none."""
    return [Section("Pictures", pictures)] if pictures else []


def residual_picture(series: Sequence[ResidualSeries], runs: Sequence[RunRow]) -> list[Block]:
    """Residuals of all runs on one ordinate, each with the band of its noise."""
    noise = {r.label: r.expected_um for r in runs}
    y_range = common_range(series, max((v for v in noise.values() if finite(v)), default=None))
    svgs = [residual_plot(s, noise_um=noise.get(s.label), y_range=y_range, key=f"residual-{i}") for i, s in enumerate(series)]
    caption = (
        "Measured minus modelled, all runs on one ordinate. Dashed band: ± 2 standard deviations of the reading's noise; structure that "
        "leaves the band is not in the model. Dense runs are drawn as lowest and highest value per pixel."
    )
    return [PictureBlock(caption, svgs)] if svgs else []


def run_table(rows: Sequence[RunRow]) -> TextTable:
    """Table of the runs of a solution."""
    head = ("Run", "Test", "Role", "Values", "Residual rms (µm)", "Expected (µm)", "Outliers")
    cells = [(r.label, r.test, r.role, str(r.values), plain(r.residual_rms_um), plain(r.expected_um), str(r.outliers)) for r in rows]
    return TextTable(head, cells)
