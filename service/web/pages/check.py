"""The screen of one check: verdict, a gauge for each figure, curves drawn over the curves of the last check that passed, alarms, next step,
report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

from fastapi import FastAPI
from fastapi.responses import HTMLResponse
from markupsafe import Markup

from abbe.service.domain.measured import RunRecord
from abbe.service.domain.people import Permission
from abbe.service.domain.verification import CheckFigure, Verification
from abbe.service.errors import AbbeError, NotStored
from abbe.service.queries.alarms import AlarmPath, alarms_of_check, path_with
from abbe.service.queries.checks import check as stored_check
from abbe.service.queries.checks import checks, last_good
from abbe.service.queries.reader import Reader
from abbe.service.queries.status import AlarmSummary
from abbe.service.rendering.model import PolarTrace
from abbe.service.rendering.plots.curves import overlay_plot
from abbe.service.rendering.plots.gap import thinned
from abbe.service.rendering.plots.polar import polar_plot
from abbe.service.runs.columns import load_run
from abbe.service.runs.observations import run_data, with_earliest_mounting
from abbe.service.verification.compare_runs import ComparedCurve, LoadedRun, curve, incomparable_reason
from abbe.service.web import language
from abbe.service.web.frame import current
from abbe.service.web.login.access import needs
from abbe.service.web.page import MARKS, figure_verdict, sentence
from abbe.service.web.pages.context import Number, PageContext
from abbe.service.web.pages.runs import MALFORMED
from abbe.service.web.units import converted

LOOK_BACK = 200
"""Number of earlier checks among which the last good one is searched."""


@dataclass(frozen=True, slots=True)
class Gauge:
    """A figure in the reader's words and units, as value and U; ``change``: change since the last good check, if any."""

    name: str
    unit: str
    shown: tuple[str, str]
    limit: str
    verdict: str
    picture: Markup
    change: tuple[str, str] | None = None


@dataclass(frozen=True, slots=True)
class CheckScreen:
    """One check.

    ``good``: the last earlier check of the recipe that passed; ``runs``: runs of its campaign; ``trouble``: why there are no curves.
    """

    check: Verification
    sentence: str
    gauges: Sequence[Gauge]
    good: Verification | None = None
    pictures: Sequence[Markup] = ()
    runs: Sequence[RunRecord] = ()
    alarms: Sequence[AlarmSummary] = ()
    trouble: str = ""
    older: int | None = None
    newer: int | None = None


def add_check_page(app: FastAPI, context: PageContext) -> None:
    """Add the screen of a check to the application."""

    @app.get("/check", include_in_schema=False)
    @needs(Permission.READ)
    async def check(id: Number = None) -> HTMLResponse:
        newest = await context.source.verifications(1) if id is None else []
        number = newest[0].id if newest else id
        if number is None:
            return await context.show("check.html", screen=None)
        try:
            screen = await context.read(check_screen, context.reader, number)
        except NotStored:
            return await context.missing("check", number)
        way = await context.read(_way, context.reader, number)
        return await context.show("check.html", screen=screen, marks=MARKS, way=way)


def _way(reader: Reader, number: int) -> AlarmPath | None:
    return path_with(reader, "check", number) or path_with(reader, "proof", number)


def check_screen(reader: Reader, number: int) -> CheckScreen:
    """A check with its curves. Raises NotStored, Unusable."""
    one = stored_check(reader, number)
    around = [c for c in checks(reader, one.machine, None, number, LOOK_BACK)[0] if c.id < number]
    good = last_good(around, one.recipe)
    runs, pictures, trouble = _curves(reader, one, good)
    newer = min((c.id for c in checks(reader, one.machine, None, None, LOOK_BACK)[0] if c.id > number), default=None)
    gauges = [_gauge(one, figure, good) for figure in one.figures if figure.value is not None]
    return CheckScreen(
        one,
        sentence(one),
        sorted(gauges, key=lambda gauge: gauge.limit == "–"),
        good,
        pictures,
        runs,
        alarms_of_check(reader.store, one.machine, number),
        trouble,
        around[0].id if around else None,
        newer,
    )


def _gauge(check: Verification, figure: CheckFigure, good: Verification | None) -> Gauge:
    frame, value = current(), figure.value or 0.0
    name, unit = language.figure(frame.lang, figure.name)
    shown = frame.with_u(value, None if figure.expanded is None else figure.expanded / 2.0, unit)
    limit = "–" if figure.limit is None else frame.length(f"{figure.limit:g}", unit)
    words = {"name": name, "value": shown[0], "u": shown[1], "unit": frame.unit(unit), "limit": limit}
    title = frame.translate("check.gauge.open" if figure.limit is None else "check.gauge", **words)
    drawn = [None if v is None else converted(v, unit, frame.units) for v in (value, figure.expanded, figure.limit)]
    verdict = figure_verdict(check, figure.name) if figure.limit is not None else ""
    picture = Markup(gauge_svg(title, drawn[0] or 0.0, drawn[1], drawn[2], verdict or "plain"))  # noqa: S704 - our own writer, which escapes
    return Gauge(name, frame.unit(unit), shown, limit, verdict, picture, _change(figure, good, unit))


def _change(figure: CheckFigure, good: Verification | None, unit: str) -> tuple[str, str] | None:
    """The change of a figure with the U of two independent checks; None if one of the two is not known."""
    before = None if good is None else next((f for f in good.figures if f.name == figure.name), None)
    if before is None or None in (before.value, before.expanded, figure.value, figure.expanded):
        return None
    u = ((before.expanded or 0.0) ** 2 + (figure.expanded or 0.0) ** 2) ** 0.5 / 2.0
    change = (figure.value or 0.0) - (before.value or 0.0)
    value, expanded = current().with_u(change, u, unit)
    return f"+{value}" if change > 0.0 else value, expanded


def _curves(reader: Reader, check: Verification, good: Verification | None) -> tuple[list[RunRecord], list[Markup], str]:
    """Return the runs of a check, each with a picture over the same run of the last good check."""
    try:
        runs, before = _runs(reader, check), [] if good is None else _runs(reader, good)
        now = [_loaded(reader, run, check.machine) for run in runs]
        then = [_loaded(reader, run, check.machine) for run in before]
        pictures = [_picture(one, next((o for o in then if not incomparable_reason(one, o)), None), good, k) for k, one in enumerate(now)]
    except AbbeError as error:
        return [], [], error.detail
    except MALFORMED as error:  # another version wrote the document, or it was edited
        return [], [], f"{type(error).__name__}: {error}"
    return runs, pictures, ""


def _runs(reader: Reader, check: Verification) -> list[RunRecord]:
    """The complete runs of a check, as far as they are stored."""
    if not check.campaign or not check.runs:
        return []
    try:
        campaign = reader.store.campaigns.find(check.campaign)
    except NotStored:
        return []
    labels = set(check.runs)
    return [run for run in reader.store.runs.all(campaign.id) if run.label in labels and run.visible_status == "complete"]


def _loaded(reader: Reader, record: RunRecord, machine: str) -> LoadedRun:
    run = with_earliest_mounting([load_run(reader.store, record.id)])[0]
    return LoadedRun(record.label, machine, run, run_data(run), ())


def _picture(one: LoadedRun, before: LoadedRun | None, good: Verification | None, k: int) -> Markup:
    frame = current()
    title = frame.translate("check.curve", test=frame.state("test", one.run.test), label=one.label)
    named = [] if before is None or good is None else [(frame.translate("check.before", n=good.id), curve(before))]
    return Markup(_overlay([*named, (frame.translate("check.now"), curve(one))], title, f"curve-{k}"))  # noqa: S704 - our own writer


def _overlay(curves: Sequence[tuple[str, ComparedCurve]], title: str, key: str) -> str:
    error, place = current().drawn(), current().drawn("mm")
    shown = [(name, c, thinned(c.deviation_um)) for name, c in curves]
    if curves[0][1].round:
        traces = [PolarTrace(name, c.x[at], c.deviation_um[at]) for name, c, at in shown]
        return polar_plot(traces, key=key, heading=title, unit=error)
    lines = [(name, c.x[at] / place.size, c.deviation_um[at]) for name, c, at in shown]
    frame = current()
    labels = frame.translate("compare.along", unit=place.sign), frame.translate("compare.deviation", unit=error.sign)
    return overlay_plot(lines, key=key, heading=title, labels=labels, unit=error)


WIDTH, HEIGHT = 560.0, 44.0
LEFT, RIGHT, MIDDLE = 2.0, 14.0, 22.0


def gauge_svg(title: str, value: float, expanded: float | None, limit: float | None, verdict: str) -> str:
    """Return the bar of a gauge, from zero to beyond limit and value. All numbers in one unit; ``expanded``: U, None if unknown;
    ``title``: text of the bar."""
    u = expanded or 0.0
    top = max(1.15 * (limit or 0.0), 1.1 * (abs(value) + u), 1e-12)

    def x(at: float) -> float:
        return LEFT + min(max(at, 0.0), top) / top * (WIDTH - LEFT - RIGHT)

    kind = verdict.replace(" ", "-")
    size = abs(value)
    body = [f'<rect class="track" x="{LEFT:g}" y="{MIDDLE - 7:g}" width="{WIDTH - LEFT - RIGHT:g}" height="14"/>']
    wide = max(x(size + u) - x(size - u), 1.0)
    body.append(f'<rect class="band" x="{x(size - u):.1f}" y="{MIDDLE - 7:g}" width="{wide:.1f}" height="14"/>')
    if limit is not None:
        body.append(f'<path class="limit" d="M{x(limit):.1f} 2V{HEIGHT - 2:g}"/>')
    body.append(f'<path class="mark {kind}" d="M{x(size):.1f} {MIDDLE - 12:g}l8 12l-8 12l-8 -12z"/>')
    label = escape(title, quote=True)
    return f'<svg class="gauge" viewBox="0 0 {WIDTH:g} {HEIGHT:g}" role="img" aria-label="{label}">{"".join(body)}</svg>'
