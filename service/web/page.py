"""The home page: renders status and past checks as HTML on the server. The script only refreshes it."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime, tzinfo
from functools import cache
from pathlib import Path
from urllib.parse import urlencode
from zoneinfo import ZoneInfo

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from abbe.service.domain.verification import Verification
from abbe.service.queries.alarms import PathStep
from abbe.service.queries.status import Status
from abbe.service.rendering.phrases import is_whole, phrase, pictured
from abbe.service.sequences.recipes.campaigns import IDENTIFICATION, split_recipe_name
from abbe.service.web import formatting, language
from abbe.service.web.frame import current, template_functions
from abbe.service.web.strip import strip_of
from abbe.service.web.trend import Point, trend_svg
from abbe.service.web.units import converted

SCREENS = {
    "alarm": "/alarm?id={}",
    "check": "/check?id={}",
    "cause": "/discovery?id={}",
    "proposal": "/proposal?id={}",
    "approval": "/proposal?id={}",
    "push": "/table#push-{}",
    "proof": "/check?id={}",
    "report": "/api/v1/reports/verification/{}",
}


def step_address(step: PathStep, to_do_for: int | None = None) -> str:
    """Address of the result of a step, empty if there is none yet.

    With the alarm ``to_do_for``: address of the screen on which a person does the step.
    """
    if to_do_for is not None and step.key in {"cause", "proposal"}:
        return search_address(to_do_for)
    if to_do_for is not None and step.key == "proof":
        recipe, rate_hz = split_recipe_name(step.recipe)
        return "/new?" + urlencode({"recipe": recipe, "rate_hz": rate_hz})
    if step.number is None or (step.key == "report" and step.state != "now"):
        return ""
    return SCREENS[step.key].format(step.number)


def search_address(alarm: int) -> str:
    """Address of the screen on which a person starts the search for the cause of an alarm."""
    return "/new?" + urlencode({"recipe": IDENTIFICATION, "alarm": alarm})


HERE = Path(__file__).parent
MARKS = {"pass": "✔", "fail": "✖", "cannot tell": "◐"}
SHOWN_FIGURES = 4
ICON = (
    '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 32 32"><rect width="32" height="32" rx="6" fill="#22506e"/>'
    '<path d="M6 24 16 7l10 17M10 18h12" fill="none"'
    ' stroke="#fff" stroke-width="3" stroke-linejoin="round" stroke-linecap="round"/></svg>'
)


def has_uplot() -> bool:
    """Whether the library for curves that can be zoomed was fetched (deploy/npm_files.py)."""
    return (HERE / "static" / "uplot" / "uPlot.iife.min.js").exists()


def plot_files() -> Markup:
    """Return the HTML tags that load the curve library and our script; empty if the library was not fetched."""
    if not has_uplot():
        return Markup("")
    css, library, ours = "/static/uplot/uPlot.min.css", "/static/uplot/uPlot.iife.min.js", "/static/plot.js"
    return Markup('<link rel="stylesheet" href="{}"><script defer src="{}"></script><script type="module" src="{}"></script>').format(
        css, library, ours
    )


@cache
def environment() -> Environment:
    """The template environment. It escapes everything, since names and fault texts come from devices and files.

    There is one per process: compiling a template takes 0.1 s, and the environment keeps compiled templates.
    """
    env = Environment(
        loader=FileSystemLoader(HERE / "templates"), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    env.filters |= {
        "number": formatting.number,
        "length": lambda value, unit="µm", decimals=None: current().length(value, unit, decimals),
        "lengths": _lengths,
        "span": lambda seconds: language.span(current().lang, seconds),
        "picture": lambda svg: pictured(current().lang, svg),  # our own SVG writer has escaped every text
        "say": lambda text: formatting.without_commands(phrase(current().lang, str(text))),
    }
    env.tests["said"] = lambda text: is_whole(current().lang, str(text))
    env.globals |= template_functions() | {
        "step_address": step_address,
        "search_address": search_address,
        "has_uplot": has_uplot,
        "plot_files": plot_files,
    }
    return env


def render(env: Environment, status: Status, past: Sequence[Verification]) -> str:
    """The home page as HTML."""
    zone: tzinfo = ZoneInfo(status.next_due[0].timezone) if status.next_due else UTC
    lang, changes = current().lang, status.verified.changes
    # The verification of a push that was rolled back belongs to a table that is not in force.
    latest = next((check for check in past if not check.push or check.verdict == "pass"), None)
    return env.get_template("page.html").render(
        status=status,
        bar=strip_of(status),
        past=past,
        latest=latest,
        figures=figures(past),
        latest_figures=[] if latest is None else _judged_first(latest),
        trends=trends(past, zone, changes),
        verified=status.verified,
        sentence=sentence,
        earlier=lambda check: bool(changes) and not check.push and check.started_utc <= changes[-1],
        marks=MARKS,
        zone=zone,
        machine=status.machine,
        name=lambda key: _named(lang, key),
        measured=measured,
        stamp=lambda time: formatting.stamp(time, zone),
        ago=lambda time: language.ago(lang, time, status.now_utc),
        due_words=lambda one: language.due(lang, one.due_utc, status.now_utc),
    )


def figures(past: Sequence[Verification]) -> list[str]:
    """Up to `SHOWN_FIGURES` figures with a column and a plot: those with a limit or, if none has one, the first ones."""
    judged = dict.fromkeys(key for check in past for key in check.values if check.limits.get(key) is not None)
    return list(judged or dict.fromkeys(key for check in past for key in check.values))[:SHOWN_FIGURES]


def trends(past: Sequence[Verification], zone: tzinfo, changes: Sequence[datetime] = ()) -> list[Markup]:
    """A plot for each figure; ``changes``: times at which another table came into force."""
    found = [(key, points_of(past, key, changes)) for key in figures(past)]
    return [trend_picture(key, points, zone, changes) for key, points in found if points]


def trend_picture(key: str, points: Sequence[Point], zone: tzinfo, changes: Sequence[datetime]) -> Markup:
    """The plot of one figure in the reader's language; its points must not be empty."""
    name, unit = language.figure(current().lang, key)
    return Markup(trend_svg(name, current().unit(unit), points, zone, changes))  # noqa: S704 - our own writer, which escapes


def points_of(past: Sequence[Verification], key: str, changes: Sequence[datetime]) -> list[Point]:
    """The points of a figure, one for each check that has the figure, in the reader's unit."""
    unit = language.figure(current().lang, key)[1]
    return [point for check in past if (point := _point(check, key, unit, changes)) is not None]


def _lengths(rows: Sequence[Sequence[str]], *at: int) -> list[list[str]]:
    """Rows of a table, with the µm cells in columns ``at`` converted to the reader's unit."""
    return [[current().length(cell) if k in at else cell for k, cell in enumerate(row)] for row in rows]


def measured(value: float | None, key: str, expanded: float | None = None) -> tuple[str, str]:
    """A figure and its U in the reader's unit, rounded together; dashes for unknown values."""
    frame = current()
    unit = language.figure(frame.lang, key)[1]
    if value is None or not expanded:
        return frame.length(value, unit), "–"
    return frame.with_u(value, expanded / 2.0, unit)


def _named(lang: str, key: str) -> tuple[str, str]:
    name, unit = language.figure(lang, key)
    return name, current().unit(unit)


def _point(check: Verification, key: str, unit: str, changes: Sequence[datetime]) -> Point | None:
    """A figure of a check in the reader's unit; None: the check lacks it."""
    value, limit, system = check.values.get(key), check.limits.get(key), current().units
    if value is None:
        return None
    u = converted(check.uncertainties.get(key) or 0.0, unit, system)
    line = None if limit is None else converted(limit, unit, system)
    earlier = bool(changes) and check.started_utc <= changes[-1]
    return Point(check.started_utc, converted(value, unit, system), u, line, figure_verdict(check, key), earlier, f"/check?id={check.id}")


def figure_verdict(check: Verification, key: str) -> str:
    """Verdict of one figure, by the same guard-banded rule as the check's verdict.

    If the check's verdict has another reason than its figures (e.g. the temperature), the check's verdict applies to each figure.
    """
    found = own_verdicts(check)
    worst = next((verdict for verdict in ("fail", "cannot tell", "pass") if verdict in found.values()), None)
    return found.get(key, check.verdict) if worst == check.verdict else check.verdict


def own_verdicts(check: Verification) -> dict[str, str]:
    """Verdict of each figure with a limit, by its value and U alone."""
    return {name: _judged(check, name) for name, limit in check.limits.items() if limit is not None and check.values.get(name) is not None}


def sentence(check: Verification) -> str:
    """Result of a check in the reader's language; a verdict with another reason than its figures keeps its stored sentence."""
    frame = current()
    if check.cause is not None:
        what = phrase(frame.lang, check.cause.what)
        return f"{frame.translate('check.stopped')} {what[:1].upper()}{what[1:]}"
    verdicts = own_verdicts(check)
    named = [name for name, verdict in verdicts.items() if verdict == check.verdict]
    if not named or (check.verdict == "pass" and len(named) < len(verdicts)) or (check.verdict != "fail" and "fail" in verdicts.values()):
        return phrase(frame.lang, check.text)
    names = ", ".join(language.figure(frame.lang, name)[0] for name in named)
    return frame.translate(f"check.{check.verdict}", names=names)


def _judged(check: Verification, key: str) -> str:
    value, limit, expanded = check.values[key], check.limits[key], check.uncertainties.get(key) or 0.0
    if value is None or limit is None:
        return "cannot tell"
    return "pass" if value + expanded <= limit else "fail" if value - expanded > limit else "cannot tell"


def _judged_first(check: Verification) -> list[str]:
    return sorted(check.values, key=lambda key: check.limits.get(key) is None)
