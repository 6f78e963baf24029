"""Runs from documents of tests, which may leave out what they do not look at."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from abbe.service.domain.run import Run

Doc = dict[str, Any]
HEAD: Doc = {"run_id": "r", "test": "ballbar_helix", "role": "identify", "setup": {}, "columns": {}}
BAR: Doc = {"setup_id": "A", "centre_mm": [0.0, 0.0, 0.0], "radius_mm": 100.0}


def run_of(doc: Doc | Run) -> Run:
    """The run of an ``abbe-run/1`` document; missing keys and columns get plain values."""
    if isinstance(doc, Run):
        return doc
    whole = HEAD | doc
    columns: Doc = whole["columns"]
    n = next((len(values) for values in columns.values() if values is not None), 0)
    plain = {name: np.zeros(n) for name in ("x_mm", "y_mm", "z_mm")}
    plain |= {"t_s": np.arange(float(n)), "feed_mm_min": np.full(n, 1000.0), "direction": np.ones(n)}
    setup = (BAR if whole["test"].startswith("ballbar") else {"setup_id": "L"}) | whole["setup"]
    return Run.from_document(whole | {"setup": setup, "columns": {"deviation_mm": None} | plain | columns})


def runs_of(docs: Iterable[Doc | Run]) -> list[Run]:
    """The runs of several documents."""
    return [run_of(doc) for doc in docs]
