"""The bridge's own decisions, without a control: what goes into curves, what into files, what is refused; and that its files fit it."""

from __future__ import annotations

import importlib
import struct
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from abbe.drivers.tables import TableImage, crc32, decode, encode
from tests.linuxcnc.instance import DEPLOY


@pytest.fixture
def bridge(monkeypatch):
    """The bridge's modules, imported as its own process does."""
    names = ("network", "image", "files", "banks", "modbus", "motion")
    monkeypatch.syspath_prepend(str(DEPLOY))
    yield SimpleNamespace(**{name: importlib.import_module(name) for name in names})
    for name in names:
        sys.modules.pop(name, None)


class Networks:
    """A control that takes every value, or none."""

    def __init__(self) -> None:
        self.loaded, self.selected, self.obeys = {}, [], True

    def load(self, bank, network) -> bool:
        self.loaded[bank] = network
        return self.obeys

    def select(self, bank) -> bool:
        self.selected.append(bank)
        return True


def words(image: TableImage) -> list[int]:
    data = encode(image)
    return list(struct.unpack(f">{len(data) // 2}H", data))


def at(curve, q: float) -> float:
    x, y = zip(*curve, strict=True)
    return float(np.interp(q, x, y))


def applied(plan, p) -> np.ndarray:
    """What the network and the files add at a place."""
    q = {a: float(np.clip(v, *plan.network.ends_mm[a])) for a, v in zip("xyz", p, strict=True)}
    out = dict.fromkeys("xyz", 0.0)
    for (a, i), curve in plan.network.shifts.items():
        out[i] += at(curve, q[a])
    for (a, k, i), curve in plan.network.levers.items():
        out[i] += at(curve, q[a]) * q[k]
    for a, curve in plan.files.items():
        out[a] += at(curve, q[a])
    return np.array(list(out.values()))


def rigid_grid(rng, bend: float = 0.0) -> tuple[TableImage, np.ndarray]:
    """A grid as carriages make one: shifts, and angles times lever arms; ``bend``: something that they cannot."""
    counts, step = (5, 4, 6), 100.0
    axes = [step * np.arange(n) for n in counts]
    p = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    value = np.zeros((*counts, 3))
    for a in range(3):
        shape = [1, 1, 1]
        shape[a] = counts[a]
        for i in range(3):
            value[..., i] += rng.normal(0, 300, counts[a]).reshape(shape)
            for k in range(3):
                if k not in (a, i):
                    value[..., i] += rng.normal(0, 0.5, counts[a]).reshape(shape) * p[..., k]
    value[..., 0] += bend * (p[..., 1] / 100) ** 2 * (p[..., 2] / 100) ** 2
    rounded = np.rint(value).astype(int)
    body = tuple(int(v) for v in np.moveaxis(rounded, (0, 1, 2), (2, 1, 0)).reshape(-1))
    return TableImage(2, 1, 100, (0.0, 0.0, 0.0), (step,) * 3, counts, body), rounded


@pytest.mark.parametrize("seed", range(5))
def test_a_grid_of_rigid_carriages_becomes_curves_that_meet_every_node(bridge, seed):
    image, values = rigid_grid(np.random.default_rng(seed))
    plan = bridge.image.plan(words(image))
    assert plan.worst_lsb < bridge.image.GRID_TOLERANCE_LSB
    worst = 0.0
    for node in np.ndindex(values.shape[:3]):
        worst = max(worst, np.abs(applied(plan, 100.0 * np.array(node)) * 1e4 - values[node]).max())
    assert worst == pytest.approx(plan.worst_lsb, abs=1e-6)
    outside, edge = applied(plan, (-50.0, 900.0, 200.0)), applied(plan, (0.0, 300.0, 200.0))
    assert outside == pytest.approx(edge)  # ends are held


def test_a_grid_that_no_carriages_make_is_refused(bridge):
    with pytest.raises(bridge.image.ImageError, match="lever arms"):
        bridge.image.plan(words(rigid_grid(np.random.default_rng(1), bend=2.0)[0]))


def test_points_on_a_straight_line_cost_nothing_and_corners_decide_where_a_table_goes(bridge):
    n = 200
    straight = tuple(range(n))
    corners = tuple(abs(k % 20 - 10) for k in range(n))  # 20 corners: too many for a curve
    rest = (0,) * (3 * 2 + 3 * 2)
    shape = {"start_mm": (0.0, 0.0, 0.0), "step_mm": (1.0, 100.0, 100.0), "counts": (n, 2, 2)}
    plan = bridge.image.plan(words(TableImage(1, 1, 100, values=corners + straight + straight + rest, **shape)))
    assert set(plan.files) == {"x"}
    assert len(plan.network.shifts["x", "y"]) == 2
    assert applied(plan, (33.5, 0.0, 0.0)) == pytest.approx([3.5e-4, 33.5e-4, 33.5e-4])
    with pytest.raises(bridge.image.ImageError, match=r"correction of y by x has \d+ corners, more than 16"):
        bridge.image.plan(words(TableImage(1, 1, 100, values=straight + corners + straight + rest, **shape)))


@pytest.mark.parametrize("spoil", [(0, 1), (1, 2), (2, 7), (3, 25), (6, 10), (7, 1), (8, 1)])
def test_what_is_no_image_is_refused(bridge, spoil):
    spoilt = words(TableImage(1, 1, 100, (0.0,) * 3, (1.0,) * 3, (2, 2, 2), (0,) * 18))
    spoilt[spoil[0]] = spoil[1]
    with pytest.raises(bridge.image.ImageError):
        bridge.image.plan(spoilt)


def test_the_empty_image_is_one(bridge):
    data = bridge.image.data_of(bridge.image.empty())
    assert decode(data).kind == 0
    assert bridge.image.checksum(bridge.image.empty()) == crc32(data)


def test_the_hal_file_is_what_the_program_writes(bridge):
    assert (DEPLOY / "volumetric.hal").read_text() == bridge.network.hal_text()


def test_a_file_table_has_bare_triples_only(bridge):
    text = bridge.files.text_of(((0.0, 0.0), (100.0, -0.0125)))
    assert text == "0.00000 0.000000 0.000000\n100.00000 -0.012500 -0.012500\n"
    assert len(bridge.files.text_of(()).splitlines()) == 2  # and an empty one is two zeros, not nothing


def test_a_table_set_is_exchanged_whole_and_a_hand_edit_is_found(bridge, tmp_path):
    sets = bridge.files.TableSets(tmp_path)
    sets.prepare()
    assert sets.acting(fresh_start=True) == bridge.image.empty()
    table = words(TableImage(1, 1, 100, (0.0,) * 3, (1.0, 100.0, 100.0), (200, 2, 2), tuple(k % 3 for k in range(200)) + (0,) * 412))
    sets.stage(table)
    assert sets.staged() == table
    assert sets.acting(fresh_start=False) == bridge.image.empty()  # the control has not read it yet
    assert sets.acting(fresh_start=True) == table
    file = tmp_path / "tables" / "x.comp"
    file.write_text("# corrected by hand\n" + file.read_text())
    with pytest.raises(bridge.files.TablesAltered, match=r"x\.comp"):
        sets.acting(fresh_start=False)


def test_banks_keep_the_old_table_when_the_control_does_not_take_the_new_one(bridge, tmp_path):
    sets, control = bridge.files.TableSets(tmp_path), Networks()
    sets.prepare()
    banks = bridge.banks.Banks(control, sets, sets.staged())
    image = words(TableImage(1, 1, 100, (0.0,) * 3, (1.0,) * 3, (2, 2, 2), tuple(range(18))))
    assert banks.lease(5, 1000, 0.0) == 0
    assert banks.write(1, 0, image)
    assert not banks.write(0, 0, image)
    assert banks.seal(1, 6, 0.5) == 7
    assert banks.seal(1, 5, 0.5) == 0
    expected = (banks.crcs[1], banks.generation)
    assert banks.activate(1, 5, (expected[0] ^ 1, expected[1]), may_act=True, now_s=0.5) == 3
    assert banks.activate(1, 5, (expected[0], expected[1] - 1), may_act=True, now_s=0.5) == 4
    assert banks.activate(1, 5, expected, may_act=False, now_s=0.5) == 2
    assert banks.activate(1, 5, expected, may_act=True, now_s=1.5) == 7  # the lease has run out
    control.obeys = False
    assert banks.activate(1, 5, expected, may_act=True, now_s=0.5) == 2
    assert (banks.active, control.selected[-1]) == (0, 0)
    control.obeys = True
    assert banks.activate(1, 5, expected, may_act=True, now_s=0.5) == 0
    assert (banks.active, control.selected[-1], banks.generation) == (1, 1, expected[1] + 1)


@pytest.mark.parametrize(
    ("request_", "reply"),
    [
        ("03 00 00 00 02", "03 04 00 00 00 01"),
        ("03 00 09 00 02", "83 02"),
        ("03 00 00 00 7e", "83 03"),
        ("03 00", "83 03"),
        ("06 00 01 00 07", "06 00 01 00 07"),
        ("10 00 00 00 01 02 00 05", "10 00 00 00 01"),
        ("10 00 00 00 02 02 00 05", "90 03"),
        ("05 00", "85 01"),
    ],
)
def test_modbus_requests_are_answered_or_refused(bridge, request_, reply):
    class Ten:
        def read(self, address, count):
            return list(range(10))[address : address + count] if address + count <= 10 else None

        def write(self, address, words):
            return address + len(words) <= 10

    assert bridge.modbus.answer(Ten(), bytes.fromhex(request_)) == bytes.fromhex(reply)


class Idle:
    """A control that stands still and does nothing: what a line that it has just accepted looks like until its servo thread runs."""

    low_mm, high_mm, fastest_mm_s = (0.0,) * 3, (600.0,) * 3, 100.0

    def __init__(self) -> None:
        quiet = ("estop", "interpreting", "refused", "spindle", "door_open", "probe_ready", "deflected", "tripped")
        ready = ("drives_on", "homed", "ready", "in_position", "remote")
        self.shown = SimpleNamespace(**dict.fromkeys(quiet, False), **dict.fromkeys(ready, True), position_mm=(0.0,) * 3, queue=0, line=0)

    def snapshot(self) -> SimpleNamespace:
        return SimpleNamespace(**vars(self.shown))

    def shows(self, **state) -> None:
        vars(self.shown).update(state)

    def nothing(self, *_: object, **__: object) -> None:
        return None

    hold = path_output = complaints = mdi = run = abort = nothing


@pytest.fixture
def moved(bridge, tmp_path):
    """A motion that has been commanded, its control, and the clock, us."""
    control, clock = Idle(), [1]
    motion = bridge.motion.Motion(control, lambda: clock[0], tmp_path / "path.ngc")
    assert motion.move((10.0, 0.0, 0.0), 1000.0) == bridge.motion.Result.OK
    return motion, control, clock


def test_a_motion_is_not_over_before_the_servo_thread_has_begun_it(moved):
    motion, control, clock = moved
    for _ in range(5):
        clock[0] += 300_000
        motion.tick()
        assert motion.moving
    control.shows(ready=False, in_position=False, queue=1)
    motion.tick()
    control.shows(ready=True, in_position=True, queue=0, position_mm=(10.0, 0.0, 0.0))
    motion.tick()
    assert (motion.moving, motion.done) == (False, 1)


def test_a_closed_path_is_not_over_before_it_has_begun(bridge, tmp_path):
    control, clock = Idle(), [1]
    motion = bridge.motion.Motion(control, lambda: clock[0], tmp_path / "path.ngc")
    motion.fifo = [(10.0, 0.0, 0.0), (10.0, 10.0, 0.0), (0.0, 0.0, 0.0)]
    assert motion.path_start(1000.0) == bridge.motion.Result.OK
    motion.tick()
    assert (motion.path_running, motion.points_done, motion.in_position_us) == (True, 0, 0)
    control.shows(ready=False, in_position=False, queue=2, position_mm=(5.0, 0.0, 0.0))
    motion.tick()
    clock[0] += 1_000_000
    control.shows(ready=True, in_position=True, queue=0, position_mm=(0.0, 0.0, 0.0))
    motion.tick()
    assert (motion.path_running, motion.points_done, motion.path_end_us, motion.done) == (False, 3, clock[0], 1)


def test_a_motion_too_short_to_be_seen_counts(bridge, tmp_path):
    control, clock = Idle(), [1]
    motion = bridge.motion.Motion(control, lambda: clock[0], tmp_path / "path.ngc")
    assert motion.move((0.0, 0.0, 0.0), 1000.0) == bridge.motion.Result.OK
    for _ in range(3):
        clock[0] += 150_000
        motion.tick()
    assert (motion.moving, motion.done) == (False, 1)


def test_a_line_that_the_control_refuses_ends_and_counts_for_nothing(moved):
    motion, control, clock = moved
    control.shows(refused=True)
    for _ in range(3):
        clock[0] += 150_000
        motion.tick()
    assert (motion.moving, motion.done) == (False, 0)


def test_an_aborted_motion_is_over_at_once(moved, bridge):
    motion, _, clock = moved
    motion.request_hold(bridge.motion.Hold.ABORT)
    clock[0] += 1
    motion.tick()
    assert (motion.moving, motion.done) == (False, 1)
