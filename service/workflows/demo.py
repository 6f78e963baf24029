"""The demonstration: the whole job on a simulated machine over real wires.

measure (before) -> identify -> solve -> push -> measure (after) -> keep or roll back; then the simulator's sealed truth says how well it
went.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from models.compensation.tables import NineTables, Predicted, nine_tables, predict_residual, quantise
from service.clock import Clock, SystemClock
from service.devices.session import DeviceUrls, Session, open_session
from service.events import Progress, ProgressSink
from service.runs.columns import load_run
from service.sequences.campaigns import identification, verification
from service.site import Site, machine_doc, machine_from_doc
from service.storage.store import Store
from service.workflows.compensate import Pushed, Pusher
from service.workflows.measure import measure
from service.workflows.solve import Solved, helix_misfit, solution_doc, solve_runs
from service.workflows.verify import Decision, Figures, decide, figures
from service.workflows.world import running_world, sealed_truth

GRID = (25, 21, 19)
LSB_NM = 100
MAX_SAMPLES_PER_S = 6000
"""Ball-bar samples per wall second that the demonstration asks for at most, so that a small PC follows at high speed."""


@dataclass
class DemoResult:
    """Everything the demonstration found; the command line prints it, the report shows it."""

    seed: int
    speed: float
    site: Site
    folder: Path
    started_utc: str
    duration_s: float = 0.0
    noise_bar_um: float = 0.0
    holdout_misfit_um: float = 0.0
    before: Figures | None = None
    after: Figures | None = None
    solved: Solved | None = None
    tables: NineTables | None = None
    predicted: Predicted | None = None
    pushed: Pushed | None = None
    decision: Decision | None = None
    truth_before: dict[str, Any] = field(default_factory=dict)
    truth_after: dict[str, Any] = field(default_factory=dict)
    run_ids: list[int] = field(default_factory=list)


def bar_rate_hz(speed: float) -> int:
    """Fastest ball-bar rate (a divisor of 1000 Hz) that keeps the wall-clock sample rate within `MAX_SAMPLES_PER_S`."""
    return next((r for r in (1000, 500, 250, 200, 125, 100, 50, 40, 25, 20, 10) if r * speed <= MAX_SAMPLES_PER_S), 10)


def demo_site(ready: dict[str, Any]) -> Site:
    """The machine file's content for a simulated machine: its nominal geometry and where its devices listen."""
    machine = machine_from_doc(ready["machine"])
    urls = DeviceUrls(ready["cnc"], ready["ballbar"], ready["laser"], ready["fixture"])
    return Site("demo-machine", machine, machine_doc("demo-machine", machine), urls)


def write_machine_file(site: Site, folder: Path) -> Path:
    """A machine file for the running simulated machine, so that other commands can talk to it."""

    def row(values: Any) -> str:
        return "[" + ", ".join(f"{float(v):g}" for v in values) + "]"

    m = site.machine
    lines = [f'name = "{site.name}"', f'chain = "{m.chain}"', f"tool_mm = {row(m.tool_mm)}", "", "[stroke_mm]"]
    lines += [f"{a} = {row(m.stroke_mm[k])}" for k, a in enumerate("XYZ")]
    lines += ["", "[pivots_mm]"] + [f"{a} = {row(m.pivots_mm[k])}" for k, a in enumerate("XYZ")]
    lines += ["", "[devices]"] + [f'{k} = "{getattr(site.urls, k)}"' for k in ("cnc", "ballbar", "laser", "fixture")]
    lines += ["", "[store]", 'url = "sqlite:///abbe.sqlite3"', ""]
    path = folder / "machine.toml"
    path.write_text("\n".join(lines), encoding="utf-8")
    return path


async def run_demo(seed: int, speed: float, folder: Path, progress: ProgressSink, clock: Clock | None = None) -> DemoResult:
    """Run the whole job on a simulated machine; ``folder`` keeps database, machine file and tables.

    Raises
    ------
    AbbeError, DriverError
        One cause, one remedy. The simulators are gone in any case.
    """
    clock = clock or SystemClock()
    start = clock.monotonic_s()
    world_args = ["--seed", str(seed)]
    args = [*world_args, "--speed", f"{speed:g}", "--link-dir", str(folder)]
    async with running_world(args) as world:
        site = demo_site(world.ready)
        write_machine_file(site, folder)
        result = DemoResult(seed, speed, site, folder, clock.utc().isoformat(timespec="seconds"))
        store = await asyncio.to_thread(Store.open, f"sqlite:///{folder / 'abbe.sqlite3'}")
        try:
            async with open_session(site.urls) as session:
                await _job(session, store, result, progress)
        finally:
            store.close()
    progress(Progress("truth", 0.0, 1.0, None, "asking the simulator's sealed truth"))
    bank = folder / "active_bank.bin"
    result.truth_before = await sealed_truth(world_args, None)
    result.truth_after = await sealed_truth(world_args, bank)
    result.duration_s = clock.monotonic_s() - start
    return result


async def _job(session: Session, store: Store, result: DemoResult, progress: ProgressSink) -> None:
    site, rate = result.site, bar_rate_hz(result.speed)
    before_ids = await measure(session, store, site, verification(site.machine, rate_hz=rate, name="verify-before"), progress=progress)
    run_ids = await measure(session, store, site, identification(site.machine, rate_hz=rate), progress=progress)
    progress(Progress("solve", 0.0, 1.0, None, "21 error motions with all set-up errors"))
    runs = await _load(store, run_ids)
    before = await _load(store, before_ids)
    solved = await asyncio.to_thread(solve_runs, site, runs)
    result.run_ids = before_ids + run_ids
    result.solved, result.before = solved, figures(before)
    result.noise_bar_um = solved.noise_bar_mm * 1e3
    result.holdout_misfit_um = helix_misfit(solved, next(r for r in before if r["test"] == "ballbar_helix")) * 1e3
    result.tables = quantise(nine_tables(solved.joint, GRID), LSB_NM * 1e-6)
    result.predicted = predict_residual(solved.joint, result.tables)
    await _push_and_verify(session, store, result, progress)


async def _push_and_verify(session: Session, store: Store, result: DemoResult, progress: ProgressSink) -> None:
    site, solved, tables = result.site, result.solved, result.tables
    assert solved is not None
    assert tables is not None
    assert result.before is not None
    campaign = await asyncio.to_thread(store.campaign, "identify")
    solution_id = await store.write(store.add_solution, campaign.id, "joint", result.run_ids, solution_doc(solved))
    progress(Progress("push", 0.0, 1.0, None, "nine tables to the inactive bank, read back twice, activate"))
    pusher = Pusher(session.controller, store, site)
    result.pushed = await pusher.push(tables, lsb_nm=LSB_NM, solution_id=solution_id, doc={"kind": "nine one-axis tables"})
    plan = verification(site.machine, rate_hz=bar_rate_hz(result.speed), name="verify-after")
    ids = await measure(session, store, site, plan, progress=progress)
    result.run_ids = result.run_ids + ids
    result.after = figures(await _load(store, ids))
    result.decision = decide(result.before, result.after)
    if result.decision.keep:
        await pusher.keep()
    else:
        await pusher.roll_back(result.pushed, result.decision.text)
        result.pushed = replace(result.pushed, bank=result.pushed.previous_bank)
    image = await session.controller.read_bank(result.pushed.bank)
    (result.folder / "active_bank.bin").write_bytes(image)
    machine_id = await store.write(store.add_machine, site.name, site.doc)
    verdict = "pass" if result.decision.keep else "fail"
    await store.write(store.add_verification, machine_id, None, verdict, {"text": result.decision.text})


async def _load(store: Store, run_ids: list[int]) -> list[dict[str, Any]]:
    return await asyncio.to_thread(lambda: [load_run(store, k) for k in run_ids])
