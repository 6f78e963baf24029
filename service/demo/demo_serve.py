"""The demonstration with ``--serve``: the service watches a drifting machine and proposes a correction for approval.

The service runs as a child process with the machine file in the folder. The simulated machine drifts after the first scheduled check.
Alarm, campaign, discovery, proposal, push and verification follow automatically; only the approval needs a person.
"""

from __future__ import annotations

import asyncio
import json
import secrets
import socket
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from abbe.drivers.errors import run_to_end
from abbe.service.campaigns.measure import measure
from abbe.service.children import python_command
from abbe.service.clock import Clock, SystemClock
from abbe.service.compensation.commission import commission
from abbe.service.compensation.commission_levels import commission_levels
from abbe.service.compensation.proposals import load_runs
from abbe.service.demo.demo import bar_rate_hz, demo_site, write_machine_file
from abbe.service.demo.simulator_process import SimulatorProcess, running_simulators
from abbe.service.devices.session import Session, open_session
from abbe.service.domain.progress import ignore_progress
from abbe.service.domain.service_records import AlarmKind
from abbe.service.errors import AbbeError, StoreError
from abbe.service.identification.solve import solve_runs
from abbe.service.identification.solve_report import solution_doc
from abbe.service.sequences.check import paced
from abbe.service.sequences.recipes.campaigns import identification, verification
from abbe.service.site import Site
from abbe.service.storage.store import Store
from abbe.service.users.people import UserAccounts
from abbe.service.verification.alarms import alarms_of
from abbe.service.verification.verify import COVERAGE, figure_rows, figures

T = TypeVar("T")

DRIFT_UM_PER_M = 160.0
"""Scale error that X gains after the first check."""
USER = "approver"
EVERY_MIN = 2.0
"""Wall-clock minutes between checks: two hours of machine time at the usual speed of the demonstration."""
READY_S, STOP_S, LOOK_S = 30.0, 6.0, 0.5
MAX_LOCKED_READS = 60
MARGIN_UM = {"body_diagonal_um": 10.0, "helix_rms_um": 0.5}
"""Margins of the limits: each limit is the figure of the uncorrected machine plus U plus this margin."""


@dataclass(frozen=True, slots=True)
class ServedDemo:
    """Address of the page, user and password for the approval, log file."""

    page: str
    user: str
    password: str
    log: Path


async def run_served_demo(seed: int, speed: float, folder: Path, port: int, show: Callable[[str], None]) -> None:
    """Commission a simulated machine, run the service on it, report the events, and serve until interrupted.

    Raises
    ------
    AbbeError, DriverError
        The demonstration failed; the error names cause and remedy. Service and simulators are stopped in any case.
    """
    async with running_simulators(["--seed", str(seed), "--speed", f"{speed:g}", "--link-dir", str(folder)]) as simulator:
        site = demo_site(simulator)
        machine_file = write_machine_file(site, folder)
        with Store.open(f"sqlite:///{folder / 'abbe.sqlite3'}") as store:
            show("commissioning proves how the control applies tables: abbe comp commission")
            async with open_session(site.urls) as session:
                await commission_levels(session.controller, store, site)
                await commission(session, store, site, progress=ignore_progress)
                show("a verification sets the limits to the present errors of the machine")
                limits_um = await measured_limits(session, store, site, bar_rate_hz(speed))
                show("an identification stores the present errors for later comparison")
                await store_baseline(session, store, site, bar_rate_hz(speed))
            async with served(machine_file, store, port, limits_um) as serving:
                show(f"page: {serving.page}")
                show(f"   log in as {serving.user} with {serving.password} (log of the service: {serving.log})")
                await narrate(simulator, site.name, store, serving, show)
                show("the service keeps running: Ctrl-C stops it")
                await asyncio.Event().wait()


async def measured_limits(session: Session, store: Store, site: Site, rate_hz: int) -> dict[str, float]:
    """Measure the machine and return limits, µm: figure plus U plus the small margin in `MARGIN_UM`."""
    plan = paced(verification(site.machine, rate_hz=rate_hz, name="as it is"), site.max_feed_mm_min)
    ids = await measure(session, store, site, plan, progress=ignore_progress)
    rows = figure_rows(figures(await load_runs(store, ids)))
    return {key: round(rows[key][0] + COVERAGE * rows[key][1] + margin, 1) for key, margin in MARGIN_UM.items()}


async def store_baseline(session: Session, store: Store, site: Site, rate_hz: int) -> None:
    """Measure and solve the machine as delivered, and store the solution without a proposal."""
    plan = paced(identification(site.machine, rate_hz=rate_hz, name="as delivered"), site.max_feed_mm_min)
    ids = await measure(session, store, site, plan, progress=ignore_progress)
    solved = await asyncio.to_thread(solve_runs, site, await load_runs(store, ids))
    campaign = await asyncio.to_thread(store.campaigns.find, plan.name)
    await store.write(store.solutions.add, campaign.id, "joint", ids, solution_doc(solved) | {"machine": site.doc})


def service_config(port: int, limits_um: dict[str, float]) -> str:
    """Return the sections of the machine file for the service: page, limits, a check every few minutes, automatic proposals."""
    limits = "\n".join(f"{key} = {value:g}" for key, value in limits_um.items())
    return f"""
[web]
port = {port}

[verify]
{limits}

[alarm]
push = "approved"

[[schedule]]
name = "every {EVERY_MIN:g} minutes"
every_h = {EVERY_MIN / 60.0:.6f}
recipe = "verification"
grace_s = 3600.0
on_alarm = "propose"
"""


def free_port(wanted: int) -> int:
    """Return the port ``wanted`` if it is free, else any free port."""
    for port in (wanted, 0):
        with socket.socket() as one:
            try:
                one.bind(("127.0.0.1", port))
            except OSError:
                continue
            return int(one.getsockname()[1])
    raise AbbeError("no port of this computer is free", "end another program")


def add_approver(store: Store, clock: Clock) -> str:
    """Add a user with the right to approve; return the new password, which is stored only as a hash."""
    password = secrets.token_urlsafe(12)
    UserAccounts(store, clock).add(USER, "approver", password)
    return password


@asynccontextmanager
async def served(
    machine_file: Path, store: Store, port: int, limits_um: dict[str, float], clock: Clock | None = None
) -> AsyncIterator[ServedDemo]:
    """Run the service on this machine file for the duration of the block.

    Raises
    ------
    AbbeError
        The service did not start; its log gives the reason.
    """
    port = free_port(port)
    with machine_file.open("a", encoding="utf-8") as out:
        out.write(service_config(port, limits_um))
    password = add_approver(store, clock or SystemClock())
    log = machine_file.with_name("service.log")
    with log.open("wb") as out_log:
        process = await asyncio.create_subprocess_exec(
            *python_command("abbe.service.cli", "serve", "-m", machine_file),
            stdin=asyncio.subprocess.DEVNULL,
            stdout=out_log,
            stderr=out_log,
            start_new_session=True,  # Ctrl-C reaches only this process, which then stops the service
        )
    try:
        await _answers(process, port, log)
        yield ServedDemo(f"http://127.0.0.1:{port}/", USER, password, log)
    finally:
        await run_to_end(_end(process))


async def _answers(process: asyncio.subprocess.Process, port: int, log: Path) -> None:
    try:
        async with asyncio.timeout(READY_S):
            while process.returncode is None:
                try:
                    _, writer = await asyncio.open_connection("127.0.0.1", port)
                except OSError:
                    await asyncio.sleep(0.1)
                    continue
                writer.close()
                return
    except TimeoutError:
        pass
    raise AbbeError("the service did not start", f"see {log}")


async def _end(process: asyncio.subprocess.Process) -> None:
    if process.returncode is not None:
        return
    process.terminate()
    try:
        async with asyncio.timeout(STOP_S):
            await process.wait()
    except TimeoutError:
        process.kill()
        await process.wait()


async def drift(simulator: SimulatorProcess, um_per_m: float = DRIFT_UM_PER_M) -> None:
    """Add a scale error to the simulated machine's X axis."""
    host, port = str(simulator.urls.fixture).removeprefix("fixture+tcp://").rsplit(":", 1)
    reader, writer = await asyncio.open_connection(host, int(port))
    try:
        writer.write(json.dumps({"id": 1, "op": "drift", "axis": "X", "um_per_m": um_per_m}).encode() + b"\n")
        await writer.drain()
        answer = json.loads(await reader.readline())
    finally:
        writer.close()
    if not answer.get("ok"):
        raise AbbeError(f"the simulated machine does not drift: {answer}", "check the scenario")


async def narrate(simulator: SimulatorProcess, machine: str, store: Store, serving: ServedDemo, show: Callable[[str], None]) -> None:
    """Show one line per event until the alarm is cleared.

    Raises
    ------
    AbbeError
        The simulated machine does not drift, or the service proposes nothing.
    """
    show(f"1. check by the timetable: {await _check(store, machine, 1)}")
    await drift(simulator)
    show(f"2. unknown to the service, the machine's X axis grows by {DRIFT_UM_PER_M:g} µm/m")
    show(f"3. check by the timetable: {await _check(store, machine, 2)}")
    alarm = (await _until(lambda: alarms_of(store, machine)))[-1]
    show(f"4. alarm {alarm.number}: {alarm.text}")
    found = await _until(lambda: alarms_of(store, machine)[-1].last(AlarmKind.DISCOVERED, AlarmKind.ENDED, AlarmKind.FAILED))
    show(f"5. the service has measured the full campaign and searched: {found.facts.text}")
    proposed = await _until(lambda: alarms_of(store, machine)[-1].last(AlarmKind.PROPOSED, AlarmKind.ENDED, AlarmKind.FAILED))
    proposal = proposed.facts.proposal or 0
    show(f"   {proposed.facts.text}")
    if proposed.kind is not AlarmKind.PROPOSED:
        raise AbbeError("the service proposes nothing", f"see {serving.log}; try another --seed")
    show(f"   approve it at {serving.page}proposal?id={proposal}")
    who = (await _until(lambda: store.proposals.approvals(proposal)))[-1].name
    show(f"6. approved by {who}: the service pushes it now, proves its sign and verifies it")
    pushed = await _until(lambda: alarms_of(store, machine)[-1].last(AlarmKind.PUSHED))
    show(f"7. {pushed.facts.text}")
    await _until(lambda: not alarms_of(store, machine)[-1].active)
    checks = await _until(lambda: _checks(store, machine))
    show(f"8. the check after it: {checks[-1]}; the alarm is over")


def _checks(store: Store, machine: str) -> list[str]:
    """Return the results of the scheduled checks of a machine, oldest first."""
    number = next((m.id for m in store.machines.all() if m.name == machine), None)
    rows = [] if number is None else store.verifications.latest(number)
    return [str(v.doc.get("text", "")) for v in sorted(rows, key=lambda v: v.id) if v.doc.get("schedule")]


async def _check(store: Store, machine: str, number: int) -> str:
    """Wait for the service's check ``number``; return its text."""
    return (await _until(lambda: _checks(store, machine)[number - 1 :]))[0]


async def _until(look: Callable[[], T | None]) -> T:
    """Poll until ``look`` finds something. Reads of a locked database are retried, because the service writes to it.

    Raises
    ------
    StoreError
        `MAX_LOCKED_READS` reads failed in a row.
    """
    refused = 0
    while True:
        try:
            found = await asyncio.to_thread(look)
            refused = 0
        except StoreError:
            found, refused = None, refused + 1
            if refused >= MAX_LOCKED_READS:
                raise
        if found:
            return found
        await asyncio.sleep(LOOK_S)
