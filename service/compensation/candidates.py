"""The candidate of a proposal and the context that it is checked against: machine, controller, table in force, time."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable
from dataclasses import dataclass, replace
from datetime import UTC, date, datetime, time, timedelta
from typing import Any

import numpy as np

from abbe.drivers.api import TableFormat
from abbe.drivers.tables import FORMAT_VERSION
from abbe.models.compensation.tables import NineTables, Predicted
from abbe.models.machine import AXES
from abbe.service.clock import Clock
from abbe.service.push.validate import Candidate, CandidateContext, Column, EvidenceSeal, TableEvidence, content_digest
from abbe.service.site import Site
from abbe.service.storage.store import Store
from abbe.service.tables.base_table import Base
from abbe.service.tables.nine_tables import tables_from_image
from abbe.service.tables.push_journal import JournalView

Runs = list[dict[str, Any]]
SIGNER = "metrologist"
MONTH = timedelta(days=30)


@dataclass(frozen=True, slots=True)
class Promise:
    """Computed tables and what the model promises of them.

    ``tables``: absolute, in the controller's unit; ``change``: what they add to those in force, as computed. ``drift_mm``: residual of the
    solution in the newest unused run; None without one. ``ended_s``, ``last_s``: end of the oldest and of the newest identifying run,
    seconds UTC.
    """

    tables: NineTables
    change: NineTables
    predicted: Predicted
    drift_mm: float | None
    ended_s: float
    last_s: float


def candidate_of(site: Site, promise: Promise, base: Base, runs: Runs, form: TableFormat) -> Candidate:
    """Make a signed candidate of computed tables; ``runs``: the solved runs, ``abbe-run/1``."""
    columns = tuple(_column(promise, a, i) for a in range(3) for i in range(3))
    blank = Candidate(site.name, FORMAT_VERSION, form.lsb_nm, "mm", columns, base.crc, _evidence(site, promise, runs), "")
    digest = content_digest(blank)
    return replace(blank, digest=digest, seal=EvidenceSeal(SIGNER, digest))


def _column(promise: Promise, a: int, i: int) -> Column:
    values = promise.tables.correction_mm[a][:, i] + 0.0  # -0.0 has other bytes than 0.0
    left = -promise.change.correction_mm[a][:, i] + 0.0
    return Column(AXES[a], AXES[i], tuple(promise.tables.position_mm[a].tolist()), tuple(values.tolist()), tuple(_plain(left)))


def _plain(values: Any) -> list[float]:
    """Numbers below 1e-15 become zero: the checks refuse denormal ones."""
    return [0.0 if abs(v) < 1e-15 else float(v) for v in values]


def _evidence(site: Site, promise: Promise, runs: Runs) -> TableEvidence:
    used = [r for r in runs if r["role"] == "identify"]
    air = [float(t) for r in used for t in r["columns"].get("temp_air_C", [])]
    if not air or not np.isfinite(air).all():
        air = [float("nan")]
    p = promise.predicted
    until = tuple(until_s(site.calibrated_until[kind]) for kind in sorted(_instruments(used)) if kind in site.calibrated_until)
    known = until if len(until) == len(_instruments(used)) else ()
    drift = 0.0 if promise.drift_mm is None else promise.drift_mm
    return TableEvidence(
        len(used), promise.ended_s, (min(air), max(air)), drift, p.u_model_mm, p.before_mm, p.after_mm,
        mark_of(boot for r in used for boot in [r.get("table", {}).get("boot_id")]), known,
        promise.last_s,
    )  # fmt: skip


def _instruments(runs: Runs) -> set[str]:
    return {"ballbar" if r["test"].startswith("ballbar") else "laser" for r in runs}


def until_s(day: date) -> float:
    """The end of the last day of a certificate, UTC."""
    return datetime.combine(day, time.max, UTC).timestamp()


def mark_of(boots: Iterable[int | None]) -> str:
    """A mark that must not change between measuring and pushing: the boot ids of the controller, each once."""
    distinct = sorted({-1 if boot is None else int(boot) for boot in boots})
    return "boot " + ", ".join("not known" if boot < 0 else f"{boot:08X}" for boot in distinct)


async def candidate_context(
    site: Site, store: Store, base: Base, form: TableFormat, grid: NineTables, clock: Clock, *, attended: bool = True
) -> CandidateContext:
    """This machine, its controller and its table in force, now. ``attended``: a person who may approve is at the machine."""
    journal = await asyncio.to_thread(JournalView.read, store, site.name, site.control, origins=False)
    month_ago = {} if attended else _on_grid(_month_ago(journal, base, clock), grid)
    travel = {axis: (float(low), float(high)) for axis, (low, high) in zip(AXES, site.machine.stroke_mm, strict=True)}
    return CandidateContext(
        site.name, mark_of([base.status.boot_id]), FORMAT_VERSION, form.lsb_nm, form.bank_registers, travel, {}, base.crc,
        _on_grid(base.tables, grid), month_ago, clock.utc().timestamp(), attended=attended, last_push_s=journal.last_kept_s,
    )  # fmt: skip


def _month_ago(journal: JournalView, base: Base, clock: Clock) -> NineTables | None:
    """The tables that were in force `MONTH` ago by the journal: before the first push its base, without any push the present ones."""
    kept, old = journal.kept(), journal.kept(clock.utc() - MONTH)
    if not kept:
        return base.tables
    return tables_from_image(old[-1].image if old else kept[0].base_image)


def _on_grid(tables: NineTables | None, grid: NineTables) -> dict[tuple[str, str], tuple[float, ...]]:
    """Tables interpolated onto another grid; zeros for no correction."""
    if tables is None:
        return {(a, i): (0.0,) * grid.position_mm[k].size for k, a in enumerate(AXES) for i in AXES}
    found = {}
    for k, a in enumerate(AXES):
        for n, i in enumerate(AXES):
            found[(a, i)] = tuple(np.interp(grid.position_mm[k], tables.position_mm[k], tables.correction_mm[k][:, n]).tolist())
    return found
