"""A laser known by a device file alone, tested beside the machine, measures while Abbe moves; nothing is pushed into a listened control."""

from __future__ import annotations

import asyncio
import json
import tomllib

import numpy as np
import pytest

from abbe.drivers.conformance.checks import Move
from abbe.drivers.conformance.device_test import Options, device_test
from abbe.drivers.described.tested import Ability
from abbe.service.devices.session import open_session
from abbe.service.domain.machine import DeviceUrls
from abbe.service.runs.columns import load_run
from abbe.service.storage.store import Store

pytestmark = [pytest.mark.scenario, pytest.mark.timeout(180)]
RECIPE = """
format = "abbe-recipe/1"
name = "line"
[[test]]
kind = "line"
label = "l1"
setup = "L1"
axis = "X"
at_share = [0.4, 0.4]
positions = 5
overrun_mm = 2.0
offset_share = 0.4
"""


async def report_beside(sims, urls, described):
    """The report of the laser beside the machine: the control makes the known motion, and somebody holds a hand into the beam."""
    async with open_session(DeviceUrls(cnc=urls["cnc"], fixture=urls["fixture"])) as session:
        await session.controller.move((300.0, 200.0, 200.0), feed_mm_min=6000.0, timeout_s=60.0)
        await session.need_fixture().mount_laser((1.0, 0.0, 0.0))

        async def person(text: str) -> None:
            if "Block" in text or "Clear the beam" in text:
                sims.ask("beam", blocked="Block" in text)
            else:
                x = 310.0 if "AWAY" in text else 300.0
                await session.controller.move((x, 200.0, 200.0), feed_mm_min=3000.0, timeout_s=30.0)

        options = Options(move=Move(10.0, 0.01), ask=person, faults=False)
        report = await device_test(described, options, "2026-11-26T00:00:00+00:00")
        await session.need_fixture().unmount()
    return report


def by_file(sims):
    """Addresses of the machine file, and that of the laser with the device file."""
    urls = tomllib.loads(sims.machine_file.read_text())["devices"]
    return urls, f"{urls['laser']}{'&' if '?' in urls['laser'] else '?'}device=abbe-laser"


def test_it_is_tested_and_measures(command, start_sims, tmp_path):
    sims = start_sims("--seed", "4")  # at the speed of a real one, whose clock is compared
    report = asyncio.run(report_beside(sims, *by_file(sims)))
    assert report.failed == ()
    assert report.abilities == (Ability.WATCH, Ability.DWELL)
    (tmp_path / "report.json").write_text(json.dumps(report.to_document()))
    (tmp_path / "r.toml").write_text(RECIPE)
    sims = start_sims("--seed", "4", "--speed", "20")
    urls, described = by_file(sims)
    sims.machine_file.write_text(sims.machine_file.read_text().replace(urls["laser"], f"{described}&tested=report.json"))
    code, _, err = command("measure", "-m", sims.machine_file, "--recipe", "r.toml", "--name", "by file")
    assert code == 0, err
    with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as store:
        (record,) = store.runs.all("by file")
        columns = load_run(store, record.id).to_document()["columns"]
    assert all(columns["valid"])
    assert np.abs(columns["deviation_mm"]).max() < 0.1
    assert np.ptp(columns["temp_air_C"]) < 1.0


async def bar_report(sims):
    urls = tomllib.loads(sims.machine_file.read_text())["devices"]
    async with open_session(DeviceUrls(cnc=urls["cnc"], fixture=urls["fixture"])) as session:
        await session.controller.move((300.0, 200.0, 200.0), feed_mm_min=6000.0, timeout_s=60.0)
        await session.need_fixture().mount_ballbar(100.0)
        await session.controller.move((400.0, 200.0, 200.0), feed_mm_min=6000.0, timeout_s=60.0)

        async def person(text: str) -> None:
            x = 400.5 if "OUT" in text else 400.0
            await session.controller.move((x, 200.0, 200.0), feed_mm_min=1000.0, timeout_s=30.0)

        report = await device_test(urls["ballbar"], Options("ballbar", Move(0.5, 0.01), person), "2026-11-26T00:00:00+00:00")
        await session.need_fixture().unmount()
    return report


def test_the_ballbar_passes_the_same_test_over_a_line_that_loses_and_doubles(start_sims):
    report = asyncio.run(bar_report(start_sims("--seed", "4")))
    assert report.failed == ()
    assert report.abilities == (Ability.WATCH, Ability.DWELL)
    assert {one.check for one in report.findings} >= {"motion radius", "reply late", "reply doubled", "reply spoilt", "reply missing"}
