"""What has changed in a machine since its last solution, beside what its model lacks: the part of a discovery that names a drift.

A table that was put in force in between is no change of the machine: what it does is taken out of the newer readings, and what the older
table did is put in its place, so that both are of the same machine.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from models.compensation.smooth import smooth_of
from models.compensation.tables import NineTables
from models.discovery.changed import Change, Changed, changed_since
from models.solvers.in_force import InForce
from models.uncertainty.known_field import KnownField
from service.errors import AbbeError, StoreError, TableMismatch, Unusable
from service.runs.observations import run_data
from service.storage.records import SolutionRecord
from service.storage.store import Store
from service.workflows.campaign_folder import Campaign
from service.workflows.measured_with import KIND_AT, NO_CORRECTION, distinct, images_of, stored_tables
from service.workflows.provenance import machine_digest
from service.workflows.solution_field import stored_field
from service.workflows.table_out import NOTHING, Taken, less, table_then
from service.workflows.tables import tables_from_image
from service.workflows.taken_out import taken_out

Doc = dict[str, Any]


@dataclass(frozen=True)
class Since:
    """The solution that a campaign is compared with, and how; comparing takes a second or two.

    ``compare``: of the campaign, or of one that it was joined with; what cannot be told is its ``trouble``.
    """

    number: int
    compare: Callable[[Campaign], Doc]


@dataclass(frozen=True)
class _Before:
    """A solution, what it knows, and which of the model book's effects had been taken out of its readings."""

    number: int
    known: KnownField
    crcs: frozenset[int]
    table: NineTables | None
    taken: frozenset[str]


def since_of(store: Store, campaign: Campaign) -> Since | None:
    """The last solution of the same machine from before a campaign, if there is one that can be compared.

    It has to be of the same geometry and to hold its covariance. Both tables, that which was in force when it was measured and the present
    one, have to be known, or to be the same.
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
    numbers = {m.id for m in store.machines() if m.name == campaign.site.name}
    mine = [c for c in store.campaigns() if c.machine_id in numbers]
    at = next((c.id for c in mine if c.name == campaign.name), None)
    digest = machine_digest(campaign.site.machine)
    for one in reversed([c for c in mine if at is None or c.id < at]):
        for record in reversed(store.solutions(one.id)):
            doc = record.doc
            if str(doc.get("model", "")).startswith("rigid21") and (doc.get("inputs") or {}).get("machine") == digest:
                yield record


def _before_of(store: Store, record: SolutionRecord) -> _Before:
    tables = stored_tables(store, record.id)
    taken = frozenset((record.doc.get("machine_model") or {}).get("taken_out", []))
    crcs = frozenset(one["crc"] for one in tables)
    return _Before(record.id, stored_field(store, record).known, crcs, _acting(store, tables), taken)


def _acting(store: Store, tables: list[Doc]) -> NineTables | None:
    """The table that did something to runs; None: none did, or nobody knows which.

    Raises
    ------
    TableMismatch
        It is of a kind that cannot be read.
    """
    told = [one for one in tables if one.get("acting") is not False]
    image = images_of(store)(told[0]["crc"]) if len(told) == 1 else None
    if image is None or int.from_bytes(image[KIND_AT], "big") == NO_CORRECTION:
        return None
    return tables_from_image(image)


def _tables_between(store: Store, campaign: Campaign, before: _Before) -> Taken | None:
    """What is taken out of readings so that they are those of the machine with the earlier table; None: nothing.

    Raises
    ------
    TableMismatch
        One of two different tables is not known, or there was more than one at a time.
    """
    used = [r.get("table") or {} for r in campaign.runs if r["role"] == "identify"]
    tables = distinct([one for one in used if "crc" in one])
    now = frozenset(one["crc"] for one in tables)
    if now == before.crcs and len(now) <= 1:
        return None
    images = images_of(store)
    acting = [one["crc"] for one in tables if one.get("acting") is not False]
    if len(acting) > 1 or any(images(crc) is None for crc in (*acting, *before.crcs)) or len(before.crcs) > 1:
        raise TableMismatch("the tables of both campaigns have to be known")
    new = _acting(store, tables)
    return None if _same(new, before.table) else Taken(_force(new), _force(before.table))


def _compare(store: Store, before: _Before, campaign: Campaign) -> Doc:
    try:
        return {"since": before.number} | _compared(store, campaign, before)
    except StoreError:
        raise
    except (AbbeError, ValueError, ArithmeticError, LookupError) as trouble:  # what is missing is worth telling all the same
        return {"since": before.number, "changes": [], "gap": None, "judged": None, "hidden_um_m": {}, "trouble": str(trouble)}


def _compared(store: Store, campaign: Campaign, before: _Before) -> Doc:
    left = taken_out(store, campaign, table_then(store, campaign))
    if frozenset(left.labels) != before.taken:
        other = ", ".join(sorted(before.taken.symmetric_difference(left.labels)))
        raise Unusable(f"the model book knew other effects then than now ({other})", "solve the earlier campaign again")
    used = [r for r in left.campaign.runs if r["role"] == "identify"]
    out = _tables_between(store, campaign, before)
    found = changed_since(before.known, tuple(run_data(r) for r in (used if out is None else less(used, out))))
    return changed_doc(found)


def _same(a: NineTables | None, b: NineTables | None) -> bool:
    if a is None or b is None:
        return a is b
    pairs = [*zip(a.position_mm, b.position_mm, strict=True), *zip(a.correction_mm, b.correction_mm, strict=True)]
    return all(np.array_equal(x, y, equal_nan=True) for x, y in pairs)


def _force(table: NineTables | None) -> InForce:
    """What an axis that follows does by a table."""
    return NOTHING if table is None else InForce(smooth_of(table) or table.correction_at)


def changed_doc(found: Changed) -> Doc:
    """The changes as they are stored with a finding: µm/m and µrad of what is linear, µm or µrad of shapes; ``gap`` as of a finding."""
    gap = None
    if found.before_mm is not None and found.after_mm is not None:
        gap = {"before_um": found.before_mm * 1e3, "after_um": found.after_mm * 1e3, "floor_um": found.floor_mm * 1e3}
    hidden = {k: v * 1e6 for k, v in found.hidden.items()}
    return {"changes": [_change(c) for c in found.changes], "gap": gap, "judged": found.judged, "hidden_um_m": hidden}


def _change(change: Change) -> Doc:
    motion, _, shape = change.name.partition(" ")
    angle = motion[1] in "ABC"
    size = 1e6 if angle or not shape else 1e3
    unit = "um/m" if not shape and motion[0] == "E" else "urad" if angle or not shape else "um"
    return {
        "motion": motion,
        "part": shape or "linear",
        "value": change.value * size,
        "u": change.u * size,
        "unit": unit,
        "evidence": change.evidence,
        "rivals": [{"name": name, "less_evidence": less_} for name, less_ in change.rivals],
        "halves": change.halves,
    }
