"""Machines of known errors behind the drives of two controls: measured over the bridges, pushed, verified where the drives then stand.

A machine is `tests.models.solvers.truth.Truth`: exact kinematics with finite rotations, sines that no basis of the solver holds. It sees
what
the drives get (``drive-x..z``, after everything that the control adds), never the commands. Its instruments see only where the tool is.

The first control gets a 3-D grid into its network, the second one its axes' own tables as COMP_FILE. Both run at the same time: nearly
all of it is the time that axes take. They are therefore as quick as the control lets them be (`VELOCITY`, `ACCELERATION`). The long run
only adds more places to stand at.
"""

from __future__ import annotations

import asyncio
import os
import time
from itertools import pairwise

import numpy as np
import pytest

from abbe.drivers.api import Condition
from abbe.drivers.cnc.driver import ModbusController
from abbe.drivers.errors import Refused
from abbe.drivers.second_decoder import read_axis_tables
from abbe.drivers.tables import TableImage, encode
from abbe.models.compensation.grid import GridTable, grid_table, nodes_mm, quantise_grid
from abbe.models.geometry.chain import travel_sign
from abbe.models.geometry.volume import field_statistics
from abbe.models.paths import DIAGONALS, diagonal_ends, helix_points, step_diagonal, straight_line
from abbe.models.solvers.joint import JointSolution, solve_joint
from abbe.models.solvers.observations import RunData, block_average
from abbe.models.solvers.observe import perpendicular
from tests.linuxcnc.instance import Instance
from tests.linuxcnc.test_control import OWNER, controller, push, until
from tests.linuxcnc.test_files import settled
from tests.models.solvers.truth import FLOOR, MACHINE, PLACES, SIGMA, Truth
from tests.patience import within

COUNTS = (13, 11, 10)
LSB_MM = 1e-4
VELOCITY, ACCELERATION = 5000, 1_000_000
"""mm/s and mm/s^2: the drives are ideal, and at 500 mm/s and 4 m/s^2 the same takes many minutes."""
FEED = 180_000.0
TURNS = 3
PITCH_MM = 10.0
"""Between two points of an axis' own table; the waves of the screws are six of them."""
SLOW_MM = 0.01
WHOLE_S = 90.0
POINTS, POSITIONS = (200, 25) if os.environ.get("ABBE_TEST_LONG") else (80, 12)
"""Of the volume and of each axis, where the tool stands to be compared."""


class Behind:
    """The machine behind the drives of one control, and the instruments on it."""

    def __init__(self, machine: Instance, cnc: ModbusController, truth: Truth) -> None:
        self.machine, self.cnc, self.truth = machine, cnc, truth
        self.least_rows = 10**9

    async def along(self, path: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Run a path; commands and true tool positions at instants on it, lost motion by the direction of each axis."""
        await self.cnc.move(tuple(np.round(path[0], 5)), feed_mm_min=FEED, timeout_s=30)
        await self.cnc.load_path([tuple(np.round(p, 5)) for p in path[1:]])
        await self.machine.path_rows()  # a period or two after the end of the path before
        await self.cnc.start_path(feed_mm_min=FEED)
        await until(self.cnc, lambda s: Condition.PATH_RUNNING not in s.conditions)
        rows = np.array(await self.machine.path_rows())
        assert np.abs(rows[:, 3:] - rows[:, :3]).max() < 1e-9  # no table yet
        rows = rows[np.r_[True, np.linalg.norm(np.diff(rows[:, :3], axis=0), axis=1) > 0.05]]
        self.least_rows = min(self.least_rows, len(rows))
        command, drive = rows[:, :3], rows[:, 3:]
        return command, drive + self.truth.deviation(drive, travel_sign(command))

    async def bar(self, label: str, centre: np.ndarray, radius: float) -> RunData:
        path = helix_points(centre, radius, turns=TURNS, n=int(radius * TURNS * 2.5), law="area", axis=2)
        command, tool = await self.along(path)
        cup = centre + self.truth.deviation(centre[None])[0] + self.truth.rng.normal(0, 10e-3, 3)
        reading = np.linalg.norm(tool - cup, axis=1) - radius + self.truth.rng.normal(0, 4e-4, len(tool))
        n, sign = len(tool), travel_sign(command)
        run = RunData(label, label, "bar", command, reading, sign, np.arange(n) * 0.03, np.ones(n), centre, radius, None, 2e-3, True)
        return block_average(run, 300)

    async def laser(self, label: str, path: np.ndarray) -> RunData:
        command, tool = await self.along(path)
        beam = path[len(path) // 2] - path[0]  # there and back
        beam = beam / np.linalg.norm(beam)
        axis = beam + self.truth.rng.normal(0, 150e-6, 2) @ perpendicular(beam)
        n = len(tool)
        reading = (tool - tool[0]) @ axis / (axis @ beam) - (command - command[0]) @ beam + self.truth.rng.normal(0, 2.4e-4, n)
        run = RunData(label, label, "laser", command, reading, travel_sign(command), np.arange(n) * 1.0, np.ones(n), beam=beam)
        return block_average(run, 60)

    async def campaign(self) -> tuple[RunData, ...]:
        runs = [await self.bar(f"h{k}", np.array(p[:3], float), p[3]) for k, p in enumerate(PLACES)]
        box = MACHINE.stroke_mm + np.array([10.0, -10.0])
        for a in range(3):
            for at in (0.15, 0.85):
                start = MACHINE.stroke_mm[:, 0] + at * MACHINE.length_mm
                end = start.copy()
                start[a], end[a] = box[a]
                runs.append(await self.laser(f"l{a}{at}", straight_line(start, end, 25)))
        runs += [await self.laser(f"d{d}", step_diagonal(*diagonal_ends(box, d), 12, "XYZ")) for d in DIAGONALS]
        return tuple(runs)

    async def deviation(self, points: np.ndarray) -> np.ndarray:
        """Stand at each point and compare where the tool is with where it was told to be; the axes come from no particular side."""
        out = np.empty_like(points)
        for n, p in enumerate(points):
            await self.cnc.move(tuple(p), feed_mm_min=FEED, timeout_s=30)
            drive = np.array(await self.machine.drives())
            out[n] = drive + self.truth.deviation(drive[None])[0] - p
        return out


def image_of(table: GridTable) -> bytes:
    lsb = np.rint(table.correction_mm / LSB_MM).astype(int)
    body = tuple(int(v) for v in np.moveaxis(lsb, (0, 1, 2), (2, 1, 0)).reshape(-1))
    step = tuple(float(p[1] - p[0]) for p in table.position_mm)
    return encode(TableImage(2, 5, 100, (0.0, 0.0, 0.0), step, COUNTS, body))


def tour(points: np.ndarray) -> np.ndarray:
    """The same points, each followed by the nearest of those left."""
    left, order = list(range(1, len(points))), [0]
    while left:
        order.append(min(left, key=lambda k: np.linalg.norm(points[k] - points[order[-1]])))
        left.remove(order[-1])
    return points[order]


def best_rms(truth: Truth, solution: JointSolution, points: np.ndarray) -> float:
    """What a table of the known errors themselves, taken at its nodes, would leave: what the number of points and the unit cost."""
    shape = quantise_grid(grid_table(solution, COUNTS), LSB_MM)
    nodes = nodes_mm(shape.position_mm)
    known = -truth.deviation(nodes).reshape(*COUNTS, 3)
    table = GridTable(shape.position_mm, np.rint(known / LSB_MM) * LSB_MM, shape.u_mm, shape.compensated, shape.reference)
    added = table.correction_at(points)
    return field_statistics(points, truth.deviation(points + added) + added).rms_mm


class Screws(Truth):
    """A machine whose screws have a wave of their own, too short for a curve of 16 points."""

    def motions(self, p: np.ndarray) -> np.ndarray:
        out = super().motions(p)
        for a in range(3):
            out[:, a, a] += 1.5e-3 * np.sin(2 * np.pi * p[:, a] / (6 * PITCH_MM) + self.phase[a, a, 0])
        return out

    def own(self, axis: int, at: np.ndarray) -> np.ndarray:
        """Error of an axis along itself, the others at home."""
        points = np.zeros((len(at), 3))
        points[:, axis] = at
        return self.deviation(points)[:, axis]


async def own_errors(behind: Behind, axis: int, at: np.ndarray) -> np.ndarray:
    """Stand at each position of an axis, the others at home, and compare where the tool is along it with where it was told to be."""
    points = np.zeros((len(at), 3))
    points[:, axis] = at
    return (await behind.deviation(points))[:, axis]


async def creep(cnc: ModbusController, axis: int, to: float) -> None:
    """Arrive slowly: the control looks its table up a cycle before it stands, and the quicker the axis the farther away that was."""
    target = [0.0, 0.0, 0.0]
    for at, feed in ((to - SLOW_MM if to > SLOW_MM else to + SLOW_MM, FEED), (to, 60.0)):
        target[axis] = round(at, 5)
        await cnc.move((target[0], target[1], target[2]), feed_mm_min=feed, timeout_s=30)


def own_tables(errors: list[np.ndarray]) -> bytes:
    """Nine tables that hold the corrections of each axis' own error, zero at home, and nothing else."""
    counts = (len(errors[0]), len(errors[1]), len(errors[2]))
    body: list[int] = []
    for a, error in enumerate(errors):
        for i in range(3):
            body += [int(v) for v in np.rint((error[0] - error) / LSB_MM)] if i == a else [0] * len(error)
    return encode(TableImage(1, 6, 100, (0.0, 0.0, 0.0), (PITCH_MM, PITCH_MM, PITCH_MM), counts, tuple(body)))


def between(table: list[tuple[float, float]], at: float) -> float:
    """A table's value between its points."""
    low, high = next((p, r) for p, r in pairwise(table) if p[0] <= at <= r[0])
    return low[1] + (high[1] - low[1]) * (at - low[0]) / (high[0] - low[0])


def grid_image(solution: JointSolution) -> bytes:
    """The image of a bank with the grid that corrects a solution."""
    return image_of(quantise_grid(grid_table(solution, COUNTS), LSB_MM))


async def volumetric(machine: Instance) -> dict[str, float]:
    """Identify with bar and laser, push a grid, stand at random points."""
    truth = Truth(2)
    rng = np.random.default_rng(7)
    points = tour(np.round(rng.uniform(MACHINE.stroke_mm[:, 0], MACHINE.stroke_mm[:, 1], (POINTS, 3)), 5))
    async with controller(machine) as cnc:
        behind = Behind(machine, cnc, truth)
        begin = time.monotonic()
        runs = await behind.campaign()
        measured = time.monotonic()
        solution = await asyncio.to_thread(solve_joint, MACHINE, runs, order=9, sigma_mm=SIGMA, floor_mm=FLOOR)
        solved = time.monotonic()
        before = field_statistics(points, truth.deviation(points)).rms_mm
        # In a thread, like the solution: the loop serves the other control too, whose replies have a second.
        image, bound_mm = await asyncio.to_thread(lambda: (grid_image(solution), best_rms(truth, solution, points)))
        assert np.abs(await behind.deviation(points[:5]) - truth.deviation(points[:5])).max() < 1e-9  # nothing is corrected yet
        await push(cnc, image)
        pushed = time.monotonic()
        after = field_statistics(points, await behind.deviation(points)).rms_mm
    return {
        "rows_least": behind.least_rows,
        "measured_s": measured - begin,
        "solved_s": solved - measured,
        "verified_s": time.monotonic() - pushed,
        "before_um": before * 1e3,
        "after_um": after * 1e3,
        "bound_um": bound_mm * 1e3,
    }


async def by_files(machine: Instance) -> dict[str, float]:
    """Measure each axis at the points of its table, push, start anew, stand at random positions: what is left over what has to be left."""
    truth = Screws(3)
    rng = np.random.default_rng(8)
    nodes = [np.arange(0.0, length + 1e-9, PITCH_MM) for length in MACHINE.length_mm]
    at = [np.sort(np.round(rng.uniform(n[0], n[-1], POSITIONS), 5)) for n in nodes]
    begin = time.monotonic()
    async with controller(machine) as cnc:
        behind = Behind(machine, cnc, truth)
        image = own_tables([await own_errors(behind, a, nodes[a]) for a in range(3)])
        with pytest.raises(Refused, match="staged"):
            await push(cnc, image)
        await cnc.release(OWNER)
    await machine.stop()
    await machine.start()
    tables = read_axis_tables(image)
    found: dict[str, float] = {}
    async with controller(machine) as cnc:
        assert await cnc.read_bank((await cnc.comp_status()).active_bank) == image
        behind = Behind(machine, cnc, truth)
        for a, name in enumerate("XYZ"):
            left = np.empty(len(at[a]))
            for n, q in enumerate(at[a]):
                await creep(cnc, a, q)
                left[n] = (await own_errors(behind, a, np.array([q])))[0]
                added = between(tables[name, name], q)
                assert await settled(machine, a) == pytest.approx(added, abs=1e-6)  # backlash-filt is the table
            known = truth.own(a, at[a])
            # What a table of these nodes cannot hold: from the known error alone, without our encoder, the file or the control.
            bound = np.abs(known - np.interp(at[a], nodes[a], truth.own(a, nodes[a])))
            left -= truth.own(a, nodes[a][:1])[0]  # the table is zero at home: what is there stays everywhere
            assert (
                np.abs(left) <= bound + 0.5 * LSB_MM + 2e-6
            ).all()  # half a unit of the table, a nanometre of the file and of the control
            found[f"{name}_before_um"] = float(np.abs(known - truth.own(a, nodes[a][:1])[0]).max()) * 1e3
            found[f"{name}_after_um"] = float(np.abs(left).max()) * 1e3
            found[f"{name}_interpolation_um"] = float(bound.max()) * 1e3
    return found | {"files_s": time.monotonic() - begin}


@pytest.mark.timeout(200)
async def test_identify_push_and_verify_on_two_controls_at_once(instances, record_property):
    begin = time.monotonic()
    pair = [instances(), instances()]
    for one in pair:
        one.faster(VELOCITY, ACCELERATION)
    await asyncio.gather(*(one.start() for one in pair))
    async with asyncio.TaskGroup() as both:
        one_s, two_s = both.create_task(volumetric(pair[0])), both.create_task(by_files(pair[1]))
    figures, files = one_s.result(), two_s.result()
    whole_s = time.monotonic() - begin
    for name, value in (figures | files | {"whole_s": whole_s}).items():
        record_property(name, value)
        print(f"{name} {value:.3f}")  # noqa: T201 - figures for who runs this alone with -s
    assert figures["after_um"] < figures["before_um"] / 5
    assert figures["after_um"] < 3 * figures["bound_um"]
    for axis in "XYZ":
        assert files[f"{axis}_interpolation_um"] > 0.1  # the table's points do cost something: this is not rounding alone
        assert files[f"{axis}_after_um"] < files[f"{axis}_before_um"] / 5
    assert whole_s < within(WHOLE_S)
