"""Proposals for the screens, in the reader's units, with a picture of their changes; and the table in force with its history."""

from __future__ import annotations

import secrets
from collections.abc import Sequence
from dataclasses import dataclass

from fastapi import FastAPI
from fastapi.responses import HTMLResponse
from markupsafe import Markup

from abbe.service.compensation.proposal_diff import ACTIVE, HEADINGS, compare, largest, rows
from abbe.service.domain.people import Permission
from abbe.service.errors import JournalChanged
from abbe.service.queries.reader import Reader
from abbe.service.queries.tables import ProposalDetail, ProposalSummary, proposal, tables
from abbe.service.rendering.plots.tables import change_plot
from abbe.service.web.frame import current
from abbe.service.web.login.access import needs
from abbe.service.web.pages.context import PageContext
from abbe.service.web.units import INCH

MOST = 50
SIGNS = {"kept": "ok", "approved": "ok", "pushed": "ok", "refused": "bad", "rolled back": "bad", "changed": "bad", "rejected": "bad"}


@dataclass(frozen=True, slots=True)
class ProposalScreen:
    """One proposal with its changes. ``facts``: pairs of text key and value; ``rows``: cells under ``headings``."""

    found: ProposalDetail
    facts: Sequence[tuple[str, str]]
    largest: str
    headings: Sequence[str]
    rows: Sequence[Sequence[str]]
    picture: Markup


def sign(state: str) -> str:
    """Sign of a state: ``ok``, ``bad`` or ``open``."""
    return SIGNS.get(state, "open")


def promise(found: ProposalSummary) -> str:
    """Predicted rms before and after with U; empty if the proposal is unreadable."""
    p = found.predicted_rms_um
    if p is None:
        return ""
    frame, unit = current(), current().unit()
    before, after, expanded = (
        frame.length(f"{value:.2f}" if frame.units == INCH else f"{value:.1f}") for value in (p.before, p.after, 2.0 * p.u_model)
    )
    return f"{before} → {after} {unit} (U = {expanded} {unit}, k = 2)"


def proposal_screen(reader: Reader, number: int) -> ProposalScreen:
    """A proposal with its differences from the table that was in force when it was made.

    Raises
    ------
    NotStored
        There is no such proposal.
    Unusable
        The stored row was altered.
    """
    found = proposal(reader, number)
    difference = compare(reader.store, number, ACTIVE)
    # The SVG writer has already escaped every text.
    picture = Markup(change_plot(difference.curves))  # noqa: S704
    headings = [_heading(h) for h in HEADINGS]
    return ProposalScreen(found, _facts(found), largest(difference), headings, [_row(r) for r in rows(difference)], picture)


def _unit_of(heading: str) -> str:
    return next((unit for unit in ("µm", "mm") if heading.endswith(f"({unit})")), "")


def _heading(heading: str) -> str:
    unit = _unit_of(heading)
    return heading.replace(f"({unit})", f"({current().unit(unit)})") if unit else heading


def _row(cells: Sequence[str]) -> list[str]:
    """Cells under `HEADINGS` in the reader's units."""
    return [current().length(cell, _unit_of(heading)) for heading, cell in zip(HEADINGS, cells, strict=True)]


def _facts(found: ProposalDetail) -> list[tuple[str, str]]:
    facts = [
        ("proposal.machine", found.machine),
        ("proposal.campaign", found.campaign),
        ("proposal.solution", str(found.solution)),
        ("proposal.by", found.by),
        ("proposal.base", found.base_crc),
        ("proposal.valid_until", found.valid_until),
        ("proposal.holds_at", found.holds_at),
        ("proposal.digest", found.digest),
    ]
    return [(key, value) for key, value in facts if value]


PUSH_SIGNS = {"kept": "ok", "rolled back": "bad", "refused": "bad", "failed": "bad", "open": "bad"}
OUTCOMES = ("kept", "rolled back", "refused", "failed", "stopped", "open", "interrupted")
"""Outcomes of a push or rollback."""


def outcome_texts(group: str) -> dict[str, str]:
    """Texts of the outcomes in the reader's language; ``group``: their group in the catalogue of texts."""
    return {outcome: current().state(group, outcome) for outcome in OUTCOMES}


def add_table_screen(app: FastAPI, context: PageContext) -> None:
    """Add the screen of the table in force and its history to the application."""

    @app.get("/table", include_in_schema=False)
    @needs(Permission.READ)
    async def table() -> HTMLResponse:
        try:
            history = await context.read(tables, context.reader)
        except JournalChanged as error:
            return await context.show("table.html", 409, broken=error.detail, history=None)
        status = await context.source.status()
        return await context.show(
            "table.html",
            history=history,
            broken="",
            pushes=history.pushes[:MOST],
            attention=status.attention,
            verified=status.verified,
            job=status.job,
            may_order=current().may(Permission.APPROVE) and bool(current().csrf),
            key=secrets.token_hex(8),
            texts=outcome_texts("table.back_word"),
            sign=lambda word: PUSH_SIGNS.get(word, "open"),
            crc=lambda number: f"{number:08X}",
        )
