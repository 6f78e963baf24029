"""A planned campaign as one self-contained HTML page: picture of the set-ups, what each measurement buys, what stays open."""

from __future__ import annotations

from dataclasses import dataclass

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from abbe.service.rendering.numbers import printable
from abbe.service.rendering.palette import style_rules


@dataclass(frozen=True)
class PlanPage:
    """What the page says, ready to be read: texts and cells, and the picture as SVG."""

    title: str
    lead: tuple[str, ...]
    headings: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str
    open_questions: tuple[str, ...]
    picture: str


def render_plan(page: PlanPage) -> str:
    """The page. Equal plans give equal bytes."""
    environment = Environment(
        loader=PackageLoader("abbe.service.rendering"), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    # The SVG writer has escaped every text; escaping again would show the reader the tags.
    picture, style = Markup(page.picture), Markup(style_rules())  # noqa: S704
    return printable(environment.get_template("plan.html").render(page=page, picture=picture, style=style))
