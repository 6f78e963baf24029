"""Clearance of the probe: obstacles as boxes in the artefact's axes, the shaft of the stylus, the body of the probe, tilted artefacts."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from abbe.service.domain.artefact import ArtefactObject, Obstacle
from abbe.service.errors import ConfigError
from abbe.service.sequences.recipes.artefact import ArtefactTest
from abbe.service.sequences.recipes.clearance import Boxes, ProbePart
from tests.faults.sequencer_world import MACHINE, PLATE

HOLES = ArtefactTest("p0", "P0", "identify", "A", (250.0, 200.0, 200.0), plate=PLATE)
BALLS = PLATE.model_copy(update={"features": [f.model_copy(update={"sensed": "xyz"}) for f in PLATE.features]})


def box(low: tuple[float, float, float], high: tuple[float, float, float]) -> dict[str, Any]:
    return {"id": "clamp", "low_mm": low, "high_mm": high}


def beside(plate: ArtefactObject, *boxes: dict[str, Any]) -> ArtefactObject:
    return plate.model_copy(update={"obstacles": [Obstacle.read(b) for b in boxes]})


@pytest.mark.parametrize("turn", [0.0, 90.0, 180.0])
def test_a_clamp_between_two_holes_is_named_with_the_feature_however_the_plate_lies(turn):
    clamp = beside(PLATE, box((30.0, -10.0, 0.0), (45.0, 10.0, 18.0)))
    test = replace(HOLES, plate=clamp, rotation_deg=(0.0, 0.0, turn))
    with pytest.raises(ConfigError, match=r"feature B1: the stylus comes within -1\.0 mm of clamp"):
        test.plan(MACHINE)
    replace(test, clear_mm=23.0).plan(MACHINE)  # 20 above its top, less the ball
    replace(test, plate=beside(PLATE, box((30.0, -60.0, 0.0), (45.0, -12.0, 18.0)))).plan(MACHINE)  # beside the way


def test_a_wall_is_met_by_the_shaft_or_the_body_before_the_ball_meets_it():
    wall = beside(PLATE, box((-40.0, -40.0, 30.0), (-11.0, 200.0, 120.0)))  # its foot is above the ball
    thin = replace(HOLES, plate=wall, shaft_radius_mm=1.5)
    thin.plan(MACHINE)  # touches of A1 reach 7.8 out
    with pytest.raises(ConfigError, match=r"feature A1: the shaft of the stylus comes within 0\.2 mm of clamp"):
        replace(thin, shaft_radius_mm=None).plan(MACHINE)
    with pytest.raises(ConfigError, match=r"feature A1: the body of the probe comes within -\d+\.\d mm of clamp"):
        replace(thin, stylus_length_mm=50.0, body_radius_mm=18.0).plan(MACHINE)
    replace(thin, stylus_length_mm=150.0, body_radius_mm=18.0).plan(MACHINE)


def test_the_body_must_reach_neither_the_plate_nor_the_ball_that_is_touched():
    with pytest.raises(ConfigError, match="the body of the probe would reach the plate: the stylus is 6 mm long"):
        replace(HOLES, stylus_length_mm=6.0).plan(MACHINE)
    with pytest.raises(ConfigError, match=r"feature A1: the body of the probe comes within -2\.0 mm of A1"):
        replace(HOLES, plate=BALLS, stylus_length_mm=8.0).plan(MACHINE)
    replace(HOLES, plate=BALLS, stylus_length_mm=12.0).plan(MACHINE)


def test_between_the_balls_of_a_steep_plate_the_body_meets_the_next_row():
    steep = replace(HOLES, plate=BALLS, rotation_deg=(40.0, 0.0, 0.0))
    steep.plan(MACHINE)
    with pytest.raises(ConfigError, match=r"the body of the probe comes within -\d+\.\d mm of [ABC]2"):
        replace(steep, stylus_length_mm=40.0, body_radius_mm=40.0).plan(MACHINE)


def test_the_shaft_in_a_tilted_hole_counts_where_it_is_stated():
    tilted = replace(HOLES, rotation_deg=(1.8, 0.0, 0.0), depth_mm=40.0, stylus_length_mm=60.0)
    replace(tilted, shaft_radius_mm=1.5).plan(MACHINE)
    with pytest.raises(ConfigError, match="its hole is tilted by 2 degrees"):
        replace(tilted, shaft_radius_mm=2.5).plan(MACHINE)


def test_the_gap_between_a_box_and_a_leaning_cylinder_is_exact():
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    boxes = Boxes.of([Obstacle.read(box((10.0, -5.0, 20.0), (30.0, 5.0, 25.0)))], (100.0, 50.0, 0.0), turn)
    along = np.array([0.0, 1.0, 1.0]) / np.sqrt(2.0)  # in the artefact's axes: along x and z
    (gap,) = boxes.gaps_mm(np.array([[100.0, 50.0, 0.0]]), along, ProbePart("p", 2.0, 0.0, 100.0))
    assert gap == pytest.approx(-2.0, abs=1e-3), "the axis passes through the box"
    (gap,) = boxes.gaps_mm(np.array([[100.0, 50.0, 0.0]]), along, ProbePart("p", 2.0, 0.0, 20.0))
    assert gap == pytest.approx(20.0 - 20.0 / np.sqrt(2.0) - 2.0, abs=1e-3), "it ends below the box"


def test_a_box_whose_corners_are_exchanged_is_refused():
    with pytest.raises(ValueError, match="obstacle clamp: every coordinate of low_mm must be below"):
        Obstacle.read(box((10.0, 0.0, 0.0), (5.0, 10.0, 10.0)))
