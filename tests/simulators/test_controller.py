import numpy as np
import pytest

from abbe.simulators.cnc.device import ALARM_ESTOP, FIFO_SIZE, Controller, Hold, Result
from abbe.simulators.scenario import MachineConfig
from abbe.simulators.truth.machine import Geometry

START = [300.0, 250.0, 225.0]


@pytest.fixture
def cnc() -> Controller:
    return Controller(Geometry(MachineConfig()))


def at(*values: float) -> np.ndarray:
    return np.array(values, dtype=float)


def test_move_takes_its_time(cnc: Controller) -> None:
    assert cnc.move(at(400, 250, 225), 6000.0) == Result.OK  # 100 mm at 100 mm/s
    assert cnc.moving
    assert not cnc.in_position
    np.testing.assert_allclose(cnc.commanded(at(0.0, 0.25, 1.0, 5.0))[:, 0], [300, 325, 400, 400])
    cnc.advance(0.5)
    np.testing.assert_allclose(cnc.position_mm, [350, 250, 225])
    cnc.advance(3.0)
    assert not cnc.moving
    assert cnc.in_position
    assert (cnc.in_position_s, cnc.motions_done) == (pytest.approx(1.0), 1)
    assert cnc.position_mm.tolist() == [400, 250, 225]


@pytest.mark.parametrize("target", [(600.001, 0, 0), (0, -0.001, 0), (0, 0, 451)])
def test_stroke_limit_is_refused_before_anything_moves(cnc: Controller, target: tuple[float, ...]) -> None:
    assert cnc.move(at(*target), 1000.0) == Result.STROKE_LIMIT
    assert not cnc.moving
    assert cnc.fifo_push(np.array([START, list(target)])) == Result.STROKE_LIMIT
    assert cnc.fifo_free == FIFO_SIZE


def test_ends_of_the_stroke_can_be_reached(cnc: Controller) -> None:
    assert cnc.move(at(600, 500, 450), 1000.0) == Result.OK


def test_other_refusals(cnc: Controller) -> None:
    assert cnc.move(at(*START), 0.0) == Result.BAD_ARGUMENT
    assert cnc.path_start(1000.0) == Result.BAD_ARGUMENT, "an empty path"
    assert cnc.move(at(0, 0, 0), 1000.0) == Result.OK
    assert cnc.move(at(1, 1, 1), 1000.0) == Result.BUSY
    assert cnc.path_start(1000.0) == Result.BUSY
    assert cnc.path_clear() == Result.BUSY


@pytest.mark.parametrize("switch", ["estop", "door_open", "program_running", "spindle_turning"])
def test_interlocks_that_must_be_clear(cnc: Controller, switch: str) -> None:
    setattr(cnc.switches, switch, True)
    assert cnc.move(at(0, 0, 0), 1000.0) == Result.INTERLOCK


@pytest.mark.parametrize("switch", ["remote", "referenced"])
def test_interlocks_that_must_be_set(cnc: Controller, switch: str) -> None:
    setattr(cnc.switches, switch, False)
    assert cnc.move(at(0, 0, 0), 1000.0) == Result.INTERLOCK


def test_path_runs_at_constant_feed_along_the_polyline(cnc: Controller) -> None:
    corner = np.array([[300, 250, 225], [330, 250, 225], [330, 290, 225], [330, 290, 225], [280, 290, 225]], dtype=float)
    assert cnc.fifo_push(corner[:3]) == Result.OK
    cnc.advance(2.0)
    assert cnc.path_start(600.0) == Result.OK  # 10 mm/s; 30 + 40 mm
    assert cnc.fifo_push(corner[3:]) == Result.OK, "a running path is extended"  # + 50 mm
    assert cnc.fifo_free == FIFO_SIZE - 4, "the point it stands on is reached"
    times = np.linspace(2.0, 14.0, 1201)
    track = cnc.commanded(times)
    np.testing.assert_allclose(np.linalg.norm(np.diff(track, axis=0), axis=1)[:290], 0.1, atol=1e-9)
    level = cnc.sync_level(at(1.999, 2.0, 8.0, 13.999, 14.0, 14.1))
    assert level.tolist() == [False, True, True, True, False, False]
    np.testing.assert_allclose(cnc.turning_times(20.0), [5.0, 9.0, 9.0, 14.0])
    cnc.advance(5.0)
    assert (cnc.path_points_done, cnc.path_running, cnc.path_end_s) == (2, True, 0.0)
    cnc.advance(20.0)
    assert (cnc.path_points_done, cnc.path_running, cnc.path_start_s) == (5, False, 2.0)
    assert cnc.path_end_s == pytest.approx(14.0)
    assert cnc.fifo_free == FIFO_SIZE


def test_fifo_full_stores_nothing(cnc: Controller) -> None:
    block = np.tile(START, (FIFO_SIZE - 1, 1))
    assert cnc.fifo_push(block) == Result.OK
    assert cnc.fifo_push(block[:2]) == Result.FIFO_FULL
    assert cnc.fifo_free == 1
    assert cnc.path_clear() == Result.OK
    assert cnc.fifo_free == FIFO_SIZE


def test_hold_stops_and_resumes_on_the_path(cnc: Controller) -> None:
    cnc.move(at(400, 250, 225), 6000.0)
    cnc.advance(0.3)
    cnc.request_hold(Hold.HOLD)
    cnc.request_hold(Hold.HOLD)
    cnc.advance(10.0)
    np.testing.assert_allclose(cnc.position_mm[0], 330.0)
    assert cnc.moving
    cnc.request_hold(Hold.RUN)
    cnc.advance(10.5)
    np.testing.assert_allclose(cnc.position_mm[0], 380.0)
    cnc.advance(11.0)
    assert cnc.in_position_s == pytest.approx(10.7)


def test_override_scales_the_feed(cnc: Controller) -> None:
    cnc.set_override(50)
    cnc.move(at(400, 250, 225), 6000.0)
    cnc.advance(1.0)
    np.testing.assert_allclose(cnc.position_mm[0], 350.0)
    cnc.set_override(100)
    cnc.advance(1.25)
    np.testing.assert_allclose(cnc.position_mm[0], 375.0)


def test_abort_ends_the_path_where_it_is(cnc: Controller) -> None:
    cnc.fifo_push(np.array([[310, 250, 225], [320, 250, 225], [500, 250, 225]], dtype=float))
    cnc.path_start(600.0)
    cnc.advance(2.5)
    cnc.request_hold(Hold.ABORT)
    assert (cnc.moving, cnc.path_running, cnc.motions_done, cnc.path_points_done) == (False, False, 1, 2)
    assert cnc.path_end_s == 2.5
    assert cnc.fifo_free == FIFO_SIZE
    np.testing.assert_allclose(cnc.position_mm, [325, 250, 225])
    assert cnc.move(at(0, 0, 0), 1000.0) == Result.INTERLOCK, "the abort level has to be taken back first"
    cnc.request_hold(Hold.RUN)
    assert cnc.move(at(0, 0, 0), 1000.0) == Result.OK


def test_estop_ends_motion_until_the_alarm_is_reset(cnc: Controller) -> None:
    cnc.move(at(400, 250, 225), 6000.0)
    cnc.advance(0.5)
    cnc.set_estop(pressed=True)
    cnc.advance(5.0)
    np.testing.assert_allclose(cnc.position_mm[0], 350.0)
    assert (cnc.alarm, cnc.drives_on, cnc.in_position, cnc.motions_done) == (ALARM_ESTOP, False, False, 0)
    assert cnc.reset_alarm() == Result.INTERLOCK
    cnc.set_estop(pressed=False)
    assert cnc.move(at(0, 0, 0), 1000.0) == Result.INTERLOCK
    assert cnc.reset_alarm() == Result.OK
    assert cnc.move(at(0, 0, 0), 1000.0) == Result.OK


def test_an_open_door_holds(cnc: Controller) -> None:
    cnc.move(at(400, 250, 225), 6000.0)
    cnc.advance(0.5)
    cnc.set_door(is_open=True)
    cnc.advance(5.0)
    np.testing.assert_allclose(cnc.position_mm[0], 350.0)
    assert cnc.held
    cnc.set_door(is_open=False)
    cnc.advance(6.0)
    assert cnc.in_position
