"""From touches to centres: circle, sphere, repeatability, and the columns of a run."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from abbe.service.domain.document import parsed
from abbe.service.domain.measured import RunStart, TouchRecord
from abbe.service.domain.run import ArtefactPose
from abbe.service.runs.touches import found_feature, qualified_mm, touch_columns

SIDES = [[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0]]
OFF = np.array([0.31, -0.22, 0.0])
START = RunStart.from_document({"ctrl0_us": 0})
POSE = ArtefactPose(origin_mm=np.array([100.0, 80.0, 30.0]), matrix=np.eye(3))


def touched(centre: np.ndarray, radius: float, side: list[float], start: np.ndarray) -> np.ndarray:
    """Where a straight touch from ``start`` along ``side`` meets a sphere or cylinder about ``centre`` from inside."""
    way = np.array(side)
    from_centre = start - centre
    along = from_centre @ way
    return start + (np.sqrt(along**2 + radius**2 - from_centre @ from_centre) - along) * way


def record(centre: np.ndarray, *, ball: bool = False, noise: float = 0.0, **more: Any) -> TouchRecord:
    target, rng = np.array([100.0, 80.0, 30.0]), np.random.default_rng(1)
    sides = [[0.0, 0.0, 1.0], *SIDES] if ball else SIDES
    at = [touched(centre, 7.0, s, target if not ball else centre) for s in sides]
    touches = [[(p + noise * rng.standard_normal() * np.array(s)).tolist() for _ in range(2)] for p, s in zip(at, sides, strict=True)]
    return parsed(TouchRecord, {
        "feature": "A1", "inside": not ball, "nominal_mm": [0.0, 0.0, 0.0], "target_mm": target.tolist(), "sides": sides,
        "touches_mm": touches, "start_deg": 0.0, "ctrl_us": 2_000_000, "feed_mm_min": 100.0,
    } | more)  # fmt: skip


def test_a_hole_beside_its_place_is_found_where_it_is():
    centre = np.array([100.0, 80.0, 30.0]) + OFF
    found = found_feature(record(centre))
    assert found.centre_mm == pytest.approx(centre, abs=1e-9)
    assert (found.radius_mm, found.spread_mm) == pytest.approx((7.0, 0.0), abs=1e-9)


def test_a_ball_is_found_in_all_three_directions():
    centre = np.array([100.0, 80.0, 30.0]) + OFF + [0.0, 0.0, 0.17]
    assert found_feature(record(centre, ball=True)).centre_mm == pytest.approx(centre, abs=1e-9)


def test_columns_have_deviations_in_the_axes_of_the_artefact_and_no_height_of_a_hole():
    quarter = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    start = RunStart.from_document({"ctrl0_us": 1_000_000})
    pose = ArtefactPose(origin_mm=np.array([100.0, 80.0, 36.0]), matrix=np.array(quarter))
    columns = touch_columns([record(np.array([100.0, 80.0, 30.0]) + OFF, noise=1e-3, temperature_C=21.5)], start, pose)
    assert columns.t_s.tolist() == [1.0]
    assert columns.further["deviation_x_mm"][0] == pytest.approx(OFF[1], abs=2e-3)
    assert columns.further["deviation_y_mm"][0] == pytest.approx(-OFF[0], abs=2e-3)
    assert np.isnan(columns.further["deviation_z_mm"]).all()
    assert 1e-4 < columns.further["u_mm"][0] < 2e-3
    assert columns.further["temperature_C"].tolist() == [21.5]


def test_a_control_that_looks_at_the_probe_now_and_then_makes_a_centre_uncertain_by_the_way_between():
    columns = touch_columns([record(np.array([100.0, 80.0, 30.0]), resolution_mm=2e-3)], START, POSE)
    late = np.random.default_rng(1).uniform(0.0, 2e-3, (100_000, 2))
    assert columns.further["u_mm"][0] == pytest.approx(np.std(0.5 * (late[:, 0] - late[:, 1])), rel=0.01)


def test_a_laser_less_run_has_no_temperature():
    columns = touch_columns([record(np.array([100.0, 80.0, 30.0]), ball=True)], START, POSE)
    assert np.isnan(columns.further["temperature_C"]).all()
    assert np.isfinite(columns.further["deviation_z_mm"]).all()


def test_spheres_qualify_the_stylus_and_are_no_rows():
    place = np.array([100.0, 80.0, 30.0])
    spheres = [record(place, ball=True, noise=1e-3, feature="S", radius_mm=7.01, u_sphere_mm=2e-4) for _ in range(2)]
    assert len(touch_columns([spheres[0], record(place), spheres[1]], START, POSE)) == 1
    assert qualified_mm([record(place)], 3.0) is None
    radius, u = qualified_mm(spheres, 3.0) or (0.0, 0.0)
    assert abs(radius - 2.99) < 2.0 * u
    assert 1e-3 < u < 1.5e-3
