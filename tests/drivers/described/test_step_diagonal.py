"""A stranger's meter measures step diagonals beside a machine without interface: an operator runs the NC program, Abbe listens."""

from __future__ import annotations

import json
import random
import shutil
import struct
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from pyModbusTCP.server import DataBank, ModbusServer

from abbe.drivers.conformance.device_test import Options, device_test
from abbe.drivers.errors import NotProved
from abbe.models.arrays import F1, F2
from abbe.service.campaigns.listen import listen_campaign
from abbe.service.campaigns.measure import measure
from abbe.service.cli import run as run_command
from abbe.service.compensation.recover import recovered_session
from abbe.service.config import load_machine
from abbe.service.domain.run import Run
from abbe.service.errors import ConfigError
from abbe.service.runs.columns import load_run
from abbe.service.sequences.nc.write import nc_program
from abbe.service.sequences.recipes.recipe_file import read_recipe
from abbe.service.sequences.steps import CampaignPlan
from abbe.service.site import Site, site_of
from abbe.service.storage.store import Store
from tests.drivers.described.foreign import HERE, LineWorld, World, free_port, program, wait_for
from tests.drivers.described.test_device_test import MOVE, UTC, kept, report_of
from tests.service.sequences.nc_reader import read_gcode

pytestmark = pytest.mark.timeout(180)
DIAGONALS = ("ppp", "npp", "pnp", "ppn")
DISTORTION: F2 = np.array([[60e-6, 25e-6, -30e-6], [0.0, -40e-6, 15e-6], [0.0, 0.0, 50e-6]])
"""Deviation of the tool per mm of position: scales on the diagonal, squareness beside it. Any rotation of the whole is left out."""
TRUTH = {"EXX.1": 3.6e-3, "EYY.1": -2.0e-3, "EZZ.1": 2.25e-3, "C0Y": -25e-6, "B0Z": -30e-6, "A0Z": -15e-6}
"""The same as the solution states it: mm at half the stroke, and rad, obtuse angles positive."""
MACHINE = """
name = "mill"
chain = "w-X-Y-b-Z-t"
[stroke_mm]
X = [0, 120]
Y = [0, 100]
Z = [0, 90]
[devices]
laser = "{url}"
fixture = "fixture+console:"
"""
RECIPE = 'format = "abbe-recipe/1"\nname = "diagonals"\n' + "".join(
    f'[[test]]\nkind = "diagonal"\nlabel = "{d}"\nsetup = "{d}"\ndiagonal = "{d}"\nsteps = 3\norder = "XYZ"\n' for d in DIAGONALS
)


def site(folder: Path, url: str) -> Site:
    (folder / "mill.toml").write_text(MACHINE.format(url=url))
    (folder / "recipe.toml").write_text(RECIPE)
    return site_of(load_machine(folder / "mill.toml").machine)


def blocks(text: str) -> list[list[tuple[str, F1, float]]]:
    """Motions and dwells of an NC program, cut where it stops for a person."""
    out: list[list[tuple[str, F1, float]]] = [[]]
    for event in read_gcode(text, dwell="P_s"):
        if event.kind == "halt":
            out.append([])
        else:
            out[-1].append((event.kind, np.array(event.at), float(event.value)))
    return out


def track(part: list[tuple[str, F1, float]], beam: F1, at: F1) -> list[tuple[float, float]]:
    """What the reflector does along the beam, mm over s, while the machine runs a part of the program from ``at`` on."""
    s, start, out = 3.0, at, [(0.0, 0.0), (3.0, 0.0)]
    for kind, target, value in part:
        if kind == "go":
            s += max(float(np.linalg.norm(target - at)) / (value / 60.0), 0.05)
            at = target
        else:
            s += value
        moved = at - start
        out.append((s, float(beam @ (moved + DISTORTION @ moved))))
    return out


async def solved(url: str, world: World | LineWorld | LibraryMeter, tmp_path: Path) -> dict[str, Run]:
    """Measure the diagonals with an instrument whose report is kept, and return the runs by label."""
    here = site(tmp_path, url)
    title, recipes = read_recipe(tmp_path / "recipe.toml")
    plan = CampaignPlan(title, tuple(recipe.plan(here.machine) for recipe in recipes))
    parts = blocks(nc_program(here.name, here.machine, plan, "linuxcnc", here.nc).text)
    runs = dict(zip(DIAGONALS, parts[1::2], strict=True))
    starts = dict(zip(DIAGONALS, (part[-1][1] for part in parts[::2] if part), strict=True))
    beams = {test.label: test.setup.nominal_beam for test in plan.tests}

    def operator(text: str) -> None:
        label = text.partition(":")[0]
        if "listening" in text:
            world.run(track(runs[label], beams[label], starts[label]))

    async def mounts(text: str) -> None:
        return

    with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as store:
        async with recovered_session(store, here, ask=mounts, listening=True) as session:
            with pytest.raises(ConfigError, match="Abbe can only read this control"):
                await measure(session, store, here, plan)
            with pytest.raises(NotProved, match="Abbe writes no table into it"):
                await session.controller.write_bank(0, b"")
            await listen_campaign(session, store, here, plan, operator)
        return {record.label: load_run(store, record.id) for record in store.runs.all(title)}


def check(measured: dict[str, Run], tmp_path: Path, capsys) -> None:
    """The readings are those of the distortion along the beams, and the solution is the distortion."""
    for label, run in measured.items():
        columns = run.to_document()["columns"]
        q = np.stack([columns[f"{axis}_mm"] for axis in "xyz"], axis=1)
        beam = np.array(run.to_document()["setup"]["nominal_beam"])
        assert np.array(columns["deviation_mm"]) == pytest.approx((q - q[0]) @ DISTORTION.T @ beam, abs=4e-4), label
        assert run.table.crc is None
    code = run_command(["solve", "diagonals", "--machine", str(tmp_path / "mill.toml"), "--json"])
    out, err = capsys.readouterr()
    assert code == 0, err
    found = json.loads(out)["parameters"]
    for name, truth in TRUTH.items():
        assert abs(found[name]["value"] - truth) < 4.0 * found[name]["u"], name
        assert found[name]["u"] < 0.1 * abs(truth), name


async def test_a_modbus_meter_measures_and_the_runs_solve(url: str, world: World, tmp_path: Path, capsys) -> None:
    report = kept(await report_of(url, world), tmp_path)
    measured = await solved(f"{url}&tested={report}", world, tmp_path)
    for run in measured.values():
        assert np.array(run.to_document()["columns"]["temp_air_C"]) == pytest.approx(20.5, abs=1e-3)
    check(measured, tmp_path, capsys)


LIBRARY_METER = """
format = "abbe-device/1"
kind = "displacement"
name = "meter of a library"
source = "this test"
air = "compensated"
modbus = {order = "BADC", function = 3}
identity = [{address = 0, type = "u32", holds = 0x41424245}]
flags = [{value = "state", bit = 0, means = "beam lost"}]
[values]
displacement = {address = 2, type = "f32", unit = "um"}
time = {address = 4, type = "u32", unit = "ms"}
counter = {address = 6, type = "u16"}
state = {address = 7, type = "u16"}
[limits]
rate_hz = 500.0
range_mm = [-1000.0, 1000.0]
resolution = 0.1
"""


class LibraryMeter(DataBank):
    """A meter served by pyModbusTCP, which no other part knows: micrometres as floats, each word little-endian."""

    def __init__(self) -> None:
        super().__init__()
        self.random, self.count, self.lost = random.Random(5), 0, 0
        self.track, self.begin_s, self.first = [(0.0, 0.0)], 0.0, 0

    def run(self, track: Sequence[tuple[float, float]]) -> None:
        """From now on the target follows a track (s, mm), at 40 ms a reading; the meter's clock goes on."""
        self.begin_s = self.begin_s + 0.04 * (self.count - self.first) + 0.1 if self.begin_s else time.monotonic() + 0.1
        self.track, self.first = list(track), self.count

    async def person(self, text: str) -> None:
        self.lost = int(text.startswith("Block"))
        self.track = [(0.0, 10.0 if "AWAY" in text else 0.0)]

    def get_holding_registers(self, address: int, number: int = 1, srv_info: object = None) -> list[int]:
        self.count += 1
        s = 0.04 * (self.count - self.first)
        um = 1e3 * float(np.interp(s, *np.array(self.track).T)) + self.random.uniform(-0.3, 0.3)
        ms = round(1000.0 * (self.begin_s + s if self.begin_s else time.monotonic()))
        data = struct.pack(">IfIHH", 0x41424245, um, ms, self.count & 0xFFFF, self.lost)
        return [*struct.unpack("<8H", data), *[0] * 16][address : address + number]


async def test_a_meter_of_another_library_measures_and_the_runs_solve(tmp_path: Path, capsys) -> None:
    world, port, file = LibraryMeter(), free_port(), tmp_path / "meter.toml"
    file.write_text(LIBRARY_METER)
    server = ModbusServer("127.0.0.1", port, no_block=True, data_bank=world)
    server.start()
    try:
        url = f"modbus+tcp://127.0.0.1:{port}?device={file}"
        report = await device_test(url, Options(move=MOVE, ask=world.person), UTC)
        assert report.failed == ()
        measured = await solved(f"{url}&tested={kept(report, tmp_path)}", world, tmp_path)
        check(measured, tmp_path, capsys)
    finally:
        server.stop()


async def test_a_scale_with_lines_of_text_measures_and_the_runs_solve(require, tmp_path: Path, capsys) -> None:
    for tool in ("socat", "perl"):
        require(tool, shutil.which(tool) is not None, f"{tool} is not installed")
    world, line = LineWorld(tmp_path / "scale"), tmp_path / "line"
    with program("socat", f"PTY,raw,echo=0,link={line}", f"EXEC:perl {HERE / 'foreign_scale.pl'} {world.path}"):
        wait_for(line.exists, "the pty of socat")
        url = f"serial://{line}?device={HERE / 'foreign-scale.toml'}"
        report = await device_test(url, Options(move=MOVE, ask=world.person), UTC)
        assert (report.failed, report.serial_no) == ((), "0815")
        measured = await solved(f"{url}&tested={kept(report, tmp_path)}", world, tmp_path)
    assert all("temp_air_C" not in run.to_document()["columns"] for run in measured.values())
    check(measured, tmp_path, capsys)
