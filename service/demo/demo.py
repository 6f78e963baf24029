"""The demonstration: measure, correct and verify a simulated machine over real connections.

identify -> measure (before) -> commission -> solve -> push -> measure (after) -> keep or roll back; then the simulator's sealed truth shows
how good the result is.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from datetime import date
from pathlib import Path

from abbe.service.campaigns.measure import measure
from abbe.service.clock import Clock, SystemClock
from abbe.service.compensation.commission import commission
from abbe.service.compensation.commission_levels import commission_levels
from abbe.service.compensation.correct import Correction, correct
from abbe.service.compensation.gate import PushContext
from abbe.service.compensation.proposals import load_runs
from abbe.service.demo.simulator_process import SealedTruth, SimulatorProcess, running_simulators, sealed_truth
from abbe.service.devices.session import Session, open_session
from abbe.service.domain.machine import machine_doc
from abbe.service.domain.progress import Progress, ProgressSink
from abbe.service.machine_text import machine_text
from abbe.service.push.validate import PushLimits
from abbe.service.sequences.control import Watching
from abbe.service.sequences.recipes.campaigns import identification, verification
from abbe.service.sequences.recipes.recipe import CLEARANCE_MM
from abbe.service.site import Site
from abbe.service.storage.store import Store
from abbe.service.verification.verify import figure_rows


@dataclass(frozen=True, slots=True)
class MeasuredFigure:
    """A figure before and after the correction with its standard uncertainty, µm."""

    name: str
    before: float
    u_before: float
    after: float
    u_after: float

    def to_document(self) -> dict[str, float]:
        """The value in JSON, under its name."""
        return {"before": self.before, "u_before": self.u_before, "after": self.after, "u_after": self.u_after}


def measured_figures(c: Correction) -> list[MeasuredFigure]:
    """Return the figures that were measured before and after a correction."""
    old, new = figure_rows(c.before), figure_rows(c.after)
    return [MeasuredFigure(name, *old[name], *new[name]) for name in old if name in new]


MAX_SAMPLES_PER_S = 6000
"""Largest number of ball-bar samples per wall-clock second, so that a small PC keeps up at high speed."""

CERTIFICATES = {kind: date(2099, 12, 31) for kind in ("ballbar", "laser", "artefact")}
"""Last days of the certificates: far away, since simulated instruments need no calibration."""
SIMULATED = Watching(unknown_s=5.0)
"""A longer wait for a silent controller: a simulated one is a program of this computer, silent and still while it waits for a processor."""
FIRST_TABLE_LIMITS = PushLimits(value_mm=0.2, change_mm=0.2, walk_mm=0.2)
"""Wide limits: the first table of an uncorrected machine changes every correction from zero to its full value."""


@dataclass(kw_only=True)
class DemoRun:
    """Common parts of a demonstration: its machine, and the folder for database and machine file."""

    site: Site
    folder: Path
    started_utc: str
    duration_s: float = 0.0
    correction: Correction | None = None


@dataclass(kw_only=True)
class DemoResult(DemoRun):
    """Results of a demonstration that corrects; ``truth_before`` and ``truth_after``: the simulator's sealed truth."""

    seed: int
    speed: float
    truth_before: SealedTruth | None = None
    truth_after: SealedTruth | None = None

    @property
    def corrected(self) -> Correction:
        """The correction. Raises AssertionError if there is none yet."""
        assert self.correction is not None
        return self.correction

    @property
    def truths(self) -> tuple[SealedTruth, SealedTruth]:
        """The sealed truth before and after. Raises AssertionError if the demonstration has not ended."""
        assert self.truth_before is not None
        assert self.truth_after is not None
        return self.truth_before, self.truth_after


def bar_rate_hz(speed: float) -> int:
    """Return the fastest ball-bar rate (a divisor of 1000 Hz) that keeps the wall-clock sample rate within `MAX_SAMPLES_PER_S`."""
    return next((r for r in (1000, 500, 250, 200, 125, 100, 50, 40, 25, 20, 10) if r * speed <= MAX_SAMPLES_PER_S), 10)


def demo_site(simulator: SimulatorProcess) -> Site:
    """Return the site of a simulated machine: its nominal geometry and the addresses of its devices."""
    name, machine = "demo-machine", simulator.machine
    doc = machine_doc(name, machine)
    return Site(name, machine, doc, simulator.urls, limits=FIRST_TABLE_LIMITS, watching=SIMULATED, calibrated_until=CERTIFICATES)


def write_machine_file(site: Site, folder: Path) -> Path:
    """Write a machine file for the running simulated machine, so that other commands can use it."""
    path = folder / "machine.toml"
    path.write_text(machine_file_of(site, verify=False), encoding="utf-8")
    return path


def machine_file_of(site: Site, *, verify: bool = True) -> str:
    """Return the text of the machine file of a simulated machine; ``verify``: include the limits of a check."""
    return machine_text(site.doc, site.urls, site.calibrated_until, site.limits, verify=verify)


async def run_demo(seed: int, speed: float, folder: Path, progress: ProgressSink, clock: Clock | None = None) -> DemoResult:
    """Measure, correct and verify a simulated machine; ``folder`` receives database, machine file and tables.

    Raises
    ------
    AbbeError, DriverError
        The demonstration failed; the error names cause and remedy. The simulators are stopped in any case.
    """
    clock = clock or SystemClock()
    start = clock.monotonic_s()
    simulator_args = ["--seed", str(seed)]
    args = [*simulator_args, "--speed", f"{speed:g}", "--link-dir", str(folder)]
    async with running_simulators(args) as simulator:
        site = demo_site(simulator)
        write_machine_file(site, folder)
        result = DemoResult(seed=seed, speed=speed, site=site, folder=folder, started_utc=clock.utc().isoformat(timespec="seconds"))
        store = await asyncio.to_thread(Store.open, f"sqlite:///{folder / 'abbe.sqlite3'}")
        try:
            async with open_session(site.urls) as session:
                await _job(session, store, result, progress)
        finally:
            store.close()
    progress(Progress("truth", 0.0, 1.0, None, "reading the simulator's sealed truth"))
    bank = folder / "active_bank.bin"
    truth_args = [*simulator_args, "--inside-mm", f"{CLEARANCE_MM:g}"]  # as the verification measures the diagonals
    result.truth_before = await sealed_truth(truth_args, None)
    result.truth_after = await sealed_truth(truth_args, bank)
    result.duration_s = clock.monotonic_s() - start
    return result


async def _job(session: Session, store: Store, result: DemoResult, progress: ProgressSink) -> None:
    site, rate = result.site, bar_rate_hz(result.speed)
    await measure(session, store, site, identification(site.machine, rate_hz=rate), progress=progress)
    before_ids = await measure(session, store, site, verification(site.machine, rate_hz=rate, name="verify-before"), progress=progress)
    before = await load_runs(store, before_ids)
    await commission_levels(session.controller, store, site)
    await commission(session, store, site, progress=progress)
    result.correction = await correct(PushContext(session, store, site, progress, rate_hz=rate), "identify", before)
    (result.folder / "active_bank.bin").write_bytes(result.correction.image)
