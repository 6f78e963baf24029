"""Causes and cures are facts about the runs at hand: what is there already is not called missing, and not recommended again."""

from dataclasses import replace

import numpy as np
import pytest

from abbe.models.paths import diagonal_ends, step_diagonal
from abbe.models.solvers.assessment import observability
from abbe.models.solvers.observability.cures import STEP_ORDERS, additions, present
from abbe.models.solvers.observability.rank import Knowledge
from tests.models.solvers.observability_cases import FXYZ, ONE, TEN, YANG, YANG_EXPERIMENTS, laser, wang_diagonals, wang_lines

PLAIN = YANG_EXPERIMENTS["d3"].runs


def told(machine, runs, order):
    report = observability(machine, runs, terms=order)
    return " ".join([g.text for g in report.hidden] + [a.text for a in report.advice])


def offered(machine, runs, known=None, names=()):
    return {a.key: a for a in additions(machine, runs, known or Knowledge(), names, 2)}


def test_a_campaign_of_a_line_along_x_is_not_told_to_measure_x():
    text = told(FXYZ, wang_lines("X"), 1)
    assert "nothing here measures X" not in text
    assert "a laser line along X " not in text.replace("another laser line along X at", "")
    assert "X alone was measured along one line only (Y = 0 mm, Z = 0 mm)" in text
    assert "another laser line along X at Y = 450 mm, Z = 360 mm" in text
    assert "nothing here measures Y alone against a known length" in text
    assert "None of the usual additional measurements alone would show it" in text


def test_another_line_stands_where_none_is_yet():
    """Lines on two opposite edges: the next one stands on a third, and "opposite edges" are not missing."""
    runs = wang_lines("XYZ", (0, 1))
    found = offered(FXYZ, runs)
    inner = FXYZ.stroke_mm + 0.1 * FXYZ.length_mm[:, None] * np.array([1.0, -1.0])
    for axis in "XYZ":
        k = "XYZ".index(axis)
        places = [found[f"line {axis}"].runs[0].axes_mm[0], *(r.axes_mm[0] for r in found["edges"].runs if r.beam[k] == 1.0)]
        assert len(places) == 3
        for place in places:
            side = [bool(place[m] > inner[m].mean()) for m in range(3) if m != k]
            assert side[0] != side[1]  # the two edges that have no line
        assert "along 2 lines only" in found[f"line {axis}"].cause
    assert found["edges"].cause == "the laser lines here stand on too few edges"
    assert found["edges"].cure == "laser lines along X, Y and Z on two more edges"
    one_edge = offered(FXYZ, wang_lines("XYZ"))["edges"]
    assert one_edge.cause == "the laser lines here do not stand on opposite edges in all three axes"
    assert offered(YANG, ONE)["edges"].cause == "there are no laser lines here"


def test_plain_diagonals_are_not_called_stepped():
    text = told(YANG, PLAIN, 1)
    assert "stepped in one order" not in text
    assert "the diagonals here were run straight, without steps. It would be seen with four step diagonals" in text
    assert (present(PLAIN).plain, present(PLAIN).stepped) == (4, ())


@pytest.mark.parametrize("order", STEP_ORDERS)
def test_the_second_order_of_steps_is_not_the_first(order):
    runs = wang_diagonals((order,))
    assert present(runs).orders == (order,)
    assert present(runs).diagonals == 4
    cure = offered(FXYZ, runs)["diagonals"]
    assert cure.cause == f"all step diagonals were stepped in one order ({order})"
    second = "ZYX" if order == "XYZ" else "XYZ"
    assert cure.cure == f"step diagonals in a second step order ({second})"
    assert present(cure.runs).orders == (second,)


def test_two_orders_and_too_few_diagonals_are_counted():
    both = offered(FXYZ, wang_diagonals(("XYZ", "ZYX")))["diagonals"]
    assert both.cause == "the diagonals were stepped in XYZ and ZYX only"
    assert present(both.runs).orders[0] not in ("XYZ", "ZYX")
    back = laser("b", step_diagonal(*diagonal_ends(FXYZ.stroke_mm, "npp")[::-1], 20, "ZXY", back=True))
    forth = laser("f", step_diagonal(*diagonal_ends(FXYZ.stroke_mm, "npp"), 20, "ZXY", back=False))
    assert present((back, forth)).diagonals == 1  # from either end it is the same diagonal
    assert offered(FXYZ, (forth,))["diagonals"].cause == "only 1 of the four body diagonals was stepped (ZXY)"


def test_bars_that_were_not_there_stood_nowhere():
    assert offered(FXYZ, wang_lines("X"))["centres"].cause == "no ball-bar was used"
    assert offered(YANG, ONE)["centres"].cause == "the ball-bar stood at one place only"
    assert offered(YANG, TEN)["centres"].cause == f"the ball-bar stood at {len({tuple(r.centre_mm) for r in TEN})} places only"
    assert "too few places" not in told(FXYZ, wang_lines("X"), 1)


def test_the_bar_that_is_not_calibrated_is_named_where_another_is():
    names = ("bar_length_175", "bar_length_100")
    assert offered(YANG, TEN, names=names)["bar"].cause == "no bar length here is calibrated"
    held = Knowledge({"bar_length_100": np.zeros(1)})
    assert offered(YANG, TEN, held, names)["bar"].cause == "the length of the bar of 175 mm is not calibrated"
    assert "bar" not in offered(YANG, (replace(ONE[0], u_length_mm=1e-3),), Knowledge({"bar_length_175": np.zeros(1)}), names[:1])
