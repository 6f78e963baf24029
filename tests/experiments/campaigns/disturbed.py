"""A campaign that is disturbed again and again comes to the same solution as the one that nobody disturbs.

python -m tests.experiments.campaigns.disturbed --folder OUT --recipe PLAN.toml [--speed 60] [--every-s 20] [--seed 1]

The planner's campaign is measured twice on the same simulated machine: in peace, and with a random fault every EVERY-S seconds of device
time on average (exponential intervals, running while the measurement runs; ``--regular``: exactly so often). Faults: door, e-stop, feed
hold, beam, bar out of range, connection of the controller and of the laser reset. A scripted operator clears them a moment later and says
that nobody has touched what is mounted. Both campaigns are solved and compared, parameter by parameter. The same command, given again,
keeps a campaign that is complete; one that is not begins again, for its simulated machine is gone.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import random
import re
import struct
import time
from collections import Counter
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from abbe.drivers.errors import DriverError
from abbe.models.machine import Machine
from abbe.service.campaigns.measure import MeasureOptions, measure
from abbe.service.campaigns.resume import resume
from abbe.service.compensation.recover import recover
from abbe.service.devices.session import DeviceUrls, open_session
from abbe.service.domain.machine import machine_doc
from abbe.service.errors import AbbeError, Interlock
from abbe.service.identification.solve import Solved, solve_runs
from abbe.service.runs.columns import load_run
from abbe.service.sequences.control import Control, State, Suspending, Watching
from abbe.service.sequences.recipes.recipe_file import parse_recipe
from abbe.service.sequences.steps import CampaignPlan
from abbe.service.site import Site
from abbe.service.storage.store import Store
from abbe.simulators.faults.modbus_proxy import ModbusProxy
from abbe.simulators.faults.scenario import Fault, FaultScenario
from tests.faults.on_sphere import looked_at

MACHINE = Machine(
    "w-X-Y-b-Z-t",
    np.array([[0.0, 600.0], [0.0, 500.0], [0.0, 450.0]]),
    np.array([[300.0, 250.0, -150.0], [300.0, 250.0, -250.0], [0.0, 320.0, 260.0]]),
    np.array([0.0, 0.0, -120.0]),
)
KINDS = ("door", "e-stop", "feed hold", "beam", "bar out", "controller link", "laser link")
WATCHING = Watching(None, Suspending(frozenset({"door", "beam", "temperature"}), 60.0, 0.1))
TRIES = 20_000
FAULTS = "faults.json"
"""What the disturbed campaign of a folder went through."""


@dataclass
class Tally:
    """What happened: faults by kind, how often the job began anew, and by which error it had ended."""

    faults: Counter[str] = field(default_factory=Counter)
    ends: Counter[str] = field(default_factory=Counter)
    device_s: float = 0.0


@dataclass
class Outside:
    """The simulated machine with proxies before its Modbus devices, and a hand at its panel."""

    ready: dict[str, Any]
    cnc: ModbusProxy
    laser: ModbusProxy
    control: Control | None = None

    def site(self) -> Site:
        """What the service is told."""
        urls = DeviceUrls(self.cnc.url, self.ready["ballbar"], self.laser.url, self.ready["fixture"])
        return Site("sim", MACHINE, machine_doc("sim", MACHINE), urls, watching=WATCHING)

    async def ask(self, op: str, **words: Any) -> dict[str, Any]:
        """Speak to the simulator's own fixture."""
        host, port = self.ready["fixture"].removeprefix("fixture+tcp://").split(":")
        reader, writer = await asyncio.open_connection(host, int(port), limit=1 << 26)
        try:
            writer.write(json.dumps({"id": 1, "op": op, **words}).encode() + b"\n")
            answer: dict[str, Any] = json.loads(await reader.readline())
            return answer
        finally:
            writer.close()

    async def hold(self, level: int) -> None:
        """Somebody presses feed hold at the panel, or takes it back."""
        host, port = _address(self.ready["cnc"])
        reader, writer = await asyncio.open_connection(host, port)
        try:
            writer.write(struct.pack(">HHHBBHH", 1, 0, 6, 1, 6, 80, level))
            await reader.readexactly(12)
        finally:
            writer.close()

    async def disturb(self, kind: str) -> None:
        """Let something happen, and have it cleared a moment later."""
        if kind == "controller link":
            self.cnc.play(FaultScenario("rst", 1, (Fault("rst"),)))
        elif kind == "laser link":
            self.laser.play(FaultScenario("rst", 1, (Fault("rst"),)))
        elif kind == "feed hold":
            await self.hold(1)
        else:
            op = {"door": "door", "e-stop": "estop", "beam": "beam", "bar out": "bar_out"}[kind]
            await self.ask(op, **({"blocked": True} if kind == "beam" else {"on": True}))
        await asyncio.sleep(0.15)
        if kind == "door":
            await self.ask("door", on=False)
        elif kind == "beam":
            await self.ask("beam", blocked=False)
        elif kind == "bar out":
            await self.ask("bar_out", on=False)

    async def make_ready(self) -> None:
        """The operator at the panel, before he lets a measurement go on."""
        await self.ask("reset")
        await self.ask("beam", blocked=False)
        await self.ask("bar_out", on=False)


def _address(url: str) -> tuple[str, int]:
    found = re.match(r".*//([^:]+):(\d+)", url)
    assert found is not None
    return found[1], int(found[2])


@asynccontextmanager
async def outside(folder: Path, seed: int, speed: float) -> AsyncIterator[Outside]:
    """Simulators as a child process, which look that no bar is driven off its sphere, and the proxies."""
    async with looked_at(folder / "off-the-sphere", ["--seed", str(seed), "--speed", str(speed)]) as ready:
        proxies = [ModbusProxy(_address(ready[k])) for k in ("cnc", "laser")]
        try:
            for proxy in proxies:
                await proxy.start()
            yield Outside(ready, *proxies)
        finally:
            for proxy in proxies:
                await proxy.stop()


async def disturbing(out: Outside, draw: random.Random, every_s: float, speed: float, tally: Tally, *, regular: bool) -> None:
    """Faults of random kinds at random instants, or one every so many seconds, of the time in which the measurement runs."""

    def wait_s() -> float:
        return every_s if regular else draw.expovariate(1.0 / every_s)

    left_s, step_s = wait_s(), 0.005
    loop = asyncio.get_running_loop()
    last = loop.time()
    while True:
        await asyncio.sleep(step_s)
        now = loop.time()
        if out.control is not None and out.control.state == State.RUNNING:
            left_s -= speed * (now - last)
            tally.device_s += speed * (now - last)
        last = now
        if left_s <= 0.0:
            kind = draw.choice(KINDS)
            tally.faults[kind] += 1
            await out.disturb(kind)
            left_s, last = wait_s(), loop.time()


async def measured(store: Store, out: Outside, plan: CampaignPlan, tally: Tally, say: Any) -> list[int]:
    """The campaign, gone on with as often as it takes."""

    async def untouched(_: str) -> bool:
        return True

    for _ in range(TRIES):
        try:
            async with asyncio.timeout(600), open_session(out.site().urls) as session:
                await recover(session.controller, store, out.site())
                begun = any(c.name == plan.name and store.checkpoints.of_campaign(c.id) for c in store.campaigns.all())
                found = await resume(session, store, out.site(), plan, plan.name, untouched) if begun else None
                out.control = Control()
                options = MeasureOptions(out.control, untouched, None, found)
                return await measure(session, store, out.site(), plan, progress=say, options=options)
        except (AbbeError, DriverError, TimeoutError) as error:
            tally.ends[f"{getattr(error, 'code', type(error).__name__)}" if isinstance(error, Interlock) else _short(error)] += 1
            out.control = None
            await out.make_ready()
    raise SystemExit(f"not complete after {TRIES} tries")


def _short(error: BaseException) -> str:
    return f"{getattr(error, 'code', '')} {type(error).__name__}".strip()


@dataclass(frozen=True)
class Compared:
    """Differences of two solutions in units of their combined standard uncertainty, by parameter."""

    in_u: dict[str, float]

    @property
    def worst(self) -> tuple[str, float]:
        return max(self.in_u.items(), key=lambda one: abs(one[1]))

    @property
    def rms(self) -> float:
        return float(np.sqrt(np.mean(np.square(list(self.in_u.values())))))

    @property
    def within_2(self) -> float:
        return float(np.mean(np.abs(list(self.in_u.values())) <= 2.0))


def compared(peace: Solved, war: Solved) -> Compared:
    """Every parameter of the machine that both solutions have; what belongs to a set-up is another cup and another mirror."""
    found = {}
    sides = []
    for solved in (peace, war):
        e = solved.joint.estimate
        machine = set(e.names[: len(solved.joint.terms)])
        u = np.sqrt(np.diag(e.covariance))
        sides.append({n: (float(v), float(s)) for n, v, s in zip(e.names, e.theta, u, strict=True) if n in machine or "backlash" in n})
    for name in sides[0].keys() & sides[1].keys():
        (a, u_a), (b, u_b) = sides[0][name], sides[1][name]
        found[name] = (b - a) / float(np.hypot(u_a, u_b))
    return Compared(found)


async def both(
    folder: Path, plan: CampaignPlan, *, speed: float, every_s: float, seed: int, say: Any, regular: bool = False
) -> tuple[Compared, Tally]:
    """Measure in peace and disturbed, solve both, compare. Campaigns that are complete in the folder are not measured again."""
    tally, draw = Tally(), random.Random(seed)
    with Store.open(f"sqlite:///{folder / 'abbe.sqlite3'}") as store:
        solved = []
        for name in ("peace", "disturbed"):
            tries = [replace(plan, name=c.name) for c in store.campaigns.all() if c.name.partition(" ")[0] == name]
            ids = next((found for one in tries if (found := complete(store, one)) is not None), None)
            named = replace(plan, name=name if not tries else f"{name} {len(tries) + 1}")
            if ids is None:
                async with outside(folder, seed, speed) as out:
                    await out.ask("identify")
                    task = (
                        asyncio.create_task(disturbing(out, draw, every_s, speed, tally, regular=regular)) if name == "disturbed" else None
                    )
                    try:
                        ids = await measured(store, out, named, tally, say)
                    finally:
                        if task is not None:
                            task.cancel()
                            await asyncio.wait({task})
                            if not task.cancelled() and task.exception() is not None:
                                raise task.exception() or RuntimeError
                site = out.site()
                if name == "disturbed":
                    (folder / FAULTS).write_text(json.dumps([tally.faults, tally.ends, tally.device_s]))
            else:
                site = Site("sim", MACHINE, machine_doc("sim", MACHINE), DeviceUrls())
                if name == "disturbed" and (folder / FAULTS).exists():
                    faults, ends, device_s = json.loads((folder / FAULTS).read_text())
                    tally = Tally(Counter(faults), Counter(ends), device_s)
            runs = [load_run(store, k) for k in ids]
            solved.append(await asyncio.to_thread(solve_runs, site, runs))
    return compared(*solved), tally


def complete(store: Store, plan: CampaignPlan) -> list[int] | None:
    """Runs of a campaign that was measured to its end before."""
    record = next((c for c in store.campaigns.all() if c.name == plan.name), None)
    if record is None:
        return None
    status = {r.id: r.status for r in store.runs.all(record.id)}
    done = {
        c.doc["test"]: c.doc["run"]
        for c in store.checkpoints.of_campaign(record.id)
        if c.kind == "done" and status[c.doc["run"]] == "complete"
    }
    return [done[t.label] for t in plan.tests] if all(t.label in done for t in plan.tests) else None


def summary(found: Compared, tally: Tally) -> str:
    """What was found, in a few lines."""
    name, worst = found.worst
    return "\n".join(
        (
            f"faults: {sum(tally.faults.values())} in {tally.device_s:.0f} s of measuring: {dict(tally.faults)}",
            f"the job was begun again {sum(tally.ends.values())} times: {dict(tally.ends)}",
            f"{len(found.in_u)} parameters compared: largest difference {worst:+.2f} u ({name}), rms {found.rms:.2f} u, "
            f"{100 * found.within_2:.1f} % within 2 u",
        )
    )


def main() -> None:
    """Plan, measure twice, compare; exit code 1 when a parameter differs by more than 4 u, or 2 u too often, or when nothing happened."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--recipe", type=Path, required=True, help="recipe of `abbe plan -m MACHINE.toml --minutes 60 --out FILE.toml`")
    parser.add_argument("--speed", type=float, default=60.0)
    parser.add_argument("--every-s", type=float, default=20.0)
    parser.add_argument("--regular", action="store_true", help="exactly every so many seconds, instead of on average")
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    args.folder.mkdir(parents=True, exist_ok=True)
    name, recipes = parse_recipe(args.recipe.read_text(), str(args.recipe))
    plan = CampaignPlan(name, tuple(r.plan(MACHINE) for r in recipes))
    told = [0.0]

    def say(progress: Any) -> None:
        if time.monotonic() - told[0] > 10.0 and progress.steps:
            told[0] = time.monotonic()
            print(f"{progress.stage}: {progress.done:.0f} of {progress.total:.0f} s, {progress.message}", flush=True)  # noqa: T201

    found, tally = asyncio.run(
        both(args.folder, plan, speed=args.speed, every_s=args.every_s, seed=args.seed, say=say, regular=args.regular)
    )
    print(summary(found, tally))  # noqa: T201
    if not tally.faults:
        raise SystemExit("no fault came, so that this shows nothing: make --every-s shorter, or measure a longer recipe")
    raise SystemExit(0 if abs(found.worst[1]) <= 4.0 and found.within_2 >= 0.9 else 1)


if __name__ == "__main__":
    main()
