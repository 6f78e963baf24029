"""A report for programs: the JSON object (`abbe-report/1`), the CSV of its figures, and the words that page and paper print alike."""

from __future__ import annotations

import csv
import io
import json
import math
from typing import Any

from abbe.service.rendering.document import DECISION_RULE, FORMAT, UNCERTAINTY, Document, Figure
from abbe.service.rendering.numbers import COVERAGE, NOT_AVAILABLE, plain, printable, tidy, with_uncertainty

COLUMNS = ("group", "symbol", "name", "value", "expanded", "k", "unit", "limit", "verdict", "method")
NOTHING_HIDDEN = "Nothing was found that this measurement should have shown and could not."


def document_json(document: Document) -> str:
    """The report as JSON: all digits, pictures left out (they draw what the runs hold). Equal reports give equal bytes."""
    return json.dumps(_data(document), ensure_ascii=False, indent=2, allow_nan=False) + "\n"


def document_csv(document: Document) -> str:
    """The figures as CSV, all digits; ``expanded`` is U, empty where there is none."""
    out = io.StringIO()
    write = csv.writer(out, lineterminator="\n")
    write.writerow(COLUMNS)
    for figure in _data(document)["figures"]:
        # A cell that begins so would be taken for a formula by a spreadsheet.
        write.writerow(["'" + v if isinstance(v, str) and v[:1] in "=+@\t" and v else v for v in (figure[c] for c in COLUMNS)])
    return out.getvalue()


def _data(document: Document) -> dict[str, Any]:
    sign, word, text = document.verdict
    return {
        "format": FORMAT,
        "kind": document.kind,
        "title": document.title,
        "about": dict(document.about),
        "verdict": {"sign": sign, "word": word, "text": text},
        "figures": [_figure(f) for f in document.figures],
        "coverage_factor": COVERAGE,
        "uncertainty": UNCERTAINTY,
        "decision_rule": DECISION_RULE,
        "instruments": [{"name": i.name, "certificate": i.certificate, "known": i.known} for i in document.instruments],
        "conditions": dict(document.conditions),
        "not_observable": list(document.not_observable),
        "statements": list(document.statements),
        "remarks": list(document.remarks),
        "tables": [{"title": t.title, "head": list(t.head), "rows": [list(r) for r in t.rows]} for t in document.tables],
        "provenance": dict(document.provenance),
        "signatures": list(document.signatures),
    }


def _figure(figure: Figure) -> dict[str, Any]:
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


def shown(document: Document) -> dict[str, Any]:
    """What a template prints: words only, numbers rounded with their uncertainty. Pictures are not in it."""
    data = _data(document)
    groups: dict[str, list[dict[str, str]]] = {}
    for f in document.figures:
        groups.setdefault(f.group, []).append(_words(f))
    pairs = {name: [{"name": k, "value": v} for k, v in data[name].items()] for name in ("about", "conditions", "provenance")}
    words = data | pairs | {"groups": [{"name": name, "rows": rows} for name, rows in groups.items()]}
    words["judged"] = any(f.limit is not None for f in document.figures)
    words["not_observable"] = words["not_observable"] or [NOTHING_HIDDEN]
    words["lang"], words["coverage"] = document.lang, tidy(COVERAGE)
    del words["figures"]
    clean: dict[str, Any] = _clean(words)
    return clean


def _words(figure: Figure) -> dict[str, str]:
    value, expanded = with_uncertainty(figure.value, figure.u)
    if figure.unit == "":
        value = NOT_AVAILABLE if figure.value is None else plain(figure.value)
    limit = "" if figure.limit is None else tidy(figure.limit)
    return {
        "symbol": figure.symbol, "name": figure.name, "value": value, "u": expanded, "unit": figure.unit, "limit": limit,
        "verdict": figure.verdict, "method": figure.method,
    }  # fmt: skip


def _clean(value: Any) -> Any:
    """Without characters that neither page nor paper can hold."""
    if isinstance(value, dict):
        return {k: _clean(v) for k, v in value.items()}
    if isinstance(value, list):
        return [_clean(v) for v in value]
    return printable(value) if isinstance(value, str) else value
