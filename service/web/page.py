"""The page: status and past checks into HTML, on the server. The script only refreshes it."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, tzinfo
from pathlib import Path
from zoneinfo import ZoneInfo

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from service.web import words
from service.web.schemas import Status, Verification
from service.web.trend import Point, trend_svg

HERE = Path(__file__).parent
MARKS = {"pass": "✔", "fail": "✖", "cannot tell": "◐"}
SHOWN_FIGURES = 4
ICON = (
    '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 32 32"><rect width="32" height="32" rx="6" fill="#22506e"/>'
    '<path d="M6 24 16 7l10 17M10 18h12" fill="none"'
    ' stroke="#fff" stroke-width="3" stroke-linejoin="round" stroke-linecap="round"/></svg>'
)


def environment() -> Environment:
    """Return the template environment. Everything is escaped: names and fault texts come from devices and files."""
    env = Environment(
        loader=FileSystemLoader(HERE / "templates"), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    env.filters["number"] = words.number
    env.filters["span"] = words.span
    return env


def render(env: Environment, status: Status, past: Sequence[Verification]) -> str:
    """Return the page."""
    zone: tzinfo = ZoneInfo(status.next_due[0].timezone) if status.next_due else UTC
    return env.get_template("page.html").render(
        status=status,
        past=past,
        latest=past[0] if past else None,
        figures=figures(past),
        latest_figures=_judged_first(past[0]) if past else [],
        trends=trends(past, zone),
        marks=MARKS,
        zone=zone,
        name=words.figure_name,
        stamp=lambda moment: words.stamp(moment, zone),
        ago=lambda moment: words.ago(moment, status.now_utc),
    )


def figures(past: Sequence[Verification]) -> list[str]:
    """Return the figures worth a column and a plot: those that are judged, or, if none is, the first few."""
    judged = dict.fromkeys(key for check in past for key in check.values if check.limits.get(key) is not None)
    return list(judged or dict.fromkeys(key for check in past for key in check.values))[:SHOWN_FIGURES]


def trends(past: Sequence[Verification], zone: tzinfo) -> list[Markup]:
    """Return a plot for each figure."""
    plots = []
    for key in figures(past):
        name, unit = words.figure_name(key)
        points = [
            Point(check.started_utc, value, check.uncertainties.get(key) or 0.0, check.limits.get(key), figure_verdict(check, key))
            for check in past
            if (value := check.values.get(key)) is not None
        ]
        if points:
            plots.append(Markup(trend_svg(name, unit, points, zone)))  # noqa: S704 - our own writer, which escapes
    return plots


def figure_verdict(check: Verification, key: str) -> str:
    """Return what one figure says, by the same guard-banded rule as the check's own verdict.

    If the check's verdict does not follow from its figures, then its reason (say, the temperature) is one for each of them.
    """
    found = {name: _judged(check, name) for name in check.limits if check.values.get(name) is not None}
    worst = next((verdict for verdict in ("fail", "cannot tell", "pass") if verdict in found.values()), None)
    return found.get(key, check.verdict) if worst == check.verdict else check.verdict


def _judged(check: Verification, key: str) -> str:
    value, limit, expanded = check.values[key], check.limits[key], check.uncertainties.get(key) or 0.0
    if value is None or limit is None:
        return "cannot tell"
    return "pass" if value + expanded <= limit else "fail" if value - expanded > limit else "cannot tell"


def _judged_first(check: Verification) -> list[str]:
    return sorted(check.values, key=lambda key: check.limits.get(key) is None)
