"""The runner on devices that misbehave: what stops first, and what a person is told when the stop does not get through."""

import asyncio
from contextlib import asynccontextmanager
from types import SimpleNamespace

import pytest

from abbe.drivers.api import BarBatch, BarSample, Condition
from abbe.drivers.errors import LinkDown, ReplyTimeout
from abbe.service.campaigns.measure import OpenCampaign, ProgressReporter, measure_test
from abbe.service.devices.session import Session
from abbe.service.domain.run import parsed_setup
from abbe.service.errors import MeasurementFault
from abbe.service.sequences.paths import UNDELIVERED, motion_interlock, warnings_of
from abbe.service.sequences.runner import Runner
from abbe.service.sequences.steps import MountBar, MountLaser, RecordPath, TestPlan, Unmount
from tests.pretended_status import READY, controller_status
from tests.run_documents import BAR

RUNS_ON = RecordPath(((0.0, 0.0, 0.0), (1.0, 0.0, 0.0)), 100.0, 100, 1)
CUP = parsed_setup("ballbar_helix", BAR)
PLAN = TestPlan("h", "ballbar_helix", "identify", CUP.named("H"), (RUNS_ON, Unmount()))


class FakeController:
    """A path that runs for ever. ``events`` is what happened in which order."""

    def __init__(self, events: list[str], *, deaf: bool = False) -> None:
        self.events, self.deaf = events, deaf

    async def status(self):
        return controller_status(
            READY | Condition.PATH_RUNNING,
            path_points_done=0,
            path_start_us=5,
            path_end_us=0,
            ctrl_us=7,
            position_mm=RUNS_ON.points_mm[0],
        )

    async def comp_status(self):
        return SimpleNamespace(active_bank=0, bank_crc=(1, 2), gen=3, boot_id=7)

    async def load_path(self, points_mm):
        self.events.append("loaded")

    async def start_path(self, *, feed_mm_min):
        self.events.append("started")

    async def abort(self):
        if self.deaf:
            raise LinkDown("cnc", "write", "the connection was closed")
        self.events.append("stopped")


class MuteBar:
    """A box that says nothing any more; closing its stream is an event of its own."""

    name = "bar"

    def __init__(self, events: list[str]) -> None:
        self.events = events

    async def make_ready(self, *, within_s):
        self.events.append("asked who it is")

    @asynccontextmanager
    async def stream(self, rate_hz, tap=None):
        async def batches():
            yield BarBatch(0.0, (BarSample(0, 0, 0, 0),))
            while "started" not in self.events:  # noqa: ASYNC110 - what happened is a plain list
                await asyncio.sleep(0)
            raise ReplyTimeout("bar", "read samples", "no sample for 1 s", "box switched off?")

        try:
            yield batches()
        finally:
            self.events.append("stream closed")


class FakeRecorder:
    """Keeps nothing."""

    def tap(self):
        return None

    async def add_bar(self, batch):
        pass

    def doc(self):
        return {"gaps": []}

    def release(self) -> None:
        """Nothing is held."""

    def discard(self):
        pass

    behind = False


@pytest.fixture(autouse=True)
def nothing_is_recorded(monkeypatch):
    """Where samples go is tested elsewhere."""

    @asynccontextmanager
    async def recording(*_):
        yield FakeRecorder()

    monkeypatch.setattr("abbe.service.campaigns.measure.recording", recording)


SITE = SimpleNamespace(doc={}, name="m", capture=None)


class Fixture:
    def __init__(self, events: list[str]) -> None:
        self.events = events

    async def mount_ballbar(self, radius_mm):
        self.events.append("mounted")

    async def unmount(self):
        self.events.append("unmounted")


def session(events: list[str], *, deaf: bool = False) -> Session:
    return Session(FakeController(events, deaf=deaf), MuteBar(events), None, Fixture(events))


async def test_the_axes_stop_before_the_mute_box_is_talked_to_and_nothing_is_asked():
    events: list[str] = []
    with pytest.raises(ReplyTimeout) as caught:
        await Runner(session(events)).run(PLAN, FakeRecorder(), lambda *_: None)
    assert events[:4] == ["loaded", "started", "stopped", "stream closed"]
    assert "unmounted" not in events
    assert UNDELIVERED not in str(caught.value)


async def test_a_stop_that_does_not_get_through_is_part_of_the_error():
    with pytest.raises(ReplyTimeout) as caught:
        await Runner(session([], deaf=True)).run(PLAN, FakeRecorder(), lambda *_: None)
    assert str(caught.value) == f"bar: read samples: no sample for 1 s; {UNDELIVERED} (box switched off?)"


async def test_errors_of_the_job_keep_kind_and_remedy_when_the_stop_fails():
    with pytest.raises(MeasurementFault) as caught:
        async with motion_interlock(FakeController([], deaf=True)):
            raise MeasurementFault("feed hold was pressed", "start again")
    assert (caught.value.detail, caught.value.remedy) == (f"feed hold was pressed; {UNDELIVERED}", "start again")


async def test_a_cancelled_job_whose_stop_fails_stays_cancelled_and_says_so():
    entered = asyncio.Event()

    async def job() -> None:
        async with motion_interlock(FakeController([], deaf=True)):
            entered.set()
            await asyncio.Event().wait()

    task = asyncio.create_task(job())
    await entered.wait()
    task.cancel()
    with pytest.raises(asyncio.CancelledError) as caught:
        await task
    assert warnings_of(caught.value) == [UNDELIVERED]


class Clock:
    def __init__(self) -> None:
        self.now_s = 0.0

    def monotonic_s(self) -> float:
        return self.now_s


def test_the_time_a_person_takes_does_not_spoil_the_eta():
    clock, seen = Clock(), []
    meter = ProgressReporter("job", 100.0, seen.append, clock)
    clock.now_s = 300.0
    meter.at(0.0, "mounted", waited_s=300.0)
    clock.now_s = 310.0
    meter.at(10.0, "moved")
    assert seen[-1].eta_s == pytest.approx(90.0)


async def test_only_steps_done_by_hand_count_as_waiting():
    ticks: list[tuple[float, float]] = []
    plan = TestPlan("m", "ballbar_helix", "identify", CUP, (MountBar(150.0), Unmount()))
    events: list[str] = []
    await Runner(session(events)).run(plan, None, lambda done, waited: ticks.append((done, waited)))
    assert events == ["mounted", "unmounted"]
    assert [done for done, _ in ticks] == [0.0, 0.0]
    assert all(waited > 0 for _, waited in ticks)


class FakeStore:
    """Remembers how the run ended."""

    def __init__(self) -> None:
        self.ended: tuple[str, str] | None = None
        self.runs, self.chunks = self, SimpleNamespace(append=None)

    async def write(self, call, *args):
        return call(*args)

    def start(self, *_):
        return 1

    def finish(self, _, status, reason, __):
        self.ended = (status, reason)


@pytest.mark.parametrize(
    ("error", "ended"),
    [
        (ValueError("a defect"), ("failed", "ValueError('a defect')")),
        (MeasurementFault("beam", "free it"), ("failed", "SEQ-003: beam - free it")),
        (asyncio.CancelledError(), ("aborted", "stopped")),
    ],
)
async def test_a_run_keeps_the_reason_why_it_ended(monkeypatch, error, ended):
    async def run(*_):
        raise error

    monkeypatch.setattr(Runner, "run", run)
    store, clock = FakeStore(), SimpleNamespace(utc=lambda: SimpleNamespace(isoformat=lambda: "now"), monotonic_s=lambda: 1.0)
    with pytest.raises(type(error)):
        await measure_test(session([]), store, SITE, OpenCampaign(1, 0), PLAN, lambda *_: None, clock)
    assert store.ended == ended


class PatientController(FakeController):
    """A clock that a person's work moves on: every status is a minute later than the last."""

    def __init__(self, events: list[str]) -> None:
        super().__init__(events)
        self.now_us = 0

    async def status(self):
        self.now_us += 60_000_000
        return controller_status(READY, ctrl_us=self.now_us)


class KeepingStore(FakeStore):
    """Keeps what was written about every run."""

    def __init__(self) -> None:
        super().__init__()
        self.starts: list[dict] = []
        self.ends: list[dict] = []

    def start(self, *args):
        self.starts.append(args[-1])
        return len(self.starts)

    def finish(self, _, status, reason, doc):
        self.ends.append(doc)


async def test_a_set_up_begins_when_it_is_mounted_and_all_its_runs_say_so():
    devices = Session(PatientController([]), MuteBar([]), None, Fixture([]))
    store = KeepingStore()
    clock = SimpleNamespace(utc=lambda: SimpleNamespace(isoformat=lambda: "now"), monotonic_s=lambda: 1.0)
    ways = [("first", (MountBar(150.0),)), ("second", ()), ("third", (Unmount(),))]
    campaign = OpenCampaign(1, 30_000_000)
    for label, steps in ways:
        plan = TestPlan(label, "ballbar_helix", "identify", CUP.named("A"), steps)
        assert plan.mounts == (label == "first")
        await measure_test(devices, store, SITE, campaign, plan, lambda *_: None, clock)
    # Asked for the start document, for somebody else's program, by the watcher, for the interlocks, and when it was done.
    assert campaign.mounted_us == {"A": 300_000_000}
    assert store.ends[0]["mounted_us"] == 300_000_000
    assert [doc["setup"]["t_set_s"] for doc in store.starts] == [30.0, 270.0, 270.0]
    assert all("mounted_us" not in end for end in store.ends[1:])
    assert TestPlan("l", "laser_linear", "identify", parsed_setup("laser_linear", {"setup_id": "L"}), (MountLaser((1.0, 0.0, 0.0)),)).mounts
