"""Proposals for the screens: the same rows, differences and approval as ``abbe comp show``, ``diff`` and ``approve``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

from markupsafe import Markup

from abbe.service.clock import Clock, SystemClock
from abbe.service.compensation.proposal_checks import approve
from abbe.service.compensation.proposal_diff import HEADINGS, compare, largest, rows
from abbe.service.compensation.proposal_doc import Proposed, load
from abbe.service.compensation.proposal_states import ProposalStatus, check_waiting, proposal_status, status_of_proposal
from abbe.service.domain.decisions import ProposalApproval
from abbe.service.errors import StoreError
from abbe.service.push.book import read_entries
from abbe.service.rendering.plots.table_change import DiffCurve, change_plot
from abbe.service.storage.base import utc_text
from abbe.service.storage.store import Store
from abbe.service.web.frame import current
from abbe.service.web.units import INCH

MOST = 50
SIGNS = {"kept": "ok", "approved": "ok", "pushed": "ok", "refused": "bad", "rolled back": "bad", "changed": "bad", "rejected": "bad"}
OPEN = ("proposed", "approved")


@dataclass(frozen=True, slots=True)
class ProposalLine:
    """One proposal in the list."""

    number: int
    campaign: str
    by: str
    utc: str
    promise: str
    state: str
    why: str

    @property
    def sign(self) -> str:
        """Good, bad or open."""
        return SIGNS.get(self.state, "open")


@dataclass(frozen=True, slots=True)
class ProposalScreen:
    """One proposal with what it changes. ``waits``: it can still be approved."""

    line: ProposalLine
    facts: Sequence[tuple[str, str]]
    reasons: Sequence[str]
    not_for_tables: Sequence[str]
    approvals: Sequence[ProposalApproval]
    two_people: bool
    waits: bool
    largest: str
    headings: Sequence[str]
    rows: Sequence[Sequence[str]]
    picture: Markup


def proposal_lines(store: Store, clock: Clock | None = None) -> list[ProposalLine]:
    """Proposals, newest first. One whose row was changed says so, and does not hide the others."""
    now_s = (clock or SystemClock()).utc().timestamp()
    newest = list(reversed(store.proposals()))[:MOST]
    entries = {name: read_entries(store, name) for name in {record.machine for record in newest}}
    docs = {table.id: table.doc for table in store.tables()} if newest else {}
    out = []
    for record in newest:
        try:
            proposed = load(store, record.id)
            own = entries[record.machine]
            out.append(
                _line(
                    record.id,
                    proposed,
                    status_of_proposal(record.id, proposed, store.approvals(record.id), own, docs, now_s, store.rejections(record.id)),
                )
            )
        except StoreError as error:
            out.append(ProposalLine(record.id, "", "", record.created_utc, "", "changed", error.detail))
    return out


def promise(proposed: Proposed) -> str:
    """What the model promises, with U, in numbers."""
    p = proposed.predicted
    before, after, expanded = p.before_mm * 1e3, p.after_mm * 1e3, 2e3 * p.u_model_mm
    frame, unit = current(), current().unit()
    texts = [frame.length(f"{value:.2f}" if frame.units == INCH else f"{value:.1f}") for value in (before, after, expanded)]
    return f"{texts[0]} → {texts[1]} {unit} (U = {texts[2]} {unit})"


def _line(number: int, proposed: Proposed, now: ProposalStatus) -> ProposalLine:
    return ProposalLine(number, proposed.campaign, proposed.by, proposed.utc, promise(proposed), now.word, now.text)


def proposal_screen(store: Store, number: int, clock: Clock | None = None) -> ProposalScreen:
    """A proposal with its differences to the table in force when it was made.

    Raises
    ------
    StoreError
        Its row was changed after it was stored.
    """
    proposed = load(store, number)
    now = proposal_status(store, number, proposed, (clock or SystemClock()).utc().timestamp())
    difference = compare(store, number, "ACTIVE")
    curves = [DiffCurve(c.moved, c.corrected, c.position_mm, c.old_mm * 1e3, c.new_mm * 1e3, c.u_mm * 1e3) for c in difference.curves]
    # The SVG writer has escaped every text; escaping again would show the reader the tags.
    picture = Markup(change_plot(curves))  # noqa: S704
    return ProposalScreen(
        _line(number, proposed, now), _facts(proposed), proposed.reasons, proposed.not_for_tables, store.approvals(number),
        proposed.two_people, now.word in OPEN, largest(difference),
        [_heading(h) for h in HEADINGS], [_row(r) for r in rows(difference)], picture,
    )  # fmt: skip


def _unit_of(heading: str) -> str:
    return next((unit for unit in ("µm", "mm") if heading.endswith(f"({unit})")), "")


def _heading(heading: str) -> str:
    unit = _unit_of(heading)
    return heading.replace(f"({unit})", f"({current().unit(unit)})") if unit else heading


def _row(cells: Sequence[str]) -> list[str]:
    """Cells of `HEADINGS` in the reader's units."""
    return [current().length(cell, _unit_of(heading)) for heading, cell in zip(HEADINGS, cells, strict=True)]


def _facts(proposed: Proposed) -> list[tuple[str, str]]:
    """Key of the catalogue and value."""
    c = proposed.candidate
    return [
        ("proposal.machine", c.machine),
        ("proposal.campaign", proposed.campaign),
        ("proposal.solution", str(proposed.solution_id)),
        ("proposal.by", proposed.by),
        ("proposal.base", f"{c.base_crc:08X}"),
        ("proposal.valid_until", utc_text(datetime.fromtimestamp(proposed.valid_until_s, UTC))),
        ("proposal.digest", c.digest),
    ]


def approve_as(store: Store, number: int, name: str, account: str, hours: float) -> ProposalApproval:
    """Approve by the functions of the command line: same reasons against it, same rule of two people.

    Raises
    ------
    TableRefused
        Why it cannot be approved.
    StoreError
        There is no such proposal, or its row was changed.
    """
    clock = SystemClock()
    proposed = load(store, number)
    check_waiting(store, number, proposed, clock.utc().timestamp())
    return approve(store, number, proposed, name, hours, clock, account=account)
