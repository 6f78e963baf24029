"""Note in a report that another table came into force after the measurement, so that an old verdict is not read as the current one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime

from abbe.service.domain.run import Run
from abbe.service.rendering.document import Document
from abbe.service.storage.store import Store
from abbe.service.verification.verified_by import VerifiedBy, verified_by

NOT_JUDGED = "Not judged"


def with_later_changes(document: Document, store: Store, machine: str, begun_utc: str, runs: Sequence[Run]) -> Document:
    """Return the report, with a note if its table is not in force now. The verdict says so, too.

    ``begun_utc``: time of the measurement, or end of the push. ``runs``: of the report; empty: only the time counts.
    """
    known = verified_by(store, machine)
    if document.verdict is None or _same(known, begun_utc, runs):
        return document
    sign, word, text = document.verdict
    now = known.text[:1].upper() + known.text[1:]
    remark = f"this report is about the table in force at that time, not about the table in force now: {known.text}"
    verdict = document.verdict
    if known.state == "unverified" and word != NOT_JUDGED:
        verdict = ("open", "Unverified now", f"{now}. When this was measured: {word}. {text}".strip())
    elif sign != "open":
        verdict = ("open", f"{word} then", f"{text} Another table is in force now: {known.text}.".strip())
    return replace(document, verdict=verdict, remarks=[remark, *document.remarks])


def _same(known: VerifiedBy, begun_utc: str, runs: Sequence[Run]) -> bool:
    """Whether the report was measured with the table in force now."""
    if known.why in ("changed", "open", "journal"):
        return False
    tables = {r.table.crc for r in runs if r.table.crc is not None}
    if known.why == "push" and tables == {known.crc}:  # measured during the push, before it was kept
        return True
    if known.since is not None and datetime.fromisoformat(begun_utc) < known.since:
        return False
    return known.crc is None or tables <= {known.crc}
