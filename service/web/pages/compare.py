"""Up to four runs of one kind for the screen: which can be chosen, one picture on one scale, difference of two, figures side by side."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from markupsafe import Markup

from abbe.service.domain.measured import RunRecord
from abbe.service.errors import AbbeError
from abbe.service.rendering.model import PolarTrace
from abbe.service.rendering.numbers import COVERAGE, finite, plain
from abbe.service.rendering.plots.overlay import difference_plot, overlay_plot
from abbe.service.rendering.plots.polar import polar_plot
from abbe.service.report.report_parts import Rules
from abbe.service.runs.observations import run_data
from abbe.service.storage.store import Store
from abbe.service.verification.compare_runs import (
    MOST,
    ComparedCurve,
    FigureRow,
    LoadedRun,
    RunDifference,
    curve,
    difference,
    figure_rows,
    incomparable_reason,
    remarks,
)
from abbe.service.web.frame import current
from abbe.service.web.pages.context import found
from abbe.service.web.pages.runs import run_document

LETTERS = "ABCD"
LISTED = 40
UNUSED = (KeyError, TypeError, ValueError, IndexError)
Say = Callable[..., str]


@dataclass(frozen=True, slots=True)
class ComparedLine:
    """A figure in the reader's unit: value and U of each run, difference of last and first, and what it says: yes, no, cannot tell."""

    symbol: str
    name: str
    unit: str
    values: Sequence[tuple[str, str]]
    apart: tuple[str, str]
    told: str


@dataclass(frozen=True, slots=True)
class CompareScreen:
    """``choices``: runs that may be chosen; ``runs``: those that were; ``trouble``: why they cannot be compared."""

    choices: Sequence[RunRecord]
    runs: Sequence[tuple[str, RunRecord]] = ()
    lines: Sequence[ComparedLine] = ()
    pictures: Sequence[tuple[Markup, str]] = ()
    remarks: Sequence[str] = ()
    trouble: str = ""


def compare_screen(store: Store, numbers: Sequence[int], say: Say, rules: Rules) -> CompareScreen:
    """Compare runs of the store; fewer than two: what can be chosen."""
    numbers = list(dict.fromkeys(numbers))
    records = [found(store.runs.find, n) for n in numbers]
    lost = [str(n) for n, record in zip(numbers, records, strict=True) if record is None]
    there = [record for record in records if record is not None]
    choices = _choices(store, there)
    runs = list(zip(LETTERS, there, strict=False))
    if lost:
        return CompareScreen(choices, trouble=say("compare.lost", numbers=", ".join(lost)))
    if len(there) > MOST:
        return CompareScreen(choices, trouble=say("compare.too_many", n=MOST))
    if len(there) < 2:
        return CompareScreen(choices, runs)
    try:
        loaded = [_load(store, record, rules) for record in there]
        why = next((text for one in loaded[1:] if (text := incomparable_reason(loaded[0], one))), "")
        curves = [] if why else [curve(one) for one in loaded]
    except AbbeError as error:
        return CompareScreen(choices, runs, trouble=error.detail)
    except UNUSED as error:  # a document of another version, or changed by hand
        return CompareScreen(choices, runs, trouble=f"{type(error).__name__}: {error}")
    if why:
        return CompareScreen(choices, runs, trouble=why)
    apart = difference(curves[0], curves[1]) if len(curves) == 2 else None
    said = [*remarks(loaded, _feed), *([_summary(apart, say)] if apart is not None else [])]
    return CompareScreen(choices, runs, [_line(r) for r in figure_rows(loaded)], pictures(curves, apart, say), said)


def _choices(store: Store, there: Sequence[RunRecord]) -> list[RunRecord]:
    """The newest runs that could go with the first, or any; those that were chosen come first."""
    newest = store.runs.latest(LISTED, test=there[0].test if there else "", status="complete")
    kept = {record.id for record in there}
    return [*there, *(run for run in newest if run.id not in kept)]


def _load(store: Store, record: RunRecord, rules: Rules) -> LoadedRun:
    run, document = run_document(store, record, rules)
    name = store.machines.get(store.campaigns.find(record.campaign_id).machine_id).name
    return LoadedRun(f"{record.campaign}/{record.label}", name, run, run_data(run), document.figures)


def _feed(mm_min: float) -> str:
    frame = current()
    return f"{mm_min / frame.drawn('mm/min').size:.5g} {frame.unit('mm/min')}"


def _line(row: FigureRow) -> ComparedLine:
    frame = current()
    told = "cannot tell" if row.sure is None else "yes" if row.sure else "no"
    values = [frame.with_u(v, u, row.unit) for v, u in row.values]
    return ComparedLine(row.symbol, row.name, frame.unit(row.unit), values, frame.with_u(row.difference, row.u, row.unit), told)


def _summary(apart: RunDifference, say: Say) -> str:
    at = apart.largest
    value, expanded = current().with_u(float(apart.difference_um[at]), float(apart.u_um[at]))
    share = apart.beyond
    return say("compare.largest", value=value, u=expanded, unit=current().unit(), share=f"{share:.0%}" if finite(share) else "–")


def pictures(curves: Sequence[ComparedCurve], apart: RunDifference | None, say: Say) -> list[tuple[Markup, str]]:
    """Pictures in the reader's units, and captions. The SVG writer has escaped every text; escaping again would show the tags."""
    error, place = current().drawn(), current().drawn("mm")
    y = say("compare.deviation", unit=error.sign)
    if curves[0].round:
        x = say("compare.angle")
        traces = [PolarTrace(letter, c.x, c.deviation_um) for letter, c in zip(LETTERS, curves, strict=False)]
        first = polar_plot(traces, key="overlay", heading=say("compare.overlay"), unit=error)
    else:
        x = say("compare.along", unit=place.sign)
        named = [(letter, c.x / place.size, c.deviation_um) for letter, c in zip(LETTERS, curves, strict=False)]
        first = overlay_plot(named, key="overlay", heading=say("compare.overlay"), labels=(x, y), unit=error)
    out = [(Markup(first), say("compare.scale"))]  # noqa: S704
    if apart is not None:
        along = apart.x if curves[0].round else apart.x / place.size
        second = difference_plot(
            along, apart.difference_um, apart.u_um, key="difference", heading=say("compare.difference"), labels=(x, y), unit=error
        )
        words = say("compare.band", k=plain(COVERAGE, 1))
        out.append((Markup(second), words))  # noqa: S704
    return out
