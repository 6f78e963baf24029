"""Old and new tables as one self-contained HTML page: numbers, and nine pictures with the uncertainty of the new ones."""

from __future__ import annotations

from dataclasses import dataclass

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from abbe.service.rendering.numbers import printable
from abbe.service.rendering.palette import style_rules
from abbe.service.rendering.plots.table_change import DiffCurve, change_plot

__all__ = ["DiffCurve", "DiffPage", "render_diff"]


@dataclass(frozen=True)
class DiffPage:
    """What the page says, ready to be read: texts and cells, and the curves of the picture."""

    title: str
    lead: tuple[str, ...]
    headings: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    curves: tuple[DiffCurve, ...]


def render_diff(page: DiffPage) -> str:
    """The page. Equal tables give equal bytes."""
    environment = Environment(
        loader=PackageLoader("abbe.service.rendering"), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    # The SVG writer has escaped every text; escaping again would show the reader the tags.
    picture, style = Markup(change_plot(page.curves)), Markup(style_rules())  # noqa: S704
    return printable(environment.get_template("diff.html").render(page=page, picture=picture, style=style))
