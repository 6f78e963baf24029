"""What has changed in a machine since its last solution, beside what its model lacks: the part of a discovery that names a drift.

A table that was put in force in between is no change of the machine: what it does is taken out of the newer readings, and what the older
table did is put in its place, so that both are of the same machine.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from models.compensation.smooth import smooth_of
from models.compensation.tables import NineTables
from models.discovery.changed import Change, Changed, changed_since
from models.solvers.in_force import InForce
from models.uncertainty.known_field import KnownField
from service.errors import TableMismatch, Unusable
from service.runs.observations import run_data
from service.storage.records import SolutionRecord
from service.storage.store import Store
from service.workflows.campaign_folder import Campaign
from service.workflows.measured_with import KIND_AT, NO_CORRECTION, images_of, tables_of
from service.workflows.provenance import machine_digest
from service.workflows.solution_field import stored_field
from service.workflows.table_out import NOTHING, TableThen, Taken, less
from service.workflows.tables import tables_from_image
from service.workflows.taken_out import taken_out

Doc = dict[str, Any]


@dataclass(frozen=True)
class Since:
    """The solution that a campaign is compared with, and how; comparing takes a second or two."""

    number: int
    compare: Callable[[], Doc]


def since_of(store: Store, campaign: Campaign, then: TableThen) -> Since | None:
    """The last solution of the same machine from before a campaign, if there is one that can be compared.

    It has to be of the same geometry and to hold its covariance, and both tables have to be known: that which was in force when it was
    measured, and ``then``, in force now.
    """
    if then.why:
        return None
    candidates = (_with(store, campaign, then, record) for record in _before(store, campaign))
    return next((one for one in candidates if one is not None), None)


def _with(store: Store, campaign: Campaign, then: TableThen, record: SolutionRecord) -> Since | None:
    try:
        known, old = stored_field(store, record).known, _table_of(store, record)
    except (Unusable, TableMismatch):
        return None
    return Since(record.id, lambda: {"since": record.id} | _compared(store, campaign, then, known, old))


def _before(store: Store, campaign: Campaign) -> Iterator[SolutionRecord]:
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


def _table_of(store: Store, record: SolutionRecord) -> NineTables | None:
    """The table that a solution was measured with; None: none that did anything.

    Raises
    ------
    TableMismatch
        More than one, or one that this database does not know.
    """
    told = [one for one in tables_of(record.doc) if one.get("acting") is not False]
    if not told:
        return None
    image = images_of(store)(told[0]["crc"])
    if len(told) > 1 or (image is None and told[0].get("acting")):
        raise TableMismatch(f"solution {record.id} was measured with a table that is not known")
    if image is None or int.from_bytes(image[KIND_AT], "big") == NO_CORRECTION:
        return None
    return tables_from_image(image)


def _compared(store: Store, campaign: Campaign, then: TableThen, known: KnownField, old: NineTables | None) -> Doc:
    left = taken_out(store, campaign, then).campaign
    used = [r for r in left.runs if r["role"] == "identify"]
    if not _same(then.table, old):
        used = less(used, Taken(_force(then.table), _force(old)))
    found = changed_since(known, tuple(run_data(r) for r in used))
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
    return {"changes": [_change(c) for c in found.changes], "gap": gap, "seen_um_m": {k: v * 1e6 for k, v in found.seen.items()}}


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
