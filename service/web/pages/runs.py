"""Runs for the screens: a filtered list, one run with its figures and pictures, and up to four runs compared."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from markupsafe import Markup

from abbe.service.campaign_data.campaign_folder import Campaign
from abbe.service.domain.machine import DeviceUrls, Rules, machine_from_doc
from abbe.service.domain.measured import RunRecord
from abbe.service.domain.run import Run
from abbe.service.errors import AbbeError
from abbe.service.queries.measured import RunSummary, campaigns, runs_by_state
from abbe.service.queries.reader import Reader
from abbe.service.rendering.document import Document
from abbe.service.rendering.model import PolarTrace
from abbe.service.rendering.numbers import COVERAGE, finite, plain
from abbe.service.rendering.plots.curves import difference_plot, overlay_plot
from abbe.service.rendering.plots.polar import polar_plot
from abbe.service.report.report_measured import Measured, run_report
from abbe.service.runs.columns import load_run
from abbe.service.runs.observations import run_data, with_earliest_mounting
from abbe.service.site import Site
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
from abbe.service.web.language import Translate
from abbe.service.web.pages.context import find_or_none

TESTS = ("ballbar_helix", "ballbar_circle", "laser_diagonal", "laser_linear")
STATES = ("complete", "running", "incomplete", "stopped", "aborted", "failed", "interrupted", "disk_full")
MOST_RUNS = 100
MOST_CAMPAIGNS = 50


@dataclass(frozen=True, slots=True)
class RunsQuery:
    """Filter of the list of runs; empty fields match all."""

    campaign: str = ""
    test: str = ""
    state: str = ""


@dataclass(frozen=True, slots=True)
class RunListing:
    """The newest matching runs, whether there are more, and the campaigns to choose from."""

    runs: list[RunSummary]
    more: bool
    campaigns: list[str]


@dataclass(frozen=True, slots=True)
class RunScreen:
    """One run. ``document``: its report, None if the run is unreadable; ``trouble``: the reason."""

    record: RunRecord
    document: Document | None
    trouble: str = ""


def run_list(reader: Reader, query: RunsQuery) -> RunListing:
    """The newest matching runs."""
    names = [one.name for one in campaigns(reader, None, None, MOST_CAMPAIGNS)[0]]
    found, more = runs_by_state(reader, query.campaign, query.test, query.state, MOST_RUNS)
    return RunListing(found, more, names)


def run_screen(store: Store, record: RunRecord, rules: Rules) -> RunScreen:
    """A run with its report, judged by the limits and certificates of the machine file; ``trouble`` if it is unreadable."""
    try:
        return RunScreen(record, run_document(store, record, rules)[1])
    except AbbeError as error:
        return RunScreen(record, None, error.detail)
    except (KeyError, TypeError, ValueError, IndexError) as error:  # another version wrote the document, or it was edited
        return RunScreen(record, None, f"{type(error).__name__}: {error}")


LONG_RUN = 100_000
"""A run with more readings is first shown without its report, since making the report takes seconds."""


def readings_of(store: Store, number: int) -> int:
    """Number of samples of a run in its database."""
    return max((channel.samples for channel in store.chunks.channels(number)), default=0)


def shell_of(_store: Store, record: RunRecord, _rules: Rules) -> RunScreen:
    """Return a run without its report, which is made later."""
    return RunScreen(record, None)


def run_document(store: Store, record: RunRecord, rules: Rules) -> tuple[Run, Document]:
    """A run and its report."""
    owner = store.campaigns.find(record.campaign_id)
    machine: dict[str, Any] = store.machines.get(owner.machine_id).doc
    run = with_earliest_mounting([load_run(store, record.id)])[0]
    site = Site(str(machine.get("name") or record.campaign), machine_from_doc(machine), machine, DeviceUrls())
    return run, run_report(Measured(Campaign(record.campaign, site, [run], None, owner.known)), record.label, rules)


LETTERS = "ABCD"
LISTED = 40
MALFORMED = (KeyError, TypeError, ValueError, IndexError)


@dataclass(frozen=True, slots=True)
class ComparedLine:
    """A figure in the reader's ``unit``: value and U of each run, last minus first; ``differs``: yes, no, cannot tell."""

    figure: FigureRow
    unit: str
    shown: Sequence[tuple[str, str]]
    change: tuple[str, str]
    differs: str


@dataclass(frozen=True, slots=True)
class CompareScreen:
    """A comparison. ``choices``: selectable runs; ``runs``: the selected ones; ``trouble``: why they cannot be compared."""

    choices: Sequence[RunRecord]
    runs: Sequence[tuple[str, RunRecord]] = ()
    lines: Sequence[ComparedLine] = ()
    pictures: Sequence[tuple[Markup, str]] = ()
    remarks: Sequence[str] = ()
    trouble: str = ""


def compare_screen(store: Store, numbers: Sequence[int], translate: Translate, rules: Rules) -> CompareScreen:
    """Compare runs of the store; with fewer than two, show the choices."""
    numbers = list(dict.fromkeys(numbers))
    records = [find_or_none(store.runs.find, n) for n in numbers]
    unknown = [str(n) for n, record in zip(numbers, records, strict=True) if record is None]
    known = [record for record in records if record is not None]
    choices = _choices(store, known)
    runs = list(zip(LETTERS, known, strict=False))
    if unknown:
        return CompareScreen(choices, trouble=translate("compare.lost", numbers=", ".join(unknown)))
    if len(known) > MOST:
        return CompareScreen(choices, trouble=translate("compare.too_many", n=MOST))
    if len(known) < 2:
        return CompareScreen(choices, runs)
    try:
        loaded = [_load(store, record, rules) for record in known]
        why = next((text for one in loaded[1:] if (text := incomparable_reason(loaded[0], one))), "")
        curves = [] if why else [curve(one) for one in loaded]
    except AbbeError as error:
        return CompareScreen(choices, runs, trouble=error.detail)
    except MALFORMED as error:  # another version wrote the document, or it was edited
        return CompareScreen(choices, runs, trouble=f"{type(error).__name__}: {error}")
    if why:
        return CompareScreen(choices, runs, trouble=why)
    change = difference(curves[0], curves[1]) if len(curves) == 2 else None
    texts = [*remarks(loaded, _feed), *([_summary(change, translate)] if change is not None else [])]
    return CompareScreen(choices, runs, [_line(r) for r in figure_rows(loaded)], pictures(curves, change, translate), texts)


def _choices(store: Store, selected: Sequence[RunRecord]) -> list[RunRecord]:
    """The selected runs, then the newest that can be compared with the first of them."""
    newest = store.runs.latest(LISTED, test=selected[0].test if selected else "", status="complete")
    known = {record.id for record in selected}
    return [*selected, *(run for run in newest if run.id not in known)]


def _load(store: Store, record: RunRecord, rules: Rules) -> LoadedRun:
    run, document = run_document(store, record, rules)
    name = store.machines.get(store.campaigns.find(record.campaign_id).machine_id).name
    return LoadedRun(f"{record.campaign}/{record.label}", name, run, run_data(run), document.figures)


def _feed(mm_min: float) -> str:
    frame = current()
    return f"{mm_min / frame.drawn('mm/min').size:.5g} {frame.unit('mm/min')}"


def _line(row: FigureRow) -> ComparedLine:
    frame = current()
    differs = "cannot tell" if row.sure is None else "yes" if row.sure else "no"
    shown = [frame.with_u(v, u, row.unit) for v, u in row.values]
    return ComparedLine(row, frame.unit(row.unit), shown, frame.with_u(row.difference, row.u, row.unit), differs)


def _summary(change: RunDifference, translate: Translate) -> str:
    at = change.largest
    value, expanded = current().with_u(float(change.difference_um[at]), float(change.u_um[at]))
    share = change.beyond
    return translate("compare.largest", value=value, u=expanded, unit=current().unit(), share=f"{share:.0%}" if finite(share) else "–")


def pictures(curves: Sequence[ComparedCurve], change: RunDifference | None, translate: Translate) -> list[tuple[Markup, str]]:
    """Pictures in the reader's units with captions. The SVG writer has already escaped every text."""
    error, place = current().drawn(), current().drawn("mm")
    y = translate("compare.deviation", unit=error.sign)
    if curves[0].round:
        x = translate("compare.angle")
        traces = [PolarTrace(letter, c.x, c.deviation_um) for letter, c in zip(LETTERS, curves, strict=False)]
        first = polar_plot(traces, key="overlay", heading=translate("compare.overlay"), unit=error)
    else:
        x = translate("compare.along", unit=place.sign)
        named = [(letter, c.x / place.size, c.deviation_um) for letter, c in zip(LETTERS, curves, strict=False)]
        first = overlay_plot(named, key="overlay", heading=translate("compare.overlay"), labels=(x, y), unit=error)
    out = [(Markup(first), translate("compare.scale"))]  # noqa: S704
    if change is not None:
        along = change.x if curves[0].round else change.x / place.size
        second = difference_plot(
            along, change.difference_um, change.u_um, key="difference", heading=translate("compare.difference"), labels=(x, y), unit=error
        )
        caption = translate("compare.band", k=plain(COVERAGE, 1))
        out.append((Markup(second), caption))  # noqa: S704
    return out
