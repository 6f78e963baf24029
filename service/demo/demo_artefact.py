"""The demonstration of a touch probe and a plate: a simulated machine maps and corrects itself in the plane where the plate lay.

measure in four poses -> measure a fifth one (before) -> solve -> tables of this plane -> push -> the fifth pose again (after) -> keep
or roll back; then the sealed truth of the simulator. Only one length of the plate is known. The ball-bar only proves sign and unit of
the tables (`abbe comp commission`), the laser only measures the temperature.
"""

from __future__ import annotations

import asyncio
from dataclasses import replace
from pathlib import Path
from typing import Any

from abbe.service.campaign_data.campaign_folder import from_store
from abbe.service.campaigns.measure import measure
from abbe.service.clock import Clock, SystemClock
from abbe.service.compensation.commission import commission
from abbe.service.compensation.commission_levels import commission_levels
from abbe.service.compensation.correct import correct
from abbe.service.compensation.gate import PushContext
from abbe.service.demo.demo import FIRST_TABLE_LIMITS, DemoResult, bar_rate_hz, demo_site, measured_figures, write_machine_file
from abbe.service.demo.simulator_process import running_simulators, sealed_truth
from abbe.service.devices.session import Session, open_session
from abbe.service.domain.artefact import ArtefactObject
from abbe.service.domain.progress import Progress, ProgressSink
from abbe.service.identification.artefact_answer import artefact_lines, touched_boxes_mm
from abbe.service.rendering.document import Document, Lines, Section, TextTable
from abbe.service.rendering.numbers import plain
from abbe.service.report.artefact_sections import artefact_sections
from abbe.service.sequences.recipes.artefact import ArtefactTest
from abbe.service.sequences.steps import CampaignPlan
from abbe.service.site import Site
from abbe.service.storage.store import Store
from abbe.service.verification.verify import COVERAGE

FORMAT = "abbe-artefact-demo/1"
CAMPAIGN, BEFORE = "plate", "verify-before"
HEIGHT_MM = 200.0
POSES = (((60.0, 60.0), 0.0), ((540.0, 70.0), 90.0), ((148.2, 180.0), 0.0), ((330.0, 200.0), 90.0))
"""Poses of the plate: axis positions X and Y of its zero, mm, and its rotation, degrees. No shift is a multiple of a screw's lead."""
CHECK = ((500.0, 420.0), 180.0)


def pose_plan(
    site: Site, plate: ArtefactObject, name: str, poses: tuple[tuple[tuple[float, float], float], ...], role: str
) -> CampaignPlan:
    """Return the plan of a plate in several poses."""
    tests = [
        ArtefactTest(f"{name}-{k}", f"{name}-{k}", role, "plate", (*at, HEIGHT_MM), rotation_deg=(0.0, 0.0, turn), plate=plate)
        for k, (at, turn) in enumerate(poses, start=1)
    ]
    return CampaignPlan(name, tuple(t.plan(site.machine) for t in tests))


async def run_artefact_demo(seed: int, speed: float, folder: Path, progress: ProgressSink, clock: Clock | None = None) -> DemoResult:
    """Measure, correct and verify a simulated machine with its own probe; ``folder`` receives database and machine file.

    Raises
    ------
    AbbeError, DriverError
        The demonstration failed; the error names cause and remedy. The simulators are stopped in any case.
    """
    clock = clock or SystemClock()
    start, args = clock.monotonic_s(), ["--seed", str(seed)]
    async with running_simulators([*args, "--speed", f"{speed:g}", "--link-dir", str(folder)]) as simulator:
        # one plane is measured, and the tables act at every height: the person who starts this demonstration takes that on
        site = replace(demo_site(simulator), limits=replace(FIRST_TABLE_LIMITS, beyond=1.0))
        write_machine_file(site, folder)
        result = DemoResult(seed=seed, speed=speed, site=site, folder=folder, started_utc=clock.utc().isoformat(timespec="seconds"))
        store = await asyncio.to_thread(Store.open, f"sqlite:///{folder / 'abbe.sqlite3'}")
        try:
            async with open_session(site.urls) as session:
                assert simulator.artefact is not None
                await _job(session, store, result, simulator.artefact, progress)
        finally:
            store.close()
    progress(Progress("truth", 0.0, 1.0, None, "reading the simulator's sealed truth"))
    (box,) = touched_boxes_mm(result.corrected.solved.joint)
    plane = ["--plane", *(f"{v:.3f}" for v in (*box[0], *box[1], box[2, 0]))]
    result.truth_before = await sealed_truth([*args, *plane], None)
    result.truth_after = await sealed_truth([*args, *plane], folder / "active_bank.bin")
    result.duration_s = clock.monotonic_s() - start
    return result


async def _job(session: Session, store: Store, result: DemoResult, plate: ArtefactObject, progress: ProgressSink) -> None:
    site = result.site
    check = pose_plan(site, plate, BEFORE, (CHECK,), "holdout")
    await measure(session, store, site, pose_plan(site, plate, CAMPAIGN, POSES, "identify"), progress=progress)
    await measure(session, store, site, check, progress=progress)
    before = (await asyncio.to_thread(from_store, store, BEFORE)).runs
    await commission_levels(session.controller, store, site)
    await commission(session, store, site, progress=progress)
    result.correction = await correct(
        PushContext(session, store, site, progress, rate_hz=bar_rate_hz(result.speed), poses=check), CAMPAIGN, before
    )
    (result.folder / "active_bank.bin").write_bytes(result.correction.image)


def summary_lines(result: DemoResult) -> list[str]:
    """Return the results line by line."""
    c = result.corrected
    lines = [f"measured: a plate in {len(POSES)} poses, {sum(r.deviation_mm.size for r in c.solved.joint.data)} readings"]
    lines += artefact_lines(c.solved.joint)
    lines += [f"found: {flag.line}" for flag in c.solved.flags]
    for f in measured_figures(c):
        lines.append(
            f"{f.name}: {plain(f.before)} ± {plain(COVERAGE * f.u_before)} -> {plain(f.after)} ± {plain(COVERAGE * f.u_after)} (95 %)"
        )
    lines += [("kept: " if c.decision.keep else "rolled back: ") + c.decision.text]
    lines += [f"tables: {line}" for line in c.not_for_tables]
    before, after = (plain(t.plane_rms_um) for t in result.truths)
    return [*lines, f"sealed truth, rms in this plane: {before} -> {after} µm"]


def artefact_json(result: DemoResult) -> dict[str, Any]:
    """Return the JSON output of `abbe demo --artefact --json`."""
    c = result.corrected
    before, after = result.truths
    return {
        "format": FORMAT,
        "seed": result.seed,
        "measured": {f.name: f.to_document() for f in measured_figures(c)},
        "predicted_rms_um": {"before": c.predicted.before_mm * 1e3, "after": c.predicted.after_mm * 1e3, "u": c.predicted.u_model_mm * 1e3},
        "plane_rms_um": {"before": before.plane_rms_um, "after": after.plane_rms_um},
        "kept": c.decision.keep,
        "verdict": c.decision.text,
        "poses": artefact_lines(c.solved.joint),
        "flags": [flag.line for flag in c.solved.flags],
        "duration_s": round(result.duration_s, 1),
    }


def artefact_report(result: DemoResult) -> Document:
    """Return the report of the demonstration."""
    c = result.corrected
    rows = [
        (f.name, plain(f.before), plain(COVERAGE * f.u_before), plain(f.after), plain(COVERAGE * f.u_after)) for f in measured_figures(c)
    ]
    before, after = (plain(t.plane_rms_um) for t in result.truths)
    rows.append(("sealed truth, rms in the plane", before, "", after, ""))
    table = TextTable(("figure, µm", "before", "U (95 %)", "after", "U (95 %)"), tuple(rows))
    results = Section("Results of these poses", [Lines((*artefact_lines(c.solved.joint), *(flag.line for flag in c.solved.flags)))])
    sections = (Section("Before and after", [c.decision.text, table]), *artefact_sections(c.solved.joint), results)
    title = f"Simulated machine {result.seed}, measured by its own probe"
    return Document(kind="cycle", title=title, sections=sections, signatures=())
