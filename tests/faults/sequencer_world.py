"""A simulated machine in this process, on real sockets and a real pty, whose speed can be changed; and small recipes of every kind.

The clock that reactions are measured with is the simulated controller's own: the instant of an event and the instants of all commands stand
in one log. While a reaction is awaited one simulated second lasts one second of wall time.
"""

from __future__ import annotations

import asyncio
import dataclasses
import random
import typing
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import numpy as np

from abbe.drivers.api import BarBatch
from abbe.models.machine import Machine
from abbe.service.devices.session import DeviceUrls, Session, open_session
from abbe.service.domain.artefact import ArtefactObject
from abbe.service.domain.machine import machine_doc
from abbe.service.sequences.check import step_seconds
from abbe.service.sequences.control import Control, State, Watching
from abbe.service.sequences.recipes import recipe as recipes
from abbe.service.sequences.recipes.recipe_file import shared_setups
from abbe.service.sequences.steps import CampaignPlan, MoveTo, RecordPath, TestPlan
from abbe.service.site import Site
from abbe.service.storage.store import Store
from abbe.simulators.cnc.log import Command
from abbe.simulators.scenario import Scenario
from abbe.simulators.site import Site as Simulated
from tests.faults.on_sphere import OnSphere

MACHINE = Machine("w-X-Y-b-Z-t", np.array([[0.0, 600.0], [0.0, 500.0], [0.0, 450.0]]), np.zeros((3, 3)), np.array([0.0, 0.0, -120.0]))
PLATE = ArtefactObject.read(
    {
        "kind": "hole_plate",
        "features": [
            {"id": f"{'ABC'[i]}{j + 1}", "nominal_mm": [75.0 * i, 75.0 * j, 0.0], "sensed": "xy", "radius_mm": 10.0}
            for j in range(2)
            for i in range(3)
        ],
    }
)
"""The first two rows of the simulated plate, three holes each."""
SMALL: dict[str, Any] = {
    "label": "test",
    "setup_id": "S",
    "role": "identify",
    "centre_mm": (300.0, 250.0, 100.0),
    "radius_mm": 30.0,
    "turns": 3.0,
    "chord_mm": 3.0,
    "points": 5,
    "positions": 5,
    "steps": 2,
    "samples": 5,
    "axis": 2,
    "plane": "XY",
    "feed_in_deg": 20.0,
    "feed_out_deg": 20.0,
    "settle_s": 0.1,
    "order": "XYZ",
}
PATIENT = Watching(unknown_s=5.0)
"""For tests that are not about silence: simulators and service share one process here, on a computer that others use."""
OWN: dict[str, dict[str, Any]] = {
    "Diagonal": {"diagonal": "ppp"},
    "FaceDiagonal": {"diagonal": "pp", "at_share": 0.5},
    "Linear": {"at_share": (0.5, 0.5)},
    "ArtefactTest": {
        "artefact": "A",
        "origin_mm": (250.0, 200.0, 200.0),
        "plate": PLATE.model_copy(update={"features": PLATE.features[:2]}),
        "feed_mm_min": 6000.0,
        "touch_feed_mm_min": 300.0,
    },
}


def kinds() -> dict[str, type[Any]]:
    """Every recipe that there is: a new one joins by itself."""
    return {kind.__name__: kind for union in typing.get_args(recipes.Recipe) for kind in (typing.get_args(union) or (union,))}


def small(kind: str, **more: Any) -> TestPlan:
    """A short test of a kind."""
    made = kinds()[kind]
    names = {f.name for f in dataclasses.fields(made)}
    words = {k: v for k, v in SMALL.items() if k in names} | OWN.get(kind, {})
    plan: TestPlan = made(**(words | more)).plan(MACHINE)
    return plan


def on_one_cup(*radii_mm: float) -> CampaignPlan:
    """Helices with bars of these lengths on one cup, the bar changed where it has to be."""
    made = tuple(
        recipes.Helix(f"r{k}", "B1", "identify", (300.0, 250.0, 100.0), r, turns=3.0, chord_mm=3.0, direction=-1 if k % 2 else 1)
        for k, r in enumerate(radii_mm)
    )
    return CampaignPlan("c", tuple(r.plan(MACHINE) for r in shared_setups(made, "test")))


LONGEST_STEP_S, NEAR_STEP_S = 2.0, 0.1


class Paced(Simulated):
    """Simulators whose speed can be changed: simulated time is the sum of what has passed at each speed.

    While this process gets no core, the machine stands, too: at 200 times, a pause of 0.15 s would bring 30 s of samples at once.
    """

    speed, longest_step_s, _at_s, _last_s = 1.0, LONGEST_STEP_S, 0.0, 0.0

    def _advance(self) -> None:
        now = asyncio.get_running_loop().time()
        if self._last_s:
            self._at_s += min(self.speed * (now - self._last_s), self.longest_step_s)
        self._last_s = now
        self.world.advance(self._at_s)

    def pace(self, speed: float, longest_step_s: float = LONGEST_STEP_S) -> None:
        """From now on so many simulated seconds per second, and no step of time longer than this, however busy the computer is."""
        self.advance()
        self.speed, self.longest_step_s = speed, longest_step_s

    def now_s(self) -> float:
        """Simulated time."""
        self.advance()
        return self.world.time_s

    def motions(self, after_s: float = -1.0) -> list[Command]:
        """Commands that start, feed or free a motion."""
        return [c for c in self.registers.log if c.moves and c.time_s > after_s]

    def make_ready(self) -> None:
        """What a person does at the panel and inside, between two tests."""
        controller = self.world.controller
        controller.set_estop(pressed=False)
        controller.set_door(is_open=False)
        controller.switches.remote, controller.switches.program_running = True, False
        controller.switches.spindle_turning = False
        controller.reset_alarm()
        self.world.laser.block(blocked=False)
        self.world.ballbar.push(out=False)
        self.world.laser.unmount()
        self.world.table.unmount()
        self.world.ballbar.unmount()


@dataclasses.dataclass
class Bench:
    """A simulated machine and an open session with it."""

    sim: Paced
    session: Session
    site: Site
    sphere: OnSphere


@asynccontextmanager
async def bench(folder: Path, *, cnc_url: Callable[[str], str] = lambda url: url, **scenario: Any) -> AsyncIterator[Bench]:
    """Simulators and a session, closed with the block; a bar that was driven off its sphere fails the test."""
    sim = Paced(Scenario(**scenario), folder)
    sphere = OnSphere(sim.world)
    try:
        ready = await sim.start()
        urls = DeviceUrls(cnc_url(ready["cnc"]), ready["ballbar"], ready["laser"], ready["fixture"])
        async with open_session(urls) as session:
            yield Bench(sim, session, Site("sim", MACHINE, machine_doc("sim", MACHINE), urls, watching=PATIENT), sphere)
    finally:
        await sim.stop()
    assert not sphere.wrong, "\n".join(sphere.wrong)


class Keeps:
    """A recorder that keeps records in memory and lets samples go."""

    def __init__(self) -> None:
        self.records: list[dict[str, Any]] = []

    def tap(self) -> None:
        return None

    async def add_bar(self, batch: BarBatch) -> None:
        return None

    async def add_record(self, record: dict[str, Any]) -> None:
        self.records.append(record)


class AtStep(Control):
    """Does something when a step is reached, or a moment of wall time later; ``clear``: what is done once that has suspended the run.

    Not after some time: on a busy computer a door that is open for 0.2 s may be seen by nobody.
    """

    clear: Callable[[], None] = staticmethod(lambda: None)

    def __init__(self, step: int, do: Callable[[], None], delay_s: float = 0.0) -> None:
        super().__init__()
        self._step, self._do, self._delay_s = step, do, delay_s
        self.done = False

    def now(self, state: State, why: str = "") -> None:
        super().now(state, why)
        if state == State.SUSPENDED:
            self.clear()

    def place(self, step: int, steps: int, points: int) -> None:
        super().place(step, steps, points)
        if step == self._step and not self.done:
            self.done = True
            if self._delay_s:
                asyncio.get_running_loop().call_later(self._delay_s, self._do)
            else:
                self._do()


class After(AtStep):
    """Does something when the path has run for so many seconds of machine time."""

    def __init__(self, plan: CampaignPlan, b: Bench, after_s: float, do: Callable[[], None], *, step: int | None = None) -> None:
        super().__init__(step or number(plan, 0, RecordPath), lambda: None)
        self._b, self._after_s, self._do_it = b, after_s, do
        self._do = self._begin

    def _begin(self) -> None:
        self.waiting = asyncio.get_running_loop().create_task(self._when())

    async def _when(self) -> None:
        """Comes near in small steps: what a busy computer needs to notice must not be much of the path."""
        self._b.sim.pace(self._b.sim.speed, NEAR_STEP_S)
        await self._on_path_for(self._after_s - 3.0)
        self._b.sim.pace(2.0 if self._after_s < 1.0 else 10.0, NEAR_STEP_S)
        await self._on_path_for(self._after_s)
        self._do_it()

    async def _on_path_for(self, seconds: float) -> None:
        controller = self._b.sim.world.controller
        while seconds > 0.0 and not (controller.path_running and self._b.sim.world.time_s - controller.path_start_s >= seconds):  # noqa: ASYNC110 - simulated time
            await asyncio.sleep(0.001)


class InTest(Control):
    """Does something at a step of the n-th run (from 0)."""

    def __init__(self, store: Store, run: int, step: int, do: Callable[[], None]) -> None:
        super().__init__()
        self._where, self._do, self._store, self.done = (run, step), do, store, False

    def place(self, step: int, steps: int, points: int) -> None:
        super().place(step, steps, points)
        if not self.done and step == self._where[1] and len(self._store.runs.all()) == self._where[0] + 1:
            self.done = True
            self._do()


def number(plan: CampaignPlan, test: int, kind: type, nth: int = 0) -> int:
    return [k + 1 for k, s in enumerate(plan.tests[test].steps) if isinstance(s, kind)][nth]


def step_numbers(plan: TestPlan) -> list[int]:
    """Steps that the runner works on, from 1: a move to where the machine stands is none."""
    here, found = None, []
    for k, step in enumerate(plan.steps):
        if not (isinstance(step, MoveTo) and here == step.target_mm):
            found.append(k + 1)
        here = step_seconds(step, here)[1]
    return found


def rng(*words: object) -> random.Random:
    """Draws that belong to a case and to nothing else."""
    return random.Random("/".join(map(str, words)))
