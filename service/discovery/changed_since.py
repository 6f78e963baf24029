"""Changes of a machine since its last solution: the part of a discovery that names a drift.

A table activated in between does not change the machine. Its effect is subtracted from the newer readings and the effect of the older table
added, so that both describe the same machine.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

from abbe.models.compensation.tables import smooth_of
from abbe.models.discovery.changed_since import Change, Changed, changed_since
from abbe.models.solvers.applied_tables import AppliedTables
from abbe.models.uncertainty.known_field import KnownField
from abbe.service.campaign_data.campaign_folder import Campaign
from abbe.service.campaign_data.provenance import machine_digest
from abbe.service.discovery.changed_text import proved
from abbe.service.domain.finding import ChangedSince, ChangeRival, EffectFound, GapUm, MotionChange
from abbe.service.domain.measured import RunTable
from abbe.service.domain.results import SolutionRecord
from abbe.service.domain.solution_file import stored_solution
from abbe.service.effects.model_book import LASTING, applies, version
from abbe.service.errors import AbbeError, StoreError, TableMismatch, Unusable
from abbe.service.identification.removal import NOTHING, RemovedTable, campaign_table, remove_table, subtract_effects, subtract_table
from abbe.service.identification.solution_field import stored_field
from abbe.service.runs.observations import run_data
from abbe.service.storage.store import Store
from abbe.service.tables.measured_with import KIND_AT, NO_CORRECTION, images_of, tables_of
from abbe.service.tables.nine_tables import tables_from_image

LOST_MOTION = "backlash"


@dataclass(frozen=True)
class ReferenceSolution:
    """The solution that a campaign is compared with, and the comparison, which takes a second or two.

    ``compare`` takes the campaign, alone or joined with a later one, and the effects that a search just found in it. If it fails, its
    result has the reason in ``trouble``.
    """

    number: int
    compare: Callable[[Campaign, Sequence[EffectFound]], ChangedSince]


@dataclass(frozen=True)
class _Before:
    """A solution, the CRC of the table that acted while it was measured, and the effects subtracted from its readings.

    ``taken``: labels of these effects; ``version``: the version of the model book that has them, None if no effect was
    subtracted.
    """

    number: int
    known: KnownField
    crc: int | None
    version: int | None
    taken: frozenset[str]


def reference_solution(store: Store, campaign: Campaign) -> ReferenceSolution | None:
    """Return the last comparable solution of the same machine from an earlier stored campaign; None if there is none.

    The solution must have the same geometry and a covariance. The compensation tables of both measurements must be known or equal.
    """
    for record in _earlier(store, campaign):
        try:
            before = _before_of(store, record)
            _tables_between(store, campaign, before)
        except (Unusable, TableMismatch, KeyError, TypeError, ValueError):  # also if an older version stored fewer fields
            continue
        return ReferenceSolution(record.id, partial(_compare, store, before))
    return None


def _earlier(store: Store, campaign: Campaign) -> Iterator[SolutionRecord]:
    """Return the solutions of this machine's earlier campaigns that fitted all 21 motions, newest first."""
    numbers = {m.id for m in store.machines.all() if m.name == campaign.site.name}
    mine = [c for c in store.campaigns.all() if c.machine_id in numbers]
    at = next((c.id for c in mine if c.name == campaign.name), 0)
    digest = machine_digest(campaign.site.machine)
    for one in reversed([c for c in mine if c.id < at]):
        for record in reversed(store.solutions.all(one.id)):
            try:
                solution = stored_solution(record.doc, record.id)
            except Unusable:  # a commissioning, or an older version stored fewer fields
                continue
            if solution.model.startswith("rigid21") and solution.inputs.machine == digest:
                yield record


def _before_of(store: Store, record: SolutionRecord) -> _Before:
    book = stored_solution(record.doc, record.id).machine_model
    known, crc = stored_field(store, record).known, _acting(_tables_of(store, record))
    if book is None or not book.removed:
        return _Before(record.id, known, crc, None, frozenset())
    return _Before(record.id, known, crc, book.version, frozenset(book.removed))


def _tables_of(store: Store, record: SolutionRecord) -> list[RunTable]:
    """Return the table of each run of a solution; if its runs state none, the tables that the solution states."""
    used = set(record.run_ids)
    tables = [r.start.table for r in store.runs.all(record.campaign_id) if r.id in used]
    return (
        tables
        if any(table.document for table in tables)
        else [RunTable(crc=table.crc, acting=table.acting) for table in tables_of(record.doc)]
    )


def _acting(tables: Sequence[RunTable]) -> int | None:
    """Return the CRC of the table that acted in all runs, given the table of each; None if no table acted.

    Raises
    ------
    TableMismatch
        The runs were measured with different tables.
    """
    found = {one.acting_crc for one in tables}
    if len(found) > 1:
        raise TableMismatch("the runs were measured with different compensation tables")
    return next(iter(found), None)


def _tables_between(store: Store, campaign: Campaign, before: _Before) -> RemovedTable | None:
    """Return the effect to subtract from the readings so that they are as with the earlier table; None if both tables are the same.

    Raises
    ------
    TableMismatch
        One of two different tables is unknown, or a campaign used more than one.
    """
    now = _acting([r.table for r in campaign.runs if r.identifies])
    return None if now == before.crc else RemovedTable(_applied(store, now), _applied(store, before.crc))


def _applied(store: Store, crc: int | None) -> AppliedTables:
    """Return how the table with this CRC displaces the axes; `NOTHING` without a table."""
    if crc is None:
        return NOTHING
    image = images_of(store)(crc)
    if image is None:
        raise TableMismatch(f"the compensation table {crc:08X} is not known")
    if int.from_bytes(image[KIND_AT], "big") == NO_CORRECTION:
        return NOTHING
    table = tables_from_image(image)
    return NOTHING if table is None else AppliedTables(smooth_of(table) or table.correction_at)


def _compare(store: Store, before: _Before, campaign: Campaign, found: Sequence[EffectFound]) -> ChangedSince:
    try:
        return _compared(store, before, campaign, found)
    except StoreError:
        raise
    except (AbbeError, ValueError, ArithmeticError, LookupError) as trouble:  # the rest of the finding is still worth reporting
        return ChangedSince(since=before.number, trouble=str(trouble))


def _compared(store: Store, before: _Before, campaign: Campaign, found: Sequence[EffectFound]) -> ChangedSince:
    """Compare the campaign with the old solution.

    Two kinds of effects are first subtracted from its readings: those that the old solution had subtracted, and the campaign's own thermal
    and instrument effects.
    """
    left = remove_table(campaign, campaign_table(store, campaign).table)
    if before.version is not None:
        book = version(store, campaign.site.name, before.version).book.effects
        same = [e for e in book if e.label in before.taken and applies(e, campaign.name)]
        left = subtract_effects(left, same, f"model version {before.version}")
    left = subtract_effects(left, [e for e in found if e.family not in LASTING], "found in these runs")
    used, out = [r for r in left.runs if r.identifies], _tables_between(store, campaign, before)
    changed = changed_since(before.known, tuple(run_data(r) for r in (used if out is None else subtract_table(used, out))))
    # The comparison fits the lost motion of the drives; the old solution's motions may have absorbed any other lasting effect.
    beside = [e.full_title for e in found if e.family in LASTING and e.name != LOST_MOTION]
    return _record(before.number, changed, tuple(beside))


def _record(since: int, changed: Changed, beside: tuple[str, ...]) -> ChangedSince:
    """Convert the changes to their stored form in a finding: µm/m and µrad for linear parts, µm or µrad for shapes."""
    gap = None
    if changed.before_mm is not None and changed.after_mm is not None:
        gap = GapUm(before_um=changed.before_mm * 1e3, after_um=changed.after_mm * 1e3, floor_um=changed.floor_mm * 1e3)
    found = ChangedSince(
        since=since,
        changes=tuple(_change(c) for c in changed.changes),
        gap=gap,
        judged=changed.judged,
        hidden_um_m={k: v * 1e6 for k, v in changed.hidden.items()},
        beside=beside,
    )
    return replace(found, proved=proved(found))


def _change(change: Change) -> MotionChange:
    motion, _, shape = change.name.partition(" ")
    angle = motion[1] in "ABC"
    size = 1e6 if angle or not shape else 1e3
    return MotionChange(
        motion=motion,
        part="shape" if shape else "linear",
        value=change.value * size,
        u=change.u * size,
        unit="um/m" if not shape and motion[0] == "E" else "urad" if angle or not shape else "um",
        evidence=change.evidence,
        rivals=tuple(ChangeRival(name=name, less_evidence=by) for name, by in change.rivals),
        halves=change.halves,
    )
