"""What the functions about Yang's ball-bar refuse, in one clear line."""

import numpy as np
import pytest

from abbe.models.notation.yang import YangErrors
from abbe.models.papers.yang.complete import delta_eq1, difference_eq3, measured_mm, reading_eq6, reading_eq8, second_order_bound_mm
from abbe.models.papers.yang.conditioning import conditioning, fit_eq9
from abbe.models.papers.yang.experiments import YangPlan, all_helices, hemisphere_fits, origin_plan, vector_map
from abbe.models.paths import helix_points, helix_points_likely_code

STROKE = np.array([[0.0, 812.8], [0.0, 495.0], [0.0, 508.0]])
SMALL = np.array([[0.0, 300.0], [0.0, 300.0], [0.0, 300.0]])


def test_origins_outside_the_travel_are_refused_by_number():
    with pytest.raises(ValueError, match="origin 1 at -50, 0, 75 mm"):
        origin_plan(SMALL)
    assert origin_plan(SMALL, ((-150.0, 150.0),))[1].tolist() == [0.0, 0.0, 300.0]  # the very ends are in the travel


@pytest.mark.parametrize("offsets", [((np.nan, 0.0),), ((0.0, np.inf),), ((1.0,),), ((1.0, 2.0, 3.0),)])
def test_offsets_that_are_no_numbers_are_refused(offsets):
    with pytest.raises(ValueError, match="origins"):
        origin_plan(STROKE, offsets)


def test_hemispheres_nowhere_are_refused():
    for origin in (np.array([np.nan, 0.0, 0.0]), np.zeros(2)):
        with pytest.raises(ValueError, match="origin"):
            hemisphere_fits(origin, 100.0, STROKE)
    with pytest.raises(ValueError, match="radius"):
        hemisphere_fits(np.zeros(3), np.nan, STROKE)
    with pytest.raises(ValueError, match="strokes"):
        origin_plan(STROKE * np.nan)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"law": "foo"}, "'foo'"),
        ({"radius_mm": np.nan}, "radius"),
        ({"radius_mm": np.inf}, "radius"),
        ({"turns": np.nan}, "turns"),
        ({"axis": 5}, "axis 5"),
        ({"axis": -1}, "axis -1"),
        ({"n": 1}, "n = 1 must"),
        ({"span_rad": 2.0}, "span"),
        ({"centre_mm": np.zeros(2)}, "centre"),
    ],
)
def test_helices_that_cannot_be_are_refused(change, said):
    with pytest.raises(ValueError, match=said):
        helix_points(**({"centre_mm": np.zeros(3), "radius_mm": 175.0, "turns": 5, "n": 63} | change))


def test_the_papers_helix_wants_numbers_too():
    for radius, turns in ((np.nan, 5), (175.0, np.nan)):
        with pytest.raises(ValueError, match="helix"):
            helix_points_likely_code(np.zeros(3), radius, turns=turns)


@pytest.mark.parametrize("radius", [0.0, -175.0, np.nan, 100.0, 178.0])
def test_equation_9_refuses_a_radius_that_is_not_that_of_its_points(radius):
    points = helix_points(np.array([400.0, 0.0, 250.0]), 175.0, turns=5, n=63)
    with pytest.raises(ValueError, match="radius"):
        fit_eq9(points, np.array([400.0, 0.0, 250.0]), np.zeros(63), radius)


def test_a_bar_has_a_length():
    d = np.array([[175.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    for reading in (reading_eq6, reading_eq8):
        with pytest.raises(ValueError, match="point 1 lies at the centre"):
            reading(d, np.ones((2, 3)))
        with pytest.raises(ValueError, match="shape"):
            reading(d, np.ones((1, 3)))
    for radius in (0.0, np.nan):
        with pytest.raises(ValueError, match="radius"):
            second_order_bound_mm(np.ones((2, 3)), radius)
        with pytest.raises(ValueError, match="radius"):
            measured_mm(d, np.zeros(3), radius)


@pytest.mark.parametrize("design", [np.zeros((5, 3)), np.zeros((0, 3)), np.ones(3), np.full((3, 2), np.nan)])
def test_a_design_that_shows_nothing_has_no_condition(design):
    with pytest.raises(ValueError, match="conditioning"):
        conditioning(design)


def test_errors_at_one_position_are_not_those_of_thirty():
    one = YangErrors(np.zeros((1, 3, 3)), np.zeros((1, 3, 3)))
    for call in (delta_eq1, difference_eq3):
        with pytest.raises(ValueError, match="errors of 1 positions"):
            call(one, np.zeros((30, 3)), np.zeros(3))
        with pytest.raises(ValueError, match="tool"):
            call(one, np.zeros((1, 3)), np.zeros(2))


def test_plans_without_origins_bars_or_known_words_are_refused():
    travel, tool = STROKE[:, 1], np.zeros(3)
    plan = YangPlan(travel, tool, np.array([[400.0, 0.0, 250.0]]), (175.0,), 5.0, 4, 1)
    with pytest.raises(ValueError, match="'x'"):
        all_helices(plan, centres=True, lengths="x")
    with pytest.raises(ValueError, match="tool"):
        vector_map(plan, ())
    with pytest.raises(ValueError, match="origins"):
        YangPlan(travel, tool, np.zeros((0, 3)), (175.0,), 5.0, 4, 1)
    with pytest.raises(ValueError, match="bar"):
        YangPlan(travel, tool, np.zeros((1, 3)), (), 5.0, 4, 1)
