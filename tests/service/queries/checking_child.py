"""``python checking_child.py URL MACHINE COUNT``: the service's own job on a check without devices, slot after slot of one timetable."""

from __future__ import annotations

import asyncio
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta

from abbe.service.clock import SystemClock
from abbe.service.domain.progress import ProgressSink
from abbe.service.domain.schedule import Schedule
from abbe.service.scheduler.heartbeat import Heartbeat
from abbe.service.scheduler.job import CheckJobs, carry_out
from abbe.service.scheduler.retrying_store import StoreLedger, StoreShelf
from abbe.service.sequences.control import Control
from abbe.service.storage.store import Store

QUICK = Schedule("quick", "*/1 * * * *", "UTC", "quick-check")
FIRST = datetime(2026, 11, 22, 9, tzinfo=UTC)


@dataclass(frozen=True)
class Result:
    campaign: str
    values: Mapping[str, float]
    verdict: str = "pass"
    uncertainties: Mapping[str, float] = field(default_factory=lambda: {"body_diagonal_um": 1.0})
    limits: Mapping[str, float] = field(default_factory=lambda: {"body_diagonal_um": 20.0})
    run_labels: tuple[str, ...] = ("check-1",)
    started_utc: datetime = FIRST
    duration_s: float = 1.0
    text: str = "fine"
    comparable: bool = True


async def main() -> None:
    url, name, count = sys.argv[1], sys.argv[2], int(sys.argv[3])
    with Store.open(url) as store:
        machine_id, clock, done = store.machines.add(name, {"name": name}), SystemClock(), [0]

        async def check(_recipe: str, _progress: ProgressSink, _control: object) -> Result:
            campaign = f"quick-check {name} {done[0]}"
            number = await store.write(store.campaigns.add, machine_id, campaign, {})
            run_id = await store.write(store.runs.start, number, "check-1", "laser_linear", "holdout", {"of": name})
            await store.write(store.runs.finish, run_id, "complete", "", None)
            return Result(campaign, {"body_diagonal_um": float(len(name))})

        shelf = StoreShelf(store, clock, (name, machine_id), ("v", "a"), lambda: None)
        heartbeat = Heartbeat(name, "0", store.heartbeats, lambda: [], clock)
        checks, ledger = CheckJobs(name, check, shelf, clock), StoreLedger(store, clock, name)
        sys.stdout.write("ready\n")
        sys.stdout.flush()
        sys.stdin.readline()
        told = asyncio.create_task(heartbeat.run())
        for done[0] in range(count):
            slot = FIRST + timedelta(minutes=done[0])
            assert await ledger.claim("quick", slot)
            await ledger.begin("quick", slot)
            await ledger.finish("quick", slot, await carry_out(checks(QUICK, slot), slot, Control(), [heartbeat]))
        told.cancel()


if __name__ == "__main__":
    asyncio.run(main())
