"""Preconditions of a scheduled check, asked of the simulated devices over real sockets."""

from __future__ import annotations

import asyncio
import json
import sys
from dataclasses import replace

from abbe.service.clock import SystemClock
from abbe.service.devices.session import DeviceUrls, lock_machine
from abbe.service.domain.schedule import Needs, Schedule
from abbe.service.scheduler.ready import Ready, look_at

SCHEDULE = Schedule("nightly", "0 2 * * *", "UTC", "quick-check", needs=Needs(idle=True, air=True))


async def test_the_simulated_machine_is_ready_until_somebody_has_it() -> None:
    command = [sys.executable, "-m", "abbe.simulators", "--watch-stdin", "--speed", "60", "--laser", "tcp"]
    process = await asyncio.create_subprocess_exec(*command, stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE)
    assert process.stdout is not None
    assert process.stdin is not None
    try:
        where = json.loads(await process.stdout.readline())
        urls = DeviceUrls(cnc=where["cnc"], laser=where["laser"])
        seen = await look_at(urls)(True)
        assert seen.air_c is not None
        ready = Ready(look_at(urls), [SCHEDULE], (seen.air_c - 5, seen.air_c + 5), (), SystemClock())
        assert await ready.lack(SCHEDULE) == ""
        colder = Ready(look_at(urls), [SCHEDULE], (seen.air_c - 9, seen.air_c - 5), (), SystemClock())
        assert "the air is at" in await colder.lack(SCHEDULE)
        with lock_machine(urls.cnc):
            assert "is in use by" in await ready.lack(SCHEDULE)
        nowhere = Ready(look_at(replace(urls, cnc="modbus+tcp://127.0.0.1:1")), [SCHEDULE], (0.0, 40.0), (), SystemClock())
        assert "the devices cannot be read" in await nowhere.lack(SCHEDULE)
    finally:
        process.stdin.close()
        await process.wait()
