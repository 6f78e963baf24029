"""Which side an axis came from where rows stand: away and back, or never moved."""

from __future__ import annotations

import numpy as np

from abbe.service.domain.machine import machine_from_doc
from abbe.service.runs.cases import path_of
from abbe.service.runs.observations import run_data, with_reversals
from tests.run_documents import run_of
from tests.service.discovery.axis_bench import MACHINE, axis_run, cycles, with_repeats


def test_repeats_at_one_place_come_from_the_side_that_their_direction_says() -> None:
    run = run_of(with_repeats(lambda x: 0.0 * x)[1])
    assert run_data(run).sign[:, 0].tolist() == [1.0, -1.0] * 10
    path = path_of(run, machine_from_doc(MACHINE), 2, 0.0)
    assert path.at.sign[:, 0].tolist() == [1.0, -1.0] * 10
    assert path.at.since_mm.min() >= 5.0


def test_a_turning_point_read_twice_went_beyond_only_where_its_readings_say_so() -> None:
    """ISO 230-2 goes beyond the last place and comes back; a plain line stays there, and the axis has not turned yet."""
    went = cycles(1, lost_um=10.0)[0]
    assert run_data(run_of(went)).sign[11, 0] == -1.0
    stayed = axis_run(1, went["columns"]["x_mm"], went["columns"]["direction"], 1e3 * np.array(went["columns"]["deviation_mm"]))
    stayed["columns"]["deviation_mm"][11] = stayed["columns"]["deviation_mm"][10]
    assert run_data(run_of(stayed)).sign[11, 0] == 1.0


def test_other_tests_and_moving_rows_are_as_they_were() -> None:
    run = cycles(1)[0] | {"test": "laser_diagonal"}
    q = run_of(run).columns.q_mm
    path, rows = with_reversals(run_of(run), q)
    assert path is q
    assert rows.tolist() == list(range(22))
