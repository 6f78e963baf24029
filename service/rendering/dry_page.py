"""A dry run as one self-contained HTML page: paths in three views, and what each test takes."""

from __future__ import annotations

from dataclasses import dataclass

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from abbe.service.rendering.numbers import printable
from abbe.service.rendering.palette import style_rules


@dataclass(frozen=True)
class DryPage:
    """What the page says, ready to be read: texts and cells, and the picture as SVG."""

    title: str
    lead: tuple[str, ...]
    headings: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    picture: str


def render_dry(page: DryPage) -> str:
    """The page. Equal dry runs give equal bytes."""
    environment = Environment(
        loader=PackageLoader("abbe.service.rendering"), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    # The SVG writer has escaped every text; escaping again would show the reader the tags.
    picture, style = Markup(page.picture), Markup(style_rules())  # noqa: S704
    return printable(environment.get_template("dry.html").render(page=page, picture=picture, style=style))
