"""What has changed in a machine since its last solution, beside what its model lacks: the part of a discovery that names a drift.

A table that was put in force in between is no change of the machine: what it does is taken out of the newer readings, and what the older
table did is put in its place, so that both are of the same machine.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from abbe.models.compensation.smooth import smooth_of
from abbe.models.discovery.changed.comparison import Change, Changed, changed_since
from abbe.models.solvers.in_force import AppliedTables
from abbe.models.uncertainty.known_field import KnownField
from abbe.service.campaign_data.campaign_folder import Campaign
from abbe.service.campaign_data.provenance import machine_digest
from abbe.service.discovery.changed_words import proved
from abbe.service.domain.finding import ChangedSince, ChangeRival, EffectFound, GapUm, MotionChange
from abbe.service.domain.results import SolutionRecord
from abbe.service.domain.solution_file import stored_solution
from abbe.service.effects.known_effects import LASTING, applies
from abbe.service.effects.model_book import version
from abbe.service.errors import AbbeError, StoreError, TableMismatch, Unusable
from abbe.service.identification.effect_removal import less_effects
from abbe.service.identification.solution_field import stored_field
from abbe.service.identification.table_removal import NOTHING, RemovedTable, as_left, less, table_then
from abbe.service.runs.observations import run_data
from abbe.service.storage.store import Store
from abbe.service.tables.measured_with import KIND_AT, NO_CORRECTION, images_of, tables_of
from abbe.service.tables.nine_tables import tables_from_image

Doc = dict[str, Any]
LOST_MOTION = "backlash"


@dataclass(frozen=True)
class Since:
    """The solution that a campaign is compared with, and how; comparing takes a second or two.

    ``compare``: of the campaign, or of one that it was joined with, and what a search has just found in it; a comparison that fails says
    why in its ``trouble``.
    """

    number: int
    compare: Callable[[Campaign, Sequence[EffectFound]], ChangedSince]


@dataclass(frozen=True)
class _Before:
    """A solution and what it knows; the table that acted when it was measured, by its CRC; what had been taken out of its readings.

    ``taken``: labels of the model book's ``version``, None: nothing of a book.
    """

    number: int
    known: KnownField
    crc: int | None
    version: int | None
    taken: frozenset[str]


def since_of(store: Store, campaign: Campaign) -> Since | None:
    """The last solution of the same machine from a campaign stored before, if there is one that can be compared.

    It has to be of the same geometry and to hold its covariance. The tables that acted when both were measured have to be known, or to be
    the same.
    """
    for record in _earlier(store, campaign):
        try:
            before = _before_of(store, record)
            _tables_between(store, campaign, before)
        except (Unusable, TableMismatch, KeyError, TypeError, ValueError):  # or stored by a version that kept less
            continue
        return Since(record.id, partial(_compare, store, before))
    return None


def _earlier(store: Store, campaign: Campaign) -> Iterator[SolutionRecord]:
    """Solutions of all 21 motions of this machine's earlier campaigns, the newest first."""
    numbers = {m.id for m in store.machines.all() if m.name == campaign.site.name}
    mine = [c for c in store.campaigns.all() if c.machine_id in numbers]
    at = next((c.id for c in mine if c.name == campaign.name), 0)
    digest = machine_digest(campaign.site.machine)
    for one in reversed([c for c in mine if c.id < at]):
        for record in reversed(store.solutions.all(one.id)):
            try:
                solution = stored_solution(record.doc, record.id)
            except Unusable:  # a commissioning, or stored by a version that kept less
                continue
            if solution.model.startswith("rigid21") and solution.inputs.machine == digest:
                yield record


def _before_of(store: Store, record: SolutionRecord) -> _Before:
    book = stored_solution(record.doc, record.id).machine_model
    known, crc = stored_field(store, record).known, _acting(_tables_of(store, record))
    if book is None or not book.taken_out:
        return _Before(record.id, known, crc, None, frozenset())
    return _Before(record.id, known, crc, book.version, frozenset(book.taken_out))


def _tables_of(store: Store, record: SolutionRecord) -> list[Doc]:
    """What each run of a solution says of its table; what the solution says, where its runs say nothing."""
    used = set(record.run_ids)
    starts = [r.start_doc for r in store.runs.all(record.campaign_id) if r.id in used]
    told = [start.get("imported", start).get("table") or {} for start in starts]
    return told if any(told) else tables_of(record.doc)


def _acting(told: Sequence[Doc]) -> int | None:
    """CRC of the table that may have acted in all of some runs; None: in none of them.

    Raises
    ------
    TableMismatch
        Not in all of them, or another one.
    """
    found = {None if one.get("crc") is None or one.get("acting") is False else int(one["crc"]) for one in told}
    if len(found) > 1:
        raise TableMismatch("these runs were not all measured with one table")
    return next(iter(found), None)


def _tables_between(store: Store, campaign: Campaign, before: _Before) -> RemovedTable | None:
    """What is taken out of readings so that they are those of the machine with the earlier table; None: nothing.

    Raises
    ------
    TableMismatch
        One of two different tables is not known, or there was more than one at a time.
    """
    now = _acting([r.get("table") or {} for r in campaign.runs if r["role"] == "identify"])
    return None if now == before.crc else RemovedTable(_force(store, now), _force(store, before.crc))


def _force(store: Store, crc: int | None) -> AppliedTables:
    """What axes that follow do by a table."""
    if crc is None:
        return NOTHING
    image = images_of(store)(crc)
    if image is None:
        raise TableMismatch(f"table {crc:08X} is not known")
    if int.from_bytes(image[KIND_AT], "big") == NO_CORRECTION:
        return NOTHING
    table = tables_from_image(image)
    return NOTHING if table is None else AppliedTables(smooth_of(table) or table.correction_at)


def _compare(store: Store, before: _Before, campaign: Campaign, found: Sequence[EffectFound]) -> ChangedSince:
    try:
        return _compared(store, before, campaign, found)
    except StoreError:
        raise
    except (AbbeError, ValueError, ArithmeticError, LookupError) as trouble:  # what is missing is worth telling all the same
        return ChangedSince(since=before.number, trouble=str(trouble))


def _compared(store: Store, before: _Before, campaign: Campaign, found: Sequence[EffectFound]) -> ChangedSince:
    """The campaign less what the solution's readings were without, too, and less what heat and instruments did in it alone."""
    left = as_left(campaign, table_then(store, campaign).table)
    if before.version is not None:
        book = version(store, campaign.site.name, before.version).book.effects
        same = [e for e in book if e.label in before.taken and applies(e, campaign.name)]
        left = less_effects(left, same, f"model version {before.version}")
    left = less_effects(left, [e for e in found if e.family not in LASTING], "found in these runs")
    used, out = [r for r in left.runs if r["role"] == "identify"], _tables_between(store, campaign, before)
    changed = changed_since(before.known, tuple(run_data(r) for r in (used if out is None else less(used, out))))
    # A drive's lost motion is free in the comparison; what else lasts may have been there before, swallowed by the motions.
    beside = [e.words for e in found if e.family in LASTING and e.name != LOST_MOTION]
    return _record(before.number, changed, tuple(beside))


def _record(since: int, changed: Changed, beside: tuple[str, ...]) -> ChangedSince:
    """The changes as they are kept with a finding: µm/m and µrad of what is linear, µm or µrad of shapes."""
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
