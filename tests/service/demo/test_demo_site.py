"""The site of a demonstration: its machine is a program of the same computer."""

import asyncio
import os
import signal
from pathlib import Path

from abbe.service.demo.demo import demo_site
from abbe.service.demo.simulator_process import running_simulators
from abbe.service.devices.session import open_session
from abbe.service.sequences.control import Watching
from abbe.service.sequences.watch import known_status
from tests.scenarios.world import simulators_of


async def test_a_simulator_that_waits_for_a_core_is_no_silent_machine(tmp_path: Path) -> None:
    async with running_simulators(["--link-dir", str(tmp_path)]) as simulator:
        site = demo_site(simulator)
        async with open_session(site.urls) as session:
            before = await session.controller.status()
            (pid,) = simulators_of(tmp_path)
            os.kill(pid, signal.SIGSTOP)
            asyncio.get_running_loop().call_later(1.5 * Watching().unknown_s, os.kill, pid, signal.SIGCONT)
            after = await known_status(session.controller.status, site.watching.unknown_s)
    assert after.position_mm == before.position_mm
