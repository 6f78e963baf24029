"""How a run was driven: turns between two readings, the run-in, velocities, and the sensors that effects follow."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from abbe.models.effects.columns import along, before_first_turn, commanded_turns, play, rise_of, turn_between, warmth
from abbe.models.effects.path import FAR_MM, Places, driven
from abbe.models.effects.self_test import probe_paths

RADIUS_MM, FEED = 150.0, 1200.0


def circle(start_rad: float, n: int = 181, turns: float = 1.0) -> tuple[Places, np.ndarray[tuple[int], np.dtype[np.float64]]]:
    """Places of a circle in XY, positions rounded as in the exchange files, and its angles."""
    angle = start_rad + np.linspace(0.0, 2.0 * np.pi * turns, n)
    q = np.round(RADIUS_MM * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(n)]), 4)
    t = (angle - start_rad) * RADIUS_MM / (FEED / 60.0)
    return driven(q, t, np.full(n, FEED), dwelling=False, temp_c={}), angle


@pytest.mark.parametrize("direction", [3, -1, "X"])
def test_a_direction_that_is_no_axis_is_refused_where_it_stands(direction) -> None:
    with pytest.raises(ValueError, match=r"along: direction .*, expected the index of an axis: 0 \(X\), 1 \(Y\) or 2 \(Z\)"):
        along(direction, np.ones(4))


@settings(max_examples=30, deadline=None)
@given(start=st.floats(0.2, 1.3))
def test_a_turn_is_where_the_axis_comes_to_rest(start: float) -> None:
    """X turns at 180 degrees wherever the samples are: direction and travel since then follow the circle, not the samples."""
    at, angle = circle(start)
    after = (angle > np.pi + 0.002) & (angle < np.pi + 0.5)
    assert (at.sign[after, 0] == 1.0).all()
    assert (at.sign[(angle < np.pi - 0.002), 0] == -1.0).all()
    np.testing.assert_allclose(at.since_mm[after, 0], RADIUS_MM * (1.0 + np.cos(angle[after])), rtol=5e-3, atol=2e-3)
    assert (at.sign[:, 2] == 0.0).all()
    assert (at.since_mm[:, 2] == FAR_MM).all()


def test_a_test_that_starts_at_a_turn_has_turned() -> None:
    """A circle from the X axis on comes from the other side: X has turned at its first reading."""
    at, angle = circle(0.0)
    near = angle < 0.5
    np.testing.assert_allclose(at.since_mm[near, 0], RADIUS_MM * (1.0 - np.cos(angle[near])), atol=5e-3)
    assert at.since_mm[5, 1] == FAR_MM
    np.testing.assert_allclose(before_first_turn(at, 1)[near], RADIUS_MM * np.sin(angle[near]), atol=1e-3)
    assert (before_first_turn(at, 0)[1:] == FAR_MM).all()


def test_velocity_is_that_of_the_arc_and_not_of_its_chord() -> None:
    at, angle = circle(0.3, n=41)
    v = FEED / 60.0
    inner = slice(3, -3)
    np.testing.assert_allclose(at.v_mm_s[inner, 0], -v * np.sin(angle[inner]), atol=5e-4 * v)
    np.testing.assert_allclose(np.linalg.norm(at.v_mm_s, axis=1), v)


def test_a_play_waits_where_the_command_turned() -> None:
    at, _ = circle(0.3, n=1441)
    sign, since = commanded_turns(at, 0)
    inside = (since > 0.0) & (since < 0.05)
    assert inside.any()
    moved = play(at, 0, 0.05)
    np.testing.assert_allclose(moved[inside], sign[inside] * (2.0 * since[inside] / 0.05 - 1.0))
    outside = (since > 0.05) & (since < FAR_MM)
    np.testing.assert_array_equal(moved[outside], sign[outside])
    assert np.count_nonzero(turn_between(at, 0)) <= 6  # only at the turns


def test_a_step_test_dwells() -> None:
    q = np.repeat(np.arange(5.0), 3)[:, None] * np.array([[1.0, 0.0, 0.0]])
    at = driven(q, np.arange(15.0), np.full(15, 3000.0), dwelling=True, temp_c={})
    assert not at.v_mm_s.any()
    assert not at.a_mm_s2.any()
    assert (before_first_turn(at, 0) == FAR_MM).all()


def test_a_sensor_is_smoothed_and_has_a_value_between_the_runs() -> None:
    rise = rise_of(probe_paths(), "z")
    assert rise is not None
    t = np.array([1000.0, 5000.0, 12000.0])
    tau_s, final_k = 1500.0 + 900.0 * 2, 3.0
    first = -np.expm1(-10.0 / tau_s)
    np.testing.assert_allclose(rise(t), final_k * (-np.expm1(-t / tau_s) - first), atol=0.06)
    assert rise_of(probe_paths(), "none") is None


def test_warmth_begins_at_the_campaigns_zero() -> None:
    assert warmth(np.array([-5.0, 0.0]), 100.0) == pytest.approx([0.0, 0.0])
    assert warmth(np.array([100.0]), 100.0)[0] == pytest.approx(1.0 - np.exp(-1.0))
