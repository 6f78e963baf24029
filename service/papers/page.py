"""The papers as one self-contained HTML page, written atomically."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import cache
from importlib.metadata import version
from pathlib import Path

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from abbe.service.papers.check import PaperCheck
from abbe.service.papers.pictures import figures
from abbe.service.papers.row import PaperRow
from abbe.service.papers.run import PaperResult
from abbe.service.papers.text import NONE, check_cells, computed_cells, note, short
from abbe.service.rendering.numbers import printable
from abbe.service.rendering.page_file import write_page as write_text
from abbe.service.rendering.palette import style_rules

_MARKS = {"reproduced": "✔", "consistent": "≈", "differs": "≠", "input": "▷", "not reproducible": "○"}
_CHECK_MARKS = {"holds": "✔", "fails": "✘"}
_UNIT_AFTER = re.compile(r"(?<=\d) (?=(?:µm|mm|nm|µrad|mrad|rad|°|%)(?!\w))")
"""Space between a number and its unit, at which a line must not break."""


def write_page(found: Sequence[PaperResult], target: Path) -> None:
    """Write the page to a temporary file and rename it: a reader sees the old file or the whole new one.

    Raises
    ------
    FileFormatError
        The file cannot be written.
    """
    write_text(render_page(found), target)


def render_page(found: Sequence[PaperResult]) -> str:
    """The page. Equal rows give equal bytes."""
    page = (
        _environment()
        .get_template("papers.html")
        .render(
            style=Markup(style_rules()),  # noqa: S704 - our own constants
            papers=[_paper(f) for f in found],
            version=version("abbe"),
            marks=_MARKS,
            check_marks=_CHECK_MARKS,
        )
    )
    return printable(page)


@cache
def _environment() -> Environment:
    loader = ChoiceLoader([PackageLoader("abbe.service.papers"), PackageLoader("abbe.service.rendering")])
    return Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)


def _paper(found: PaperResult) -> dict[str, object]:
    return {
        "key": found.paper,
        "title": found.title,
        "counts": found.counts(),
        "rows": _rows(found.rows),
        "checks": _checks(found.checks),
        "outcomes": found.check_counts(),
        "figures": [{"pictures": _trusted(f.pictures), "caption": _whole(f.caption), "kind": f.kind} for f in figures(found.paper)],
    }


def _trusted(pictures: Sequence[str]) -> list[Markup]:
    # The SVG writer has escaped every text; escaping again would show the reader the tags.
    return [Markup(p) for p in pictures]  # noqa: S704


def _whole(text: str) -> str:
    """Text with non-breaking spaces between numbers and units."""
    return _UNIT_AFTER.sub("\u00a0", text)


def _checks(checks: Sequence[PaperCheck]) -> list[dict[str, str]]:
    out, before = [], ""
    for check in checks:
        given, found, deviation, bound = (_whole(cell) for cell in check_cells(check))
        text = _whole(f"{check.how}. {check.why}")
        cells = {
            "where": check.where,
            "quantity": _whole(check.quantity),
            "given": given,
            "found": found,
            "deviation": deviation,
            "bound": bound,
        }
        out.append({**cells, "status": check.status, "text": "as above" if text == before else text})
        before = text
    return out


def _rows(rows: Sequence[PaperRow]) -> list[dict[str, str]]:
    out, before = [], ""
    for row in rows:
        text = _whole(". ".join(part for part in (row.how, note(row)) if part))
        out.append({**_cells(row), "text": "as above" if text and text == before else text})
        before = text
    return out


def _cells(row: PaperRow) -> dict[str, str]:
    unit = f" {row.unit}" if row.unit != "1" else ""
    out = {
        "where": row.where if row.source == "paper" else f"math.md, {row.where}",
        "quantity": _whole(row.quantity),
        "unit": unit.strip(),
        "printed": ("< " if row.printed.bound else "") + row.printed.text.replace("-", "−"),
        "computed": NONE,
        "difference": NONE,
        "within": NONE,
        "because": "",
        "status": row.status,
    }
    if row.computed is not None:
        out["computed"], out["difference"], out["within"] = computed_cells(row)
        parts = [f"half a unit of the last printed digit: {short(row.printed.rounding)}{unit}"]
        if row.fit == "padding":
            parts[0] = f"if zeros are padding: {short(row.within or 0.0)}{unit}"
        elif row.computed.allowance:
            parts.append(f"{row.computed.because}: {short(row.computed.allowance)}{unit}")
        out["because"] = "; ".join(parts)
    return out
