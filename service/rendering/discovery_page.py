"""From the values of a discovery to its page: self-contained, no script, no request to anywhere."""

from __future__ import annotations

from functools import cache

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from abbe.service.rendering.discovery_model import DiscoveryPage, GapRow
from abbe.service.rendering.numbers import COVERAGE, NOT_AVAILABLE, plain, printable, tidy
from abbe.service.rendering.palette import style_rules
from abbe.service.rendering.plots.gap import gap_bars, place_plot, trace_plot

_MARKS = {"ok": "✔", "open": "◐", "bad": "✖"}


def render_discovery(page: DiscoveryPage) -> str:
    """Self-contained HTML page of one discovery or simulation. Equal values give equal bytes.

    Parameters
    ----------
    page : DiscoveryPage
        What to say; texts may hold anything.
    """
    sign, word, text = page.verdict
    pictures = {
        "bars": [gap_bars(page.runs)] if page.runs else [],
        "traces": [trace_plot(t, key=f"trace-{i}") for i, t in enumerate(page.traces)],
        "places": [place_plot(p, key=f"place-{i}") for i, p in enumerate(page.places)],
    }
    html = (
        _environment()
        .get_template("discovery.html")
        .render(
            page=page,
            style=Markup(style_rules()),  # noqa: S704 - our own constants
            verdict={"sign": sign, "mark": _MARKS[sign], "word": word, "text": text},
            coverage=tidy(COVERAGE),
            gaps=[_gap(row) for row in page.gaps],
            # The SVG writer has escaped every text; escaping again would show the reader the tags.
            pictures={name: [Markup(p) for p in some] for name, some in pictures.items()},  # noqa: S704
        )
    )
    return printable(html)


@cache
def _environment() -> Environment:
    loader = PackageLoader("abbe.service.rendering")
    return Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)


def _gap(row: GapRow) -> dict[str, str]:
    closed = NOT_AVAILABLE if row.closed is None else f"{row.closed:.0%}"
    figures = {"before": plain(row.before_um), "after": plain(row.after_um), "floor": plain(row.floor_um)}
    return {"role": row.role, "meaning": row.meaning, "closed": closed} | figures
