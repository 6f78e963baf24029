"""Measures a campaign: every test becomes a run in the store, complete or visibly incomplete."""

from __future__ import annotations

import asyncio
import platform
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import version
from typing import Any

from abbe.drivers.api import only_listens, resolution_mm
from abbe.drivers.errors import DriverError, run_to_end
from abbe.service.campaigns.campaign_run import (
    BarBreaks,
    CampaignRun,
    Confirm,
    Resumed,
    bar_ready,
    decline,
    in_mounting,
    items,
    plan_hash,
    read_path,
)
from abbe.service.campaigns.device_checks import check_devices
from abbe.service.capture.live import LiveFeed
from abbe.service.capture.machine_reading import LatestReading
from abbe.service.capture.recorder import CaptureRecorder, close_run, recording
from abbe.service.clock import Clock, SystemClock
from abbe.service.devices.session import Session, notes_since
from abbe.service.domain.measured import DISK_FULL, RunStart, RunTable, this_process
from abbe.service.domain.progress import Progress, ProgressSink, ignore_progress
from abbe.service.errors import AbbeError, Aborted, ConfigError, DiskFull, RunInterrupted, Stopped, StoreError
from abbe.service.sequences.check import dry_run_campaign, step_seconds
from abbe.service.sequences.control import Control, ExpectedTable, State
from abbe.service.sequences.journal import BEGUN, ENDED, RUN, Journal, NoJournal, StoreJournal
from abbe.service.sequences.paths import warnings_of
from abbe.service.sequences.recipes.campaigns import RecipeSource
from abbe.service.sequences.resume_plan import Attempt, PathRemainder
from abbe.service.sequences.runner import Runner, Tick
from abbe.service.sequences.steps import CampaignPlan, MoveTo, ReadBar, ReadLaser, RecordPath, TestPlan, TouchFeature
from abbe.service.sequences.watch import IncidentNotes, incidents_noted, run_named
from abbe.service.site import Site
from abbe.service.storage.store import Store

WAITING = (State.PAUSED, State.SUSPENDED)


@dataclass
class ProgressReporter:
    """Progress of a job in planned machine seconds. The ETA follows first from the dry run, then from the pace so far.

    Time spent waiting for a person (``waited_s``) is left out.
    """

    stage: str
    total_s: float
    sink: ProgressSink
    clock: Clock
    done_s: float = 0.0
    start_s: float = field(default=0.0)
    waited_s: float = 0.0
    skipped_s: float = 0.0
    control: Control | None = None
    message: str = ""
    _at_s: float = 0.0
    _waits_since_s: float | None = None

    def __post_init__(self) -> None:
        """Start the stopwatch."""
        self.start_s = self.clock.monotonic_s()

    def at(self, done_s: float, message: str, waited_s: float = 0.0) -> None:
        """Report the progress, and how long the last step waited for a person."""
        self.waited_s += waited_s
        self.message, self._at_s = message, done_s
        self._report(self._eta_s(done_s))

    async def report_states(self) -> None:
        """Report begin and end of every pause and suspension; the ETA leaves their time out."""
        if self.control is None:
            return
        async for now in self.control.watch():
            if now.state in WAITING:
                self.start_wait()
                self._report(None)
            else:
                self.end_wait()

    def start_wait(self) -> None:
        """Start to count waiting time."""
        if self._waits_since_s is None:
            self._waits_since_s = self.clock.monotonic_s()

    def end_wait(self) -> None:
        """Stop counting waiting time."""
        if self._waits_since_s is not None:
            self.waited_s += self.clock.monotonic_s() - self._waits_since_s
            self._waits_since_s = None

    def skip(self, duration_s: float) -> None:
        """Count as done a test that was complete before this job began; its planned time does not enter the pace that gives the ETA."""
        self.done_s += duration_s
        self.skipped_s += duration_s

    def _eta_s(self, done_s: float) -> float:
        elapsed, made_s = self.clock.monotonic_s() - self.start_s - self.waited_s, done_s - self.skipped_s
        # Before much is done, the times of the dry run are all there is.
        return (elapsed / made_s if made_s > 0.02 * self.total_s else 1.0) * (self.total_s - done_s)

    def _report(self, eta_s: float | None) -> None:
        now = self.control.progress if self.control is not None else Progress()
        self.sink(replace(now, stage=self.stage, done=self._at_s, total=self.total_s, eta_s=eta_s, message=self.message))


RUN_STATUS: dict[type[Exception], str] = {Stopped: "stopped", Aborted: "aborted", RunInterrupted: "aborted"}
"""Status of a run that a person ended, or that resumes later; all other errors close it as failed."""


LAST_LINE_S = 10.0


@dataclass(frozen=True, slots=True)
class AttemptContext:
    """Runner, attempt, journal and live view for one run of a test."""

    runner: Runner
    attempt: Attempt
    journal: Journal
    live: LiveFeed | None = None


@dataclass
class OpenCampaign:
    """A campaign under measurement: number in the store, clock zero and time of each mounting (controller time, us)."""

    id: int
    ctrl0_us: int
    mounted_us: dict[str, int] = field(default_factory=dict)


async def start_campaign(session: Session, store: Store, site: Site, name: str, more: dict[str, Any] | None = None) -> tuple[int, int]:
    """Add a campaign to the store; return its number and clock zero (controller time, us). ``more``: further fields of its document."""
    machine_id = await store.write(store.machines.add, site.name, site.doc)
    status = await session.controller.status()
    laser_mm = 1e-7 if session.laser is None else resolution_mm(session.laser)
    table = await _table_in_force(session)
    doc = {
        "ctrl0_us": status.ctrl_us,
        **({} if table is None else {"active_bank": table.bank, "table_crc": table.crc, "boot_id": table.boot_id}),
        "current_model": {"includes": ["rigid21", "setup_centre_offset", "bar_length_error", "mirror_tilt"], "errors": None},
        "instruments": {"ballbar": {"resolution_mm": 1e-6}, "laser": {"resolution_mm": laser_mm}},
        "temperature_sensors": False,
    } | (more or {})
    return await store.write(store.campaigns.add, machine_id, name, doc), status.ctrl_us


def artefacts_of(plan: CampaignPlan) -> dict[str, Any]:
    """Return the artefacts that a plan probes, as a field of the campaign's document; an empty object if it probes none."""
    known = {name: doc for test in plan.tests for name, doc in test.artefact.items()}
    return {"artefacts": known} if known else {}


async def _table_in_force(session: Session) -> RunTable | None:
    """Return the compensation table in force; None if the control does not show it."""
    if only_listens(session.controller):
        return None
    comp = await session.controller.comp_status()
    crc = comp.bank_crc[comp.active_bank]
    return RunTable.from_document({"bank": comp.active_bank, "crc": crc, "gen": comp.gen, "boot_id": comp.boot_id})


@dataclass(frozen=True, slots=True)
class MeasureOptions:
    """Options of a measurement.

    ``control``: pauses, stops or aborts it. ``confirm``: asks a person whether a set-up is untouched. ``source``: where the plan comes
    from, for `abbe measure --resume`. ``resumed``: where an interrupted campaign resumes. ``part``: whether the job of
    ``control`` continues after this measurement. ``live``: receives the readings of paths.
    """

    control: Control | None = None
    confirm: Confirm = decline
    source: RecipeSource | None = None
    resumed: Resumed | None = None
    part: bool = False
    live: LiveFeed | None = None


async def measure(  # noqa: PLR0913 - what to measure, with what, and how
    session: Session,
    store: Store,
    site: Site,
    plan: CampaignPlan,
    *,
    progress: ProgressSink = ignore_progress,
    clock: Clock | None = None,
    campaign: tuple[int, int] | None = None,
    options: MeasureOptions | None = None,
) -> list[int]:
    """Run all tests of a plan; return the numbers of their complete runs in the store.

    ``campaign``: result of `start_campaign`; default: a new campaign with the plan's name.

    Raises
    ------
    StrokeError, ConfigError, DevicesNotReady, DriverError
        Before anything moves: the plan does not fit the machine, or a needed device is missing, silent or wrong.
    Interlock, MeasurementFault, DriverError
        The current run is closed as failed, with the reason; earlier runs stay.
    Stopped, Aborted
        A person requested it; the current run is closed as stopped or aborted.
    """
    clock, options = clock or SystemClock(), options or MeasureOptions()
    control, resumed = options.control or Control(), options.resumed
    dry = dry_run_campaign(site.machine, plan, site.max_feed_mm_min)
    if only_listens(session.controller):
        raise ConfigError("Abbe can only read this control, not move its axes", "start an NC program there, and use `abbe listen`")
    await check_devices(session, plan, air=site.watching.air_c is not None)
    if resumed is not None:
        campaign = resumed.campaign
    campaign = campaign or await start_campaign(session, store, site, plan.name, artefacts_of(plan))
    under_way = OpenCampaign(*campaign, dict(resumed.mounted_us) if resumed is not None else {})
    journal = StoreJournal(store, under_way.id)
    campaign_run = await _campaign_run(session, store, site, plan, journal, options, control)
    reporter = ProgressReporter(plan.name, sum(d.duration_s for d in dry), progress, clock, control=control)
    control.now(State.RUNNING)
    reporter.at(0.0, "")
    notes, reporting = IncidentNotes(journal, clock), asyncio.create_task(reporter.report_states())
    once = _once(session, store, site, under_way, reporter, options.live)
    try:
        shown = nullcontext() if options.live is None else options.live.showing(LatestReading(session, clock))
        async with incidents_noted(session, notes):
            with shown:
                run_ids = await _all_tests(plan, [d.duration_s for d in dry], campaign_run, reporter, resumed, once)
    except BaseException as error:
        await _ended(journal, notes, "stopped" if isinstance(error, Stopped) else "failed", error)
        raise
    else:
        await _ended(journal, notes, "complete", None)
    finally:
        control.now(State.RUNNING if options.part else State.ENDED)
        reporting.cancel()
    return run_ids


async def _ended(journal: StoreJournal, notes: IncidentNotes, how: str, error: BaseException | None) -> None:
    """Write the journal's last line. A failure of the database must not hide why the measurement ended."""
    journal.longest_s = min(journal.longest_s, LAST_LINE_S)
    try:
        left_out = {"incidents_not_written": notes.not_written} if notes.not_written else {}
        await run_to_end(journal.add(ENDED, how=how, **left_out))
    except StoreError as lost:
        if error is None:
            raise
        error.add_note(f"and the journal's last line could not be written: {lost}")


async def _campaign_run(
    session: Session, store: Store, site: Site, plan: CampaignPlan, journal: StoreJournal, options: MeasureOptions, control: Control
) -> CampaignRun:
    """Write the journal's first line and return the context of the campaign."""
    comp = await session.controller.comp_status()
    expected = ExpectedTable(comp.boot_id, comp.bank_crc[comp.active_bank])
    if options.resumed is not None and options.resumed.expected is not None:
        expected = options.resumed.expected  # the table may have changed since the check, while a question was open
    source = {} if options.source is None else asdict(options.source)
    await journal.add(
        BEGUN,
        plan=plan_hash(plan),
        source=source,
        boot_id=expected.boot_id,
        table_crc=expected.table_crc,
        owner=asdict(this_process()),
    )
    campaign_run = CampaignRun(session, control, site.watching, journal, expected, options.confirm)
    campaign_run.read_path = lambda test, mounting: read_path(session, store, journal.campaign, test, mounting)
    if options.resumed is not None:
        campaign_run.mountings = dict(options.resumed.mountings)
        campaign_run.used = set(options.resumed.used)
        campaign_run.labels = {run.label for run in await asyncio.to_thread(store.runs.all, journal.campaign)}
    return campaign_run


def planned_seconds(test: TestPlan) -> float:
    """Return the planned machine time of a test, s."""
    seconds, here = 0.0, None
    for step in test.steps:
        if not (isinstance(step, MoveTo) and here == step.target_mm):
            one, here = step_seconds(step, here)
            seconds += one
    return seconds


Once = Callable[[TestPlan, Attempt, Runner], Awaitable[int]]


async def _all_tests(
    plan: CampaignPlan,
    seconds: list[float],
    campaign_run: CampaignRun,
    reporter: ProgressReporter,
    resumed: Resumed | None,
    once: Callable[[TestPlan, float], Once],
) -> list[int]:
    """Run every test without a complete run, in the plan's order."""
    run_ids: list[int] = []
    done, start = (resumed.done, resumed.start) if resumed is not None else ({}, {})
    for item, duration_s in zip(items(plan), seconds, strict=True):
        label, base_s = item.test.label, reporter.done_s
        if label in done:
            run_ids.append(done[label])
            reporter.skip(duration_s)
        else:
            item = start.get(label) or in_mounting(item, campaign_run.mountings.get(item.setup, 1))
            run_ids.append(await campaign_run.complete(item, once(item.test, base_s)))
            reporter.done_s = base_s + duration_s
        reporter.at(reporter.done_s, label)
    return run_ids


def _once(
    session: Session, store: Store, site: Site, under_way: OpenCampaign, reporter: ProgressReporter, live: LiveFeed | None
) -> Callable[[TestPlan, float], Once]:
    """Return a function that makes, for a test, the function that runs one attempt at it as one run."""

    def of(test: TestPlan, base_s: float) -> Once:
        breaks = BarBreaks(session, reporter.control or Control(), site.watching.suspending)

        async def once(left: TestPlan, attempt: Attempt, runner: Runner) -> int:
            before_s = max(planned_seconds(test) - planned_seconds(left), 0.0)  # done by earlier attempts

            def tick(seconds: float, waited_s: float) -> None:
                reporter.at(base_s + before_s + seconds, test.label, waited_s)

            context = AttemptContext(runner, attempt, runner.journal, live)
            try:
                return await measure_test(session, store, site, under_way, left, tick, reporter.clock, context)
            except DriverError as error:
                await breaks.wait(error, runner, runner.journal)
                raise

        return once

    return of


async def measure_test(  # noqa: PLR0913 - a test, its devices, its destination, and its context
    session: Session,
    store: Store,
    site: Site,
    campaign: OpenCampaign,
    test: TestPlan,
    tick: Tick,
    clock: Clock,
    context: AttemptContext | None = None,
) -> int:
    """Measure one test as one run; if it ends early, store the reason in the run before raising the error."""
    context = context or AttemptContext(Runner(session), Attempt(), NoJournal())
    runner, attempt, journal = context.runner, context.attempt, context.journal
    doc = await start_document(session, site, campaign, test, clock, attempt.remainder) | _standstills(test, attempt)
    run_id = await store.write(store.runs.start, campaign.id, test.label, test.test, test.role, doc)
    status, reason, end = "aborted", "stopped", dict[str, Any]()
    recorder: CaptureRecorder | None = None
    about = {"label": test.label, "test": test.test, "machine": site.name}
    try:
        async with recording(store, run_id, site.capture, clock, about) as recorder:
            await journal.add(RUN, test=attempt.test, run=run_id, label=test.label, setup=attempt.setup, mounting=attempt.mounting)
            with run_named(session, f"run {run_id} {test.label}"):
                await bar_ready(session, test)
                with live_view(context.live, test, recorder):
                    end = dict(await runner.run(test, recorder, tick, replace(attempt, run_id=run_id)))
        status, reason = "complete", ""
    except DiskFull as error:
        status, reason = DISK_FULL, f"{error.code}: {error}"
        raise
    except (AbbeError, DriverError) as error:
        status, reason = RUN_STATUS.get(type(error), "failed"), f"{error.code}: {error}"
        raise
    except Exception as error:
        status, reason = "failed", repr(error)  # a defect: keep its text instead of "stopped"
        raise
    except BaseException as error:
        reason = "; ".join(["stopped", *warnings_of(error)])
        raise
    finally:
        mounted_us = end.get("mounted_us", runner.mounted_us)
        if mounted_us is not None:
            campaign.mounted_us[test.setup_id] = mounted_us
            end |= {"mounted_us": mounted_us}
        begun_us = RunStart.from_document(doc).clock_us
        end |= {"ended_utc": clock.utc().isoformat(), "clock_pairs": notes_since(session.controller, begun_us or 0)}
        end |= {} if recorder is None else recorder.doc()
        end |= {} if runner.way is None or status == "complete" else runner.way.doc()
        await run_to_end(close_run(store, run_id, recorder, status, reason, end))
    return run_id


@contextmanager
def live_view(live: LiveFeed | None, test: TestPlan, recorder: CaptureRecorder) -> Iterator[None]:
    """Feed live views with the readings of the test's path, beside the recording."""
    path = next((step for step in test.steps if isinstance(step, RecordPath)), None)
    if live is None or path is None:
        yield
        return
    live.begin(test.label, test.test, test.bar, (path.points_mm, path.feed_mm_min, path.rate_hz))
    recorder.look = live.take
    try:
        yield
    finally:
        live.end()


async def start_document(
    session: Session, site: Site, campaign: OpenCampaign, test: TestPlan, clock: Clock, remainder: PathRemainder | None = None
) -> dict[str, Any]:
    """Return the start document of a run. Its mounting time is preliminary for a test that mounts; the end document has `mounted_us`."""
    status = await session.controller.status()
    table = await _table_in_force(session)
    ctrl0_us, set_us = campaign.ctrl0_us, status.ctrl_us
    if not test.mounts:
        set_us = campaign.mounted_us.get(test.setup_id, set_us)
    doc: dict[str, Any] = {
        "setup": test.setup.mounted((set_us - ctrl0_us) * 1e-6).document,
        "machine": site.doc,
        "ctrl0_us": ctrl0_us,
        **({} if table is None else {"table": table.document | {"acting": status.compensation_on}}),
        "clock": {"utc": clock.utc().isoformat(), "host_s": clock.monotonic_s(), "ctrl_us": status.ctrl_us},
        "versions": {"abbe": version("abbe"), "python": platform.python_version()},
    }
    step = next((step for step in test.steps if isinstance(step, RecordPath)), None)
    if step is None:
        return doc
    path = {"feed_mm_min": step.feed_mm_min, "direction": step.direction, "points_mm": [list(p) for p in step.points_mm]}
    path |= {} if step.measured is None else {"measured": list(step.measured)}
    return doc | {"path": path | ({} if remainder is None else remainder.doc()), "rate_hz": step.rate_hz}


def _standstills(test: TestPlan, attempt: Attempt) -> dict[str, int]:
    """Return the number of standstill readings in a whole run: one per reading step, and those kept from before an interruption.

    A kept reading that is read again counts once. The qualification sphere is not counted.
    """
    count = sum(isinstance(s, ReadLaser | ReadBar) or (isinstance(s, TouchFeature) and not s.qualifies) for s in test.steps)
    trail = attempt.resume_trail
    return {"standstills": count + (trail.n_features if trail.again else max(0, len(trail.carried) - 1))} if count else {}
