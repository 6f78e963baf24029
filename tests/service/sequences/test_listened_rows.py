"""What nobody saw of a laser test has a row of its own, for every kind of laser test: later rows keep their places."""

import numpy as np
import pytest

from abbe.drivers.api import Condition, LaserReading
from abbe.models.machine import Machine
from abbe.service.campaigns import listen
from abbe.service.campaigns.listen import Heard, planned_readings, row_times
from abbe.service.domain.document import parsed
from abbe.service.domain.measured import LaserRecord, RunStart
from abbe.service.runs.observations import run_data
from abbe.service.runs.sample_columns import MM_PER_COUNT, laser_columns
from abbe.service.sequences.nc.blocks import LASER_DWELL_S
from abbe.service.sequences.recipes.recipe import Diagonal, FaceDiagonal, Linear
from abbe.service.sequences.steps import MountLaser
from tests.pretended_status import controller_status
from tests.run_documents import run_of

MACHINE = Machine("w-X-Y-b-Z-t", np.array([[0.0, 600.0], [0.0, 500.0], [0.0, 450.0]]))
COMPENSATED = 1 << 3
KINDS = {
    "line": Linear("l", "L", "identify", 0, positions=6, cycles=2, overrun_mm=2.0, at_share=(0.15, 0.15)),
    "line without overrun": Linear("l", "L", "identify", 1, positions=7, at_share=(0.15, 0.15)),
    "straight diagonal": Diagonal("d", "D", "identify", "npp", 6, ""),
    "step diagonal": Diagonal("d", "D", "identify", "ppp", 4, "XYZ"),
    "face diagonal": FaceDiagonal("f", "F", "identify", "XY", "np", steps=6),
}


def columns_of(plan, records):
    return laser_columns([parsed(LaserRecord, one) for one in records], RunStart.from_document({}), plan.setup.nominal_beam)


class Recorder:
    def __init__(self):
        self.records = []

    async def add_record(self, record):
        self.records.append(record)


def world(recipe, lost):
    """The plan of a test, and the laser and the controller beside a program that does not rest at the readings ``lost``."""
    plan = recipe.plan(MACHINE)
    places, way, now, rest = planned_readings(plan), [(0.0, 0.0)], 1.0, 0.3 + LASER_DWELL_S
    for k, one in enumerate(places):
        now += abs(one.along_mm - way[-1][1]) / 100.0
        way.append((now, one.along_mm))
        now += 0.0 if k in lost else rest
        way.append((now, one.along_mm))
    rng = np.random.default_rng(3)
    t = np.arange(0.0, now, 0.05)
    y = np.interp(t, *zip(*way, strict=True)) + 1e-5 * rng.normal(size=t.size)
    start = np.array(places[0].target_mm)
    beam = np.array(next(s.beam for s in plan.steps if isinstance(s, MountLaser)))
    delay = 2e-3 + rng.exponential(2e-3, (2, t.size))
    laser = [
        LaserReading(5.0 + s + d, k, int(s * 1e6), round(v / MM_PER_COUNT), 900, COMPENSATED, 20.0, 101325.0, 50.0, 2.7e-4)
        for k, (s, v, d) in enumerate(zip(t, y, delay[0], strict=True))
    ]
    status = [
        controller_status(Condition(0), host_s=5.0 + s + d, ctrl_us=int((s + 100.0) * 1e6), position_mm=tuple(start + v * beam))
        for s, v, d in zip(t, y, delay[1], strict=True)
    ]
    return plan, Heard(laser, status[::3])


class Devices:
    """A session whose laser and fixture do as they are told."""

    def __init__(self, heard):
        self.heard, self.controller = heard, self

    def need_laser(self):
        return self

    need_fixture = need_laser

    async def status(self):
        return self.heard.statuses[0]

    async def nothing(self, *words):
        return None

    clear_beam = set_environment_compensation = zero = mount_laser = nothing


async def listened(recipe, lost, monkeypatch):
    plan, heard = world(recipe, lost)

    async def hear(*words):
        return heard

    async def there(*words):
        return None

    monkeypatch.setattr(listen, "_hear", hear)
    monkeypatch.setattr(listen, "_at_start", there)
    recorder, said = Recorder(), []
    end = await listen.listen_to(Devices(heard), recorder, plan, said.append)
    return plan, columns_of(plan, recorder.records).to_document(), end, said


@pytest.mark.parametrize("kind", KINDS)
async def test_a_missing_reading_is_an_invalid_row_in_its_place(kind, monkeypatch):
    lost = {2, 9}
    plan, columns, end, said = await listened(KINDS[kind], lost, monkeypatch)
    places = planned_readings(plan)
    assert [k for k, valid in enumerate(columns["valid"]) if not valid] == sorted(lost)
    for k, one in enumerate(places):
        assert [columns[f"{a}_mm"][k] for a in "xyz"] == list(one.target_mm)
        assert columns["direction"][k] == one.direction
    assert len(columns["t_s"]) == len(places)
    assert (np.diff(columns["t_s"]) > 0.0).all()
    assert [columns["deviation_mm"][k] for k in lost] == [0.0, 0.0]
    assert np.abs(columns["deviation_mm"]).max() < 1e-4
    assert len(end["standstills"]["missing"]) == 2
    assert sum("is missing" in text for text in said) == 2


async def test_the_solvers_see_the_same_travel_as_if_nothing_had_been_lost(monkeypatch):
    """An absent row would hide which way an axis came; an invalid one does not."""
    runs = []
    for lost in (set(), {2, 9}):
        plan, columns, _, _ = await listened(KINDS["step diagonal"], lost, monkeypatch)
        runs.append(run_data(run_of({"run_id": "r", "test": plan.test, "setup": plan.setup.document, "columns": columns})))
    whole, less = runs
    keep = np.setdiff1d(np.arange(len(whole.t_s)), [2, 9])
    assert (less.sign == whole.sign[keep]).all()
    assert less.axes_mm == pytest.approx(whole.axes_mm[keep])


async def test_where_the_first_reading_is_missing_the_others_count_from_the_first_that_is_there(monkeypatch):
    records = []
    plan = KINDS["line"].plan(MACHINE)
    for k, one in enumerate(planned_readings(plan)):
        told = (
            {"displacement_tenth_nm": round((one.along_mm + 5e-3) / MM_PER_COUNT)} if k else {"displacement_tenth_nm": 0, "missing": True}
        )
        about = {"ctrl_us": 1_000_000 * k, "status": COMPENSATED, "signal_permille": 900, "air_temp_c": 20.0, "air_pressure_pa": 101325.0}
        records.append(told | about | {"target_mm": list(one.target_mm), "direction": one.direction, "feed_mm_min": 0.0})
    columns = columns_of(plan, records).to_document()
    assert columns["valid"][0] == 0
    run = {"run_id": "r", "test": plan.test, "setup": plan.setup.document, "columns": columns}
    assert np.abs(run_data(run_of(run)).deviation_mm).max() < 1e-6


def test_times_of_missing_readings_lie_between_their_neighbours():
    class Seen:
        def __init__(self, middle):
            self.start_s, self.end_s = middle - 0.1, middle + 0.1

    assert row_times([Seen(10.0), None, None, Seen(16.0)], 0.0, 1.0) == pytest.approx([10.0, 12.0, 14.0, 16.0])
    assert row_times([None, None, Seen(9.0), None], 0.0, 1.5) == pytest.approx([3.0, 6.0, 9.0, 10.5])
    assert (np.diff(row_times([None, Seen(0.0)], 5.0, 1.0)) > 0.0).all()
