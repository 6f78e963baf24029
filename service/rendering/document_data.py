"""A report for programs: the JSON object (`abbe-report/1`), the CSV of its figures, and the data for the templates of page and PDF."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from abbe.service.rendering.document import (
    DECISION_RULE,
    FORMAT,
    UNCERTAINTY,
    Block,
    Document,
    Facts,
    Lines,
    PictureBlock,
    ReportFigure,
    Section,
    TextTable,
    blocks,
)
from abbe.service.rendering.laboratory import certificate_of
from abbe.service.rendering.numbers import COVERAGE, NOT_AVAILABLE, plain, printable, tidy, with_uncertainty
from abbe.service.rendering.phrases import ENGLISH, phrase, pictured

COLUMNS = ("group", "symbol", "name", "value", "expanded", "k", "unit", "limit", "verdict", "method")
_NUMBER = r"(?:n/a|[+−-]?\d[\d.]*(?:e[+−-]?\d+)?)"
_NUMERIC = re.compile(rf"{_NUMBER}(?: (?:±|to) {_NUMBER})?(?: ?[×%])?")
_TIME = re.compile(r"(\d{4}-\d\d-\d\d)T(\d\d:\d\d:\d\d)(?:\.\d+)?(?:Z|\+00:00)")
NOTHING_HIDDEN = "No gap was found: this measurement shows everything that it should."


def document_json(document: Document) -> str:
    """The report as JSON with all digits and without pictures. Equal reports give equal bytes."""
    return json.dumps(_data(document), ensure_ascii=False, indent=2, allow_nan=False) + "\n"


def document_csv(document: Document) -> str:
    """The figures as CSV with all digits; ``expanded`` is U, empty if unknown."""
    out = io.StringIO()
    write = csv.writer(out, lineterminator="\n")
    write.writerow(COLUMNS)
    for figure in map(_figure, document.figures):
        # A spreadsheet would read such a cell as a formula.
        write.writerow(["'" + v if isinstance(v, str) and v[:1] in "=+@\t" and v else v for v in (figure[c] for c in COLUMNS)])
    return out.getvalue()


def _data(document: Document) -> dict[str, Any]:
    sections = [*document.sections, *document.appendix]
    return {
        "format": FORMAT,
        "kind": document.kind,
        "title": document.title,
        "about": dict(document.about),
        "verdict": None if document.verdict is None else dict(zip(("sign", "word", "text"), document.verdict, strict=True)),
        "figures": [_figure(f) for f in document.figures],
        "coverage_factor": COVERAGE,
        "uncertainty": UNCERTAINTY,
        "decision_rule": DECISION_RULE,
        "instruments": [{"name": i.name, "certificate": i.certificate, "known": i.known} for i in document.instruments],
        "conditions": dict(document.conditions),
        "not_observable": None if document.not_observable is None else list(document.not_observable),
        "statements": list(document.statements),
        "remarks": list(document.remarks),
        "sections": [{"title": s.title, "lines": lines} for s in sections if (lines := _lines(s))],
        "tables": [
            {"title": title, "head": list(t.head), "rows": [list(r) for r in t.rows]}
            for title, t in blocks(sections)
            if isinstance(t, TextTable)
        ],
        "provenance": dict(document.provenance),
        "signatures": list(document.signatures),
    }


def _figure(figure: ReportFigure) -> dict[str, Any]:
    u = _number(figure.u)
    return {
        "group": figure.group,
        "symbol": figure.symbol,
        "name": figure.name,
        "value": _number(figure.value),
        "expanded": None if u is None else COVERAGE * u,
        "k": COVERAGE,
        "unit": figure.unit,
        "limit": _number(figure.limit),
        "verdict": figure.verdict,
        "method": figure.method,
    }


def _number(value: float | None) -> float | None:
    return float(value) if value is not None and math.isfinite(value) else None


def _lines(section: Section) -> list[str]:
    """The text of a section outside its tables."""
    out: list[str] = []
    for _, block in blocks([section]):
        match block:
            case str():
                out.append(block)
            case Lines():
                out += block.items
            case Facts():
                out += [f"{name}: {value}" for name, value in block.items.items()]
            case _:
                pass
    return out


WORDS = (
    "Know before you sign", "Look at these", "Missing for ISO/IEC 17025", "What this certificate states", "Figures", "Symbol", "Figure",
    "Value", "Unit", "Limit", "Verdict", "By", "Uncertainty and decision", "What this measurement could not show", "Instruments",
    "Instrument", "Certificate", "Known about it", "Conditions", "Where it comes from", "{who}: name, date, signature",
    "page {n} of {m}",
)  # fmt: skip
"""Words of the templates."""
NAMES = frozenset(("Machine", "Campaign", "Run", "File", "Authorised by", "Approved by", "Pushed by"))
"""Facts and columns whose values are names: they are never translated. The facts of a certificate are translated where they are made."""


def shown(document: Document, draw: Callable[[str], str] = str) -> dict[str, Any]:
    """Data for a template, in the document's language: text, numbers rounded with their uncertainty, and pictures as ``draw`` converts
    their SVG. The digest of a certificate is computed from the English report: it is the same in every language."""

    def picture(svg: str) -> str:
        return draw(pictured(document.lang, svg))

    data = _data(document)
    groups: dict[str, list[dict[str, str]]] = {}
    for f in document.figures:
        groups.setdefault(f.group, []).append(_figure_cells(f))
    hidden = document.not_observable
    context = {key: value for key, value in data.items() if key != "figures"} | {
        "about": _pairs(document.about),
        "conditions": _pairs(document.conditions),
        "provenance": _pairs(document.provenance),
        "groups": [{"name": name, "rows": rows} for name, rows in groups.items()],
        "judged": any(f.limit is not None for f in document.figures),
        "not_observable": None if hidden is None else list(hidden) or [NOTHING_HIDDEN],
        "lang": document.lang,
        "coverage": tidy(COVERAGE),
        "sections": [_block(s, picture) for s in document.sections],
        "appendix": [_block(s, picture) for s in document.appendix],
        "certificate": certificate_of(document, hashlib.sha256(document_json(document).encode(errors="replace")).hexdigest()),
    }
    clean: dict[str, Any] = _clean(context)
    told: dict[str, Any] = _told(document.lang, clean)
    return told | {"words": {word: phrase(document.lang, word) for word in WORDS}}


def _told(lang: str, value: Any, key: str = "", head: Any = None) -> Any:
    """Texts translated into a language, except those of pictures, which are translated when drawn. ``head``: headings of the table that
    has ``value`` as its rows."""
    if lang == ENGLISH or key in {"kind", "sign", "layout", "lang", "format", "svgs", "number"}:
        return value
    if key == "facts":
        return [fact | {"name": phrase(lang, fact["name"])} for fact in value]
    if key == "rows" and isinstance(head, list):
        return [[v if name in NAMES else phrase(lang, v) for name, v in zip(head, row, strict=True)] for row in value]
    if isinstance(value, dict):
        named = value.get("name") in NAMES and "value" in value
        told = {k: v if named and k == "value" else _told(lang, v, k, value.get("head")) for k, v in value.items()}
        return told | ({"certificate": _certificate(lang, value["certificate"])} if "known" in value else {})
    if isinstance(value, list):
        return [_told(lang, v) for v in value]
    return phrase(lang, value) if isinstance(value, str) else value


def _certificate(lang: str, text: str) -> str:
    """Translate a note on an instrument's certificate: a person's words stay as they are, the phrase on its expiry is put into ``lang``."""
    written, mark, ours = text.rpartition("; ")
    return written + mark + phrase(lang, ours)


def _block(block: Block, draw: Callable[[str], str]) -> dict[str, Any]:
    """A block with its kind, for the templates."""
    match block:
        case Lines():
            return {"kind": "lines", "items": list(block.items), "numbered": block.numbered}
        case Facts():
            return {"kind": "facts", "items": _pairs(block.items)}
        case TextTable():
            rows = [list(r) for r in block.rows]
            bold = [name in block.bold for name in block.head]
            return {"kind": "table", "head": list(block.head), "rows": rows, "right": _right(len(block.head), rows), "bold": bold}
        case PictureBlock():
            return {"kind": "picture", "caption": block.caption, "svgs": [draw(s) for s in block.svgs], "layout": block.layout}
        case Section():
            inner = [_block(b, draw) for b in block.blocks]
            return {"kind": "section", "title": block.title, "folded": block.folded, "blocks": inner}
        case _:
            return {"kind": "text", "text": block}


def _pairs(facts: Mapping[str, str]) -> list[dict[str, str]]:
    """Names and values; times to the second, as people read them."""
    return [{"name": name, "value": _TIME.sub(r"\1 \2 UTC", value)} for name, value in facts.items()]


def _right(columns: int, rows: Sequence[Sequence[str]]) -> list[bool]:
    """For each column, whether to align it right because it holds numbers only; never the first column."""
    cells = [[row[k] for row in rows if row[k]] for k in range(columns)]
    return [k > 0 and bool(some) and all(_NUMERIC.fullmatch(c) for c in some) for k, some in enumerate(cells)]


def _figure_cells(figure: ReportFigure) -> dict[str, str]:
    value, expanded = with_uncertainty(figure.value, figure.u)
    if figure.unit == "":
        value = NOT_AVAILABLE if figure.value is None else plain(figure.value)
    limit = "" if figure.limit is None else tidy(figure.limit)
    return {
        "symbol": figure.symbol, "name": figure.name, "value": value, "u": expanded, "unit": figure.unit, "limit": limit,
        "verdict": figure.verdict, "method": figure.method,
    }  # fmt: skip


def _clean(value: Any) -> Any:
    """Remove characters that neither XML nor PDF can hold."""
    if isinstance(value, dict):
        return {k: _clean(v) for k, v in value.items()}
    if isinstance(value, list):
        return [_clean(v) for v in value]
    return printable(value) if isinstance(value, str) else value
