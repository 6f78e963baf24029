"""Pause and resume, stop, abort at every step of every kind of recipe: the exact sequence of commands is compared, and what is kept.

One case is a whole measurement of one small recipe with a real database, on simulators in this process.
"""

from __future__ import annotations

import asyncio
import os
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from abbe.service.campaigns.measure import MeasureOptions, measure
from abbe.service.errors import Aborted, DoorOpen, Stopped
from abbe.service.sequences.control import Control, State
from abbe.service.sequences.steps import CampaignPlan, FollowPath, ReadBar, RecordPath, TestPlan
from abbe.service.storage.store import Store
from abbe.simulators.cnc.log import Command
from tests.faults.sequencer_world import AtStep, Bench, bench, kinds, small, step_numbers
from tests.patience import within

LONG = os.environ.get("ABBE_TEST_LONG") == "1"
SPEED = 200.0
ENDING = ("abort", "run")
"""What an abort looks like on the wire: stop, and the hold taken back once all stands."""
Line = tuple[str, tuple[int, ...]]
FREED: tuple[Line, ...] = (("abort", ()), ("run", ()))
"""What a measurement begins with: a hold that a killed process may have left is taken back."""


def commands(log: list[Command]) -> list[Line]:
    return [(c.kind, c.args) for c in log]


def without_stops(lines: list[Line]) -> list[Line]:
    """Commands that move something."""
    return [one for one in lines if one[0] not in ("run", "hold", "abort")]


@dataclass(frozen=True)
class Case:
    kind: str
    step: int
    name: str


def cases() -> Iterator[Case]:
    """Every step; in short, every kind of step in one recipe of each instrument, the second of its kind where there is one."""
    seen = Counter[tuple[str, bool]]()
    for kind in kinds():
        plan = small(kind)
        numbers = {n: type(plan.steps[n - 1]).__name__ for n in step_numbers(plan)}
        for n, name in numbers.items():
            alike = [k for k, other in numbers.items() if other == name]
            with_bar = any(isinstance(s, RecordPath | ReadBar) for s in plan.steps)
            if LONG or (n == alike[min(1, len(alike) - 1)] and not seen[name, with_bar]):
                seen[name, with_bar] += 1
                yield Case(kind, n, name)


@pytest.fixture(scope="module")
def undisturbed() -> dict[str, list[Line]]:
    """What a recipe commands when nobody disturbs it, by kind; filled on demand."""
    return {}


@pytest.fixture
async def place(tmp_path: Path):
    async with bench(tmp_path) as b:
        with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as store:
            yield b, store


async def run(b: Bench, store: Store, plan: TestPlan, control: Control) -> tuple[list[Line], BaseException | None]:
    """Measure one test; its commands, and how it ended."""
    b.sim.make_ready()
    b.sim.pace(SPEED)
    start = len(b.sim.registers.log)
    error: BaseException | None = None
    name = f"c{len(store.campaigns.all())}"
    try:
        async with asyncio.timeout(within(30)):
            await measure(b.session, store, b.site, CampaignPlan(name, (plan,)), options=MeasureOptions(control))
    except (Stopped, Aborted) as ended:
        error = ended
    lines = commands(b.sim.registers.log[start:])
    assert lines[:2] == list(FREED)
    return lines[2:], error


async def expected(b: Bench, store: Store, known: dict[str, list[Line]], kind: str) -> list[Line]:
    if kind not in known:
        await run(b, store, small(kind), Control())  # so that every run begins where the one before has ended
        known[kind], error = await run(b, store, small(kind), Control())
        assert error is None
    return known[kind]


def held_on_path(plan: TestPlan, number: int) -> bool:
    return isinstance(plan.steps[number - 1], RecordPath | FollowPath)


async def paused_at(b: Bench, control: Control) -> list[Line]:
    """Wait for the pause; give what is commanded while it lasts, which is nothing, and go on."""
    async for now in control.watch():
        if now.state == State.PAUSED:
            break
        assert now.state != State.ENDED, "it never paused"
    controller, at = b.sim.world.controller, len(b.sim.registers.log)
    assert not controller.moving
    where = controller.position_mm.copy()
    looks, asked = b.session.controller.status, 0
    while asked < 5:  # each waits its turn on the wire behind whoever else is asking
        await looks()
        asked += 1
        await asyncio.sleep(0.02)
    assert (controller.position_mm == where).all()
    while_paused = commands(b.sim.registers.log[at:])
    b.sim.pace(SPEED)
    control.resume()
    return while_paused


def acting(b: Bench, step: int, how: Callable[[Control], None], *, moving: bool) -> AtStep:
    """Asks for something when a step is reached; ``moving``: not before the axes move in it."""

    def when() -> None:
        if not moving or b.sim.world.controller.moving:
            how(control)
        elif control.state != State.ENDED:
            asyncio.get_running_loop().call_later(0.001, when)

    def reached() -> None:
        b.sim.pace(2.0 if moving else SPEED)
        when()

    control = AtStep(step, reached)
    return control


@pytest.mark.timeout(1800 if LONG else 150)
async def test_pause_and_resume_at_every_step(place, undisturbed):
    """Between points the same commands come as without the pause, and an artefact's first feature is touched again; a path is held, given
    up, and measured again after the way back.
    """
    b, store = place
    tried = 0
    for case in cases():
        plan = small(case.kind)
        plain = await expected(b, store, undisturbed, case.kind)
        on_path = held_on_path(plan, case.step)
        control = acting(b, case.step, Control.pause, moving=on_path)
        task = asyncio.create_task(run(b, store, plan, control))
        during = await paused_at(b, control)
        lines, error = await task
        assert (during, error) == ([], None), case
        runs = [(r.label, r.status) for r in store.runs.all(store.campaigns.all()[-1].id)]
        if on_path:
            assert runs == [("test", "aborted"), ("test-2", "complete")], case
            _held_and_again(lines, plain, case)
        else:
            assert _without_first_feature_again(lines, plain) == plain, case
            assert runs == [("test", "complete")], case
        tried += 1
    assert tried >= 10


def _without_first_feature_again(lines: list[Line], plain: list[Line]) -> list[Line]:
    """The commands without those that touch the first feature again, which have to be the first touches of all."""
    more = len(lines) - len(plain)
    at = next((k for k, (one, as_ever) in enumerate(zip(lines, plain, strict=False)) if one != as_ever), len(plain))
    between = [one for one in lines[at : at + more] if one[0] == "touch"]
    assert sorted(between) == sorted([one for one in plain if one[0] == "touch"][: len(between)])
    return lines[:at] + lines[at + more :]


def _held_and_again(lines: list[Line], plain: list[Line], case: Case) -> None:
    """Up to the path as ever; hold, abort; back along the path; then everything from the path's approach on again."""
    held = next(k for k, one in enumerate(lines) if one[0] == "hold")
    assert lines[:held] == plain[:held], case
    assert [one[0] for one in lines[held:]][:3] == ["hold", "abort", "run"], case
    back, tail = without_stops(lines[held:]), without_stops(plain)
    path = next(k for k, one in enumerate(tail) if one[0] != "move")  # a mounting leaves no command; the path is what is done again
    by_way = [one[0] for one in tail].count("path_start") > 1  # the way back ends at the pole, where the way to the path begins
    again = tail[path if by_way else path - 1 :]
    assert back[-len(again) :] == again, case
    assert back[: -len(again)], case  # the way back


@pytest.mark.timeout(1800 if LONG else 150)
async def test_stop_and_abort_at_every_step(place, undisturbed):
    """What was commanded is the beginning of the undisturbed sequence, then the stop, then nothing."""
    b, store = place
    for case in cases():
        plan = small(case.kind)
        plain = await expected(b, store, undisturbed, case.kind)
        for how, status in ((Control.stop, "stopped"), (Control.abort, "aborted")):
            control = acting(b, case.step, how, moving=held_on_path(plan, case.step))
            lines, error = await run(b, store, plan, control)
            (record,) = store.runs.all(store.campaigns.all()[-1].id)
            if error is None:  # asked for when the last step was as good as done
                assert case.name == "Unmount", case
                assert lines == plain
                continue
            assert isinstance(error, Stopped if status == "stopped" else Aborted), (case, error)
            assert record.status == status, case
            moved = without_stops(lines)
            assert moved == without_stops(plain)[: len(moved)], case
            stops = [one[0] for one in lines[next(k for k, one in enumerate(lines) if one[0] in ("hold", "abort")) :]]
            assert set(stops) <= {"hold", "abort", "run"}, case
            assert stops[-2:] == list(ENDING), case
            assert not b.sim.world.controller.moving
            assert control.state == State.ENDED


async def test_a_point_in_hand_is_finished_before_a_stop(place):
    b, store = place
    plan = small("Linear")
    move = [n for n in step_numbers(plan) if type(plan.steps[n - 1]).__name__ == "MoveTo"][-2]
    control = acting(b, move, Control.stop, moving=True)
    _, error = await run(b, store, plan, control)
    assert isinstance(error, Stopped)
    points = [c for c in store.checkpoints.of_campaign(store.campaigns.all()[-1].id) if c.kind == "point"]
    assert points[-1].doc["step"] == move  # the reading after the move (steps there count from 0)


async def test_a_path_that_was_interrupted_never_enters_the_solution(place):
    from abbe.service.campaign_data.campaign_folder import from_store

    b, store = place
    plan = replace(small("Helix"), label="helix")
    number = next(k + 1 for k, s in enumerate(plan.steps) if isinstance(s, RecordPath))
    control = acting(b, number, Control.pause, moving=True)
    task = asyncio.create_task(run(b, store, plan, control))
    await paused_at(b, control)
    await task
    record = store.campaigns.all()[-1]
    evidence, again = store.runs.all(record.id)
    assert store.chunks.of_run(evidence.id)  # kept
    assert evidence.reason.startswith("SEQ-006: paused on the path")
    used = from_store(store, record.name).runs
    assert [r.run_id for r in used] == ["helix-2"]
    assert again.status == "complete"


async def test_what_is_not_safe_keeps_the_pause(place):
    b, store = place
    plan = small("Linear")
    control = acting(b, 7, Control.pause, moving=False)
    task = asyncio.create_task(run(b, store, plan, control))
    seen: list[tuple[State, str]] = []
    async for now in control.watch():
        seen.append((now.state, now.why))
        if now.state == State.PAUSED and now.why == "paused as asked":
            b.sim.world.controller.set_door(is_open=True)
            control.resume()
        elif now.state == State.PAUSED:
            assert now.why == "cannot resume: the door is open"
            b.sim.world.controller.set_door(is_open=False)
            control.resume()
    _, error = await task
    assert error is None
    assert (State.PAUSED, "cannot resume: the door is open") in seen


async def test_where_nobody_may_pause_a_pause_does_not_go_on(place):
    """A table that nobody has verified is in force: what would wait for a closed door would move by itself when it is closed."""
    b, store = place
    control = acting(b, 7, Control.pause, moving=False)
    task = asyncio.create_task(run(b, store, small("Linear"), control))
    async for now in control.watch():
        if now.state == State.PAUSED:
            b.sim.world.controller.set_door(is_open=True)
            control.no_pause_reason = "not now"
            control.resume()
            break
    with pytest.raises(DoorOpen):
        await task
    b.sim.world.controller.set_door(is_open=False)
    assert not b.sim.world.controller.moving
    assert store.runs.all(store.campaigns.all()[-1].id)[-1].status == "failed"
