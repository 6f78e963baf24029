"""A report as one self-contained HTML page, and as PDF. Both print the same words (`document_data.shown`) and the same pictures."""

from __future__ import annotations

import json
from functools import cache
from importlib.resources import files
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from abbe.service.rendering.document import Document, Picture
from abbe.service.rendering.document_data import shown
from abbe.service.rendering.numbers import printable
from abbe.service.rendering.palette import paper_rules, style_rules

_MARKS = {"ok": "✔", "open": "◐", "bad": "✖"}
FONT = "Libertinus Serif"
"""Comes inside of the typesetter: no font of the computer is used, so that a report looks the same everywhere."""


def document_html(document: Document) -> str:
    """Self-contained page: no script, no request to anywhere. Equal reports give equal bytes."""
    page = _environment().get_template("document.html")
    words = shown(document)
    return printable(
        page.render(
            doc=words,
            mark=_MARKS[document.verdict[0]],
            style=Markup(style_rules()),  # noqa: S704 - our own constants
            # The SVG writer has escaped every text; escaping again would show the reader the tags.
            pictures=[{"caption": p.caption, "svg": Markup(p.svg), "wide": p.wide} for p in document.pictures],  # noqa: S704
        )
    )


def document_pdf(document: Document) -> bytes:
    """The report as PDF (A4, tagged), set by typst with the fonts that it brings. No clock, no network: equal reports give equal bytes."""
    import typst

    data: dict[str, Any] = shown(document) | {"pictures": [_picture(p) for p in document.pictures], "font": FONT}
    template = files("abbe.service.rendering").joinpath("templates", "document.typ").read_bytes()
    inputs = {"data": json.dumps(data, ensure_ascii=False)}
    made = typst.compile(template, format="pdf", ignore_system_fonts=True, sys_inputs=inputs)
    assert isinstance(made, bytes)  # one document, not one file for each page
    return made


def _picture(picture: Picture) -> dict[str, Any]:
    return {"caption": picture.caption, "svg": standalone(picture.svg), "wide": picture.wide}


def standalone(svg: str) -> str:
    """A picture that stands by itself: with its name space, and the colours of paper instead of the page's variables."""
    head, _, rest = svg.partition(">")
    return f'{head} xmlns="http://www.w3.org/2000/svg"><style>{paper_rules(FONT)}</style>{rest}'


@cache
def _environment() -> Environment:
    loader = PackageLoader("abbe.service.rendering")
    return Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
