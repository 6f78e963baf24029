"""Proposed tables and the state of each, the push journal, and the table in force with its history."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Literal

from abbe.service.clock import utc_text
from abbe.service.compensation.proposal_decisions import ProposalStatus, proposal_status
from abbe.service.compensation.proposal_doc import Proposed, load
from abbe.service.domain.document import Doc
from abbe.service.domain.push_entry import PushEntry, PushState, PushTransition
from abbe.service.domain.results import ProposalApproval, ProposalRejection
from abbe.service.errors import NotStored, Unusable
from abbe.service.queries.reader import Reader, StoredResult, as_stored, of_row
from abbe.service.storage.repositories.pages import PageRow
from abbe.service.tables.push_journal import JournalView, TableHistory

if TYPE_CHECKING:
    from abbe.service.compensation.proposal_diff import TableDifference

ProposalState = Literal["refused", "rejected", "proposed", "approved", "expired", "superseded", "pushed", "kept", "rolled back", "changed"]
OPEN: tuple[ProposalState, ...] = ("proposed", "approved")


@dataclass(frozen=True, slots=True, kw_only=True)
class PredictedRms:
    """Predicted rms over the volume without and with the new tables, and standard uncertainty of the improvement, µm."""

    before: float
    after: float
    u_model: float


@dataclass(frozen=True, slots=True, kw_only=True)
class ProposalSummary(StoredResult):
    """Proposed tables. ``state`` ``changed``: the stored row was altered, so its content is unknown. ``by``: account of the proposer."""

    solution: int
    state: ProposalState
    why: str
    by: str = ""
    predicted_rms_um: PredictedRms | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class ProposalDetail(ProposalSummary):
    """A proposal with everything that a decision needs, except the numbers of the tables (`difference`)."""

    valid_until: str
    base_crc: str
    generation: int
    boot: str
    digest: str
    two_people: bool
    reasons: list[str]
    not_for_tables: list[str]
    holds_at: str
    approvals: list[ProposalApproval]
    rejections: list[ProposalRejection]

    @property
    def waits(self) -> bool:
        """Whether the proposal can still be approved."""
        return self.state in OPEN


class _StatusLookup:
    """Determines the state of proposals; reads the journal of each machine once."""

    def __init__(self, reader: Reader) -> None:
        self._reader = reader
        self._journals: dict[str, JournalView] = {}

    def of(self, number: int, proposed: Proposed) -> ProposalStatus:
        """Return the state of one proposal."""
        store, machine = self._reader.store, proposed.candidate.machine
        if machine not in self._journals:
            self._journals[machine] = JournalView.read(store, machine, self._reader.control_of(machine))
        return proposal_status(store, number, proposed, self._reader.now_s, self._journals[machine])


def proposals(reader: Reader, machine: str | None, cursor: int | None, limit: int) -> tuple[list[ProposalSummary], int | None]:
    """Return the proposals, newest first; one with an altered row has the state ``changed`` and does not hide the others."""
    rows, after = reader.page("proposals", {"machine": machine}, cursor, limit)
    statuses = _StatusLookup(reader) if rows else None
    return [_summary(reader, row, statuses) for row in rows if statuses is not None], after


def _summary(reader: Reader, row: PageRow, statuses: _StatusLookup) -> ProposalSummary:
    try:
        with as_stored():
            proposed = load(reader.store, row.number)
            status = statuses.of(row.number, proposed)
    except (Unusable, NotStored) as error:
        return of_row(ProposalSummary, row, campaign="", state="changed", why=error.detail)
    return of_row(ProposalSummary, row, **_known(proposed, status))


def _known(proposed: Proposed, status: ProposalStatus) -> Doc:
    p = proposed.predicted
    predicted = PredictedRms(before=p.before_mm * 1e3, after=p.after_mm * 1e3, u_model=p.u_model_mm * 1e3)
    known = {"campaign": proposed.campaign, "by": proposed.by, "predicted_rms_um": predicted}
    return known | {"state": status.word, "why": status.text}


def proposal(reader: Reader, number: int) -> ProposalDetail:
    """Return one proposal: predicted improvement with uncertainty, state, and the reasons against it.

    Raises
    ------
    NotStored
        There is no such proposal.
    Unusable
        The stored row was altered.
    """
    row, store = reader.row("proposals", number, "proposal"), reader.store
    with as_stored():
        proposed = load(store, number)
        status = _StatusLookup(reader).of(number, proposed)
    c = proposed.candidate
    return of_row(
        ProposalDetail,
        row,
        **_known(proposed, status),
        valid_until=utc_text(datetime.fromtimestamp(proposed.valid_until_s, UTC)),
        base_crc=f"{c.base_crc:08X}",
        generation=proposed.base.gen,
        boot=f"{proposed.base.boot:08X}",
        digest=c.digest,
        two_people=proposed.two_people,
        reasons=list(proposed.reasons),
        not_for_tables=list(proposed.not_for_tables),
        holds_at=proposed.holds_at,
        approvals=store.proposals.approvals(number),
        rejections=store.proposals.rejections(number),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class CurveDifference:
    """One of the nine tables, old and new. ``u_um``: standard uncertainty of the new entries."""

    table: str
    moved: str
    corrected: str
    position_mm: list[float]
    old_um: list[float]
    new_um: list[float]
    u_um: list[float]
    largest_change_um: float
    at_mm: float


@dataclass(frozen=True, slots=True, kw_only=True)
class ProposalDifference:
    """Changes of a proposal in numbers; ``new``, ``old``: names of the compared tables."""

    new: str
    old: str
    tables: list[CurveDifference]


def difference(reader: Reader, number: int, other: int | None = None) -> ProposalDifference:
    """Compare a proposal with another one, or with the table in force: nine tables with uncertainty. Raises NotStored."""
    from abbe.service.compensation.proposal_diff import ACTIVE, compare  # it can draw pictures, a list of proposals has none

    for one in (number, other or number):
        reader.row("proposals", one, "proposal")
    with as_stored():
        return difference_of(compare(reader.store, number, ACTIVE if other is None else str(other)))


def difference_of(found: TableDifference) -> ProposalDifference:
    """Convert a comparison of tables to numbers for programs."""
    tables = [
        CurveDifference(
            table=f"{c.corrected} over {c.moved}",
            moved=c.moved,
            corrected=c.corrected,
            position_mm=c.position_mm.tolist(),
            old_um=(c.old_mm * 1e3).tolist(),
            new_um=(c.new_mm * 1e3).tolist(),
            u_um=(c.u_mm * 1e3).tolist(),
            largest_change_um=float(c.change_mm[c.worst] * 1e3),
            at_mm=float(c.position_mm[c.worst]),
        )
        for c in found.curves
    ]
    return ProposalDifference(new=found.new, old=found.old, tables=tables)


def push_entries(
    reader: Reader, machine: str | None, push: int | None, state: str | None, cursor: int | None, limit: int
) -> tuple[list[PushTransition], int | None]:
    """Return the push journal, newest entry first; a renamed machine keeps its journal under the first name."""
    journal = machine and reader.store.pushes.chain(machine, reader.control_of(machine))
    rows, after = reader.page("pushes", {"machine": journal, "push": push, "state": state}, cursor, limit)
    return [of_row(PushTransition, row, state=PushState(row.columns["state"])) for row in rows], after


def push_entry(reader: Reader, number: int) -> PushEntry:
    """Return one entry of the journal with the facts that it recorded. Raises NotStored."""
    row = reader.row("pushes", number, "entry of a push")
    return of_row(PushEntry, row, state=PushState(row.columns["state"]))


def tables(reader: Reader) -> TableHistory:
    """Return the table in force on this service's machine, its pushes, and the possible rollback. Raises JournalChanged."""
    return JournalView.read(reader.store, reader.machine, reader.control).history()
