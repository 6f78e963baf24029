"""Measure a campaign: every test becomes a run in the store, complete or visibly not."""

from __future__ import annotations

import platform
from dataclasses import dataclass, field
from importlib.metadata import version
from typing import Any

from drivers.errors import DriverError
from drivers.links.shielded import run_to_end
from service.clock import Clock, SystemClock
from service.devices.session import Session
from service.errors import AbbeError
from service.events import Progress, ProgressSink, ignore_progress
from service.runs.recorder import recording
from service.sequences.check import dry_run_campaign
from service.sequences.guard import warnings_of
from service.sequences.runner import Runner, Tick
from service.sequences.steps import CampaignPlan, RecordPath, TestPlan
from service.site import Site
from service.storage.store import Store


@dataclass
class Meter:
    """Progress of a job in planned machine seconds; the wall time per machine second so far gives the ETA.

    The time in which the job waited for a person (``waited_s``) says nothing about the machine and does not count.
    """

    stage: str
    total_s: float
    sink: ProgressSink
    clock: Clock
    done_s: float = 0.0
    start_s: float = field(default=0.0)
    waited_s: float = 0.0

    def __post_init__(self) -> None:
        """Start the stopwatch."""
        self.start_s = self.clock.monotonic_s()

    def at(self, done_s: float, message: str, waited_s: float = 0.0) -> None:
        """Report how far the job is, and how long the last step waited for a person."""
        self.waited_s += waited_s
        elapsed = self.clock.monotonic_s() - self.start_s - self.waited_s
        eta = elapsed / done_s * (self.total_s - done_s) if done_s > 0.02 * self.total_s else None
        self.sink(Progress(self.stage, done_s, self.total_s, eta, message))


@dataclass
class OpenCampaign:
    """A campaign that is being measured: number in the store, clock zero and when each set-up was mounted (controller time, us)."""

    id: int
    ctrl0_us: int
    mounted_us: dict[str, int] = field(default_factory=dict)


async def start_campaign(session: Session, store: Store, site: Site, name: str, more: dict[str, Any] | None = None) -> tuple[int, int]:
    """A new campaign in the store and its clock zero (controller time, us). ``more``: what else its document shall say."""
    machine_id = await store.write(store.add_machine, site.name, site.doc)
    status = await session.controller.status()
    comp = await session.controller.comp_status()
    doc = {
        "ctrl0_us": status.ctrl_us,
        "active_bank": comp.active_bank,
        "table_crc": comp.bank_crc[comp.active_bank],
        "boot_id": comp.boot_id,
        "current_model": {"includes": ["rigid21", "setup_centre_offset", "bar_length_error", "mirror_tilt"], "errors": None},
        "instruments": {"ballbar": {"resolution_mm": 1e-6}, "laser": {"resolution_mm": 1e-7}},
        "temperature_sensors": False,
    } | (more or {})
    return await store.write(store.add_campaign, machine_id, name, doc), status.ctrl_us


async def measure(
    session: Session,
    store: Store,
    site: Site,
    plan: CampaignPlan,
    *,
    progress: ProgressSink = ignore_progress,
    clock: Clock | None = None,
    campaign: tuple[int, int] | None = None,
) -> list[int]:
    """Run all tests of a plan; returns the run numbers in the store.

    Parameters
    ----------
    campaign : tuple of int, optional
        A campaign that was begun, as `start_campaign` gives it; default: a new one of the plan's name.

    Raises
    ------
    StrokeError
        Before anything moves.
    UnsafeToMove, MeasurementFault, DriverError
        The run in hand is closed as failed, with the reason; earlier runs stay.
    """
    clock = clock or SystemClock()
    dry = dry_run_campaign(site.machine, plan, site.max_feed_mm_min)
    campaign = campaign or await start_campaign(session, store, site, plan.name)
    meter = Meter(plan.name, sum(d.duration_s for d in dry), progress, clock)
    run_ids, under_way = [], OpenCampaign(*campaign)
    for test, expected in zip(plan.tests, dry, strict=True):
        base = meter.done_s

        def tick(seconds: float, waited_s: float, base: float = base, label: str = test.label) -> None:
            meter.at(base + seconds, label, waited_s)

        run_ids.append(await measure_test(session, store, site, under_way, test, tick, clock))
        meter.done_s = base + expected.duration_s
        meter.at(meter.done_s, test.label)
    return run_ids


async def measure_test(
    session: Session,
    store: Store,
    site: Site,
    campaign: OpenCampaign,
    test: TestPlan,
    tick: Tick,
    clock: Clock,
) -> int:
    """One test as one run; whatever ends it early is written into the run before it is raised again."""
    doc = await _start_doc(session, site, campaign, test, clock)
    run_id = await store.write(store.start_run, campaign.id, test.label, test.test, test.role, doc)
    status, reason, end = "aborted", "stopped", dict[str, Any]()
    gaps: list[dict[str, int]] = []
    try:
        async with recording(store, run_id) as recorder:
            gaps = recorder.gaps
            end = dict(await Runner(session).run(test, recorder, tick))
        if "mounted_us" in end:
            campaign.mounted_us[test.setup["setup_id"]] = end["mounted_us"]
        status, reason = "complete", ""
    except (AbbeError, DriverError) as error:
        status, reason = "failed", f"{error.code}: {error}"
        raise
    except Exception as error:
        status, reason = "failed", repr(error)  # a defect: what it was must not get lost behind "stopped"
        raise
    except BaseException as error:
        reason = "; ".join(["stopped", *warnings_of(error)])
        raise
    finally:
        end |= {"gaps": gaps, "ended_utc": clock.utc().isoformat()}
        await run_to_end(store.write(store.finish_run, run_id, status, reason, end))
    return run_id


async def _start_doc(session: Session, site: Site, campaign: OpenCampaign, test: TestPlan, clock: Clock) -> dict[str, Any]:
    """What is known before the first step. A test that mounts is taken to mount now; the end document knows better (`mounted_us`)."""
    status = await session.controller.status()
    comp = await session.controller.comp_status()
    ctrl0_us, set_us = campaign.ctrl0_us, status.ctrl_us
    if not test.mounts:
        set_us = campaign.mounted_us.get(test.setup["setup_id"], set_us)
    doc: dict[str, Any] = {
        "setup": test.setup | {"t_set_s": (set_us - ctrl0_us) * 1e-6},
        "machine": site.doc,
        "ctrl0_us": ctrl0_us,
        "table": {"bank": comp.active_bank, "crc": comp.bank_crc[comp.active_bank], "gen": comp.gen},
        "clock": {"utc": clock.utc().isoformat(), "host_s": clock.monotonic_s(), "ctrl_us": status.ctrl_us},
        "versions": {"abbe": version("abbe"), "python": platform.python_version()},
    }
    for step in test.steps:
        if isinstance(step, RecordPath):
            doc["path"] = {"feed_mm_min": step.feed_mm_min, "direction": step.direction, "points_mm": [list(p) for p in step.points_mm]}
            doc["rate_hz"] = step.rate_hz
    return doc
