"""Nothing is missing is said only where the residuals are the noise that repeats show: on made-up axes, and on real ones (shared)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from abbe.models.discovery.baseline import baseline_of
from abbe.models.discovery.experiment.additions import offers
from abbe.models.discovery.lack import floors, repeat_steps
from abbe.models.discovery.whitened_problem import whiten
from abbe.service.discovery.discovery_answer import answer_doc
from abbe.service.discovery.discovery_text import verdict_of
from abbe.service.domain.machine import machine_from_doc
from abbe.service.runs.cases import case_of
from abbe.service.runs.exchange import read_folder
from tests.service.discovery.axis_bench import axis_case, found_in, searched, with_repeats

BIFROST = (
    "11358-axis1-ild", "11358-axis1-resolver", "11358-axis2-ild", "11358-axis2-resolver", "11359-axis2-ild", "11359-axis2-resolver",
    "11361-axis1-resolver",
)  # fmt: skip
LOST_UM = {"11358-axis1-resolver": 0.6, "11358-axis2-resolver": 2.5, "11359-axis2-resolver": 1.25, "11361-axis1-resolver": 0.2}
"""Half way between what the repeats at 15, 35 and 55 mm show, which no fit has seen; see the test for how far they differ."""


def rough(x: np.ndarray) -> np.ndarray:
    """A repeatable shape that no effect knows, um: a jagged line through places 26 mm apart, alike in both directions."""
    nodes = np.arange(0.0, 401.0, 26.0)
    return np.asarray(np.interp(x, nodes, 20.0 * np.random.default_rng(5).standard_normal(nodes.size)))


def test_a_shape_that_no_effect_explains_is_unknown_with_place_and_shape() -> None:
    found, finding = searched(with_repeats(rough))
    assert (found.verdict, found.effects) == ("unknown", ())
    gap = found.gaps["identify"]
    assert gap.before_mm > 1.5 * gap.floor_mm
    assert gap.floor_mm == pytest.approx(0.3e-3, rel=0.2)  # of the repeats; what the fit leaves is many times that
    assert (found.location.axes, found.location.runs) == (("X",), ("r01",))
    assert "position" in found.location.depends_on
    assert "a shape along X, alike in both directions" in found.location.shape
    assert answer_doc(finding)["where"]["shape"] == found.location.shape
    sign, word, text = verdict_of(finding)
    assert (sign, word) == ("bad", "Something is missing that the catalogue does not explain")
    assert found.location.shape in text
    assert found.next_test is not None


def test_a_name_that_leaves_most_of_the_gap_and_that_nothing_proves_is_only_a_suspect() -> None:
    """Nineteen millimetres apart the jagged line looks a little like the error of a screw; with that, half of it is still there."""
    nodes = np.arange(0.0, 401.0, 19.0)
    heights = 20.0 * np.random.default_rng(5).standard_normal(nodes.size)
    found, finding = searched(with_repeats(lambda x: np.interp(x, nodes, heights)))
    assert [e.name for e in found.effects] == ["cyclic_error"]
    assert found.gaps["identify"].after_mm > 1.5 * found.gaps["identify"].floor_mm
    answer = answer_doc(finding)
    assert (answer["verdict"], answer["effects"], answer["proved"]) == ("unknown", [], False)
    assert [e["name"] for e in answer["suspects"]] == ["cyclic_error"]
    assert "even with the effect the fitted runs deviate by" in answer["proof"]
    assert "even with the effect the fitted runs deviate by" in verdict_of(finding)[2]


def test_a_smooth_axis_with_the_same_repeats_misses_nothing() -> None:
    found, _ = searched(with_repeats(lambda x: 4.0 * np.sin(x / 130.0)))
    assert (found.verdict, found.effects) == ("none", ())
    gap = found.gaps["identify"]
    assert gap.before_mm < 1.3 * gap.floor_mm


def test_the_noise_is_that_of_repeats_and_not_of_what_the_fit_leaves() -> None:
    case = axis_case(with_repeats(rough))
    problem = whiten(case, baseline_of(case))
    assert repeat_steps(case, "laser").size == 55  # of ten visits from both sides at three places, and the turning point
    assert floors(problem)["laser"].sd_mm == pytest.approx(0.3e-3, rel=0.2)
    assert problem.colours["laser"].sd_mm > 5.0 * floors(problem)["laser"].sd_mm


def test_lost_motion_that_the_line_shows_is_proved_by_repeats_from_both_sides() -> None:
    found, finding = searched(with_repeats(lambda x: 0.0 * x, lost_um=3.0))
    assert [e.label for e in found.effects] == ["backlash:X"]
    assert found.effects[0].strength == pytest.approx(3.0, abs=0.4)
    assert (finding.verdict, finding.proved) == ("named", True)


def test_no_ball_bar_is_offered_where_none_has_room() -> None:
    """Strokes of 2 mm in Y and Z; a bar of no length once divided by zero, and warnings are errors here."""
    assert "ballbar" not in {o.adds for o in offers(axis_case(with_repeats(rough)))}


def real(shared: Path, name: str):  # type: ignore[no-untyped-def]
    """What is found in a real test of an axis of a slit (shared/spec/foreign.md)."""
    folder = read_folder(shared / "data" / "foreign" / "bifrost" / name)
    return found_in(case_of(folder.campaign, machine_from_doc(folder.campaign["machine"]), folder.runs))


@pytest.mark.parametrize("name", BIFROST)
def test_no_real_axis_is_called_complete_over_a_gap(shared: Path, name: str) -> None:
    found, finding = real(shared, name)
    answer = answer_doc(finding)
    assert answer["verdict"] != "none" or answer["rms_before_um"] <= 1.5 * answer["noise_floor_um"]
    if name.endswith("-ild"):  # tens of um, the same in both directions, in a sensor that repeats to less than 1 um
        assert (answer["verdict"], answer["effects"]) == ("unknown", [])
        assert "alike in both directions" in found.location.shape
        assert answer["noise_floor_um"] < 1.0
    else:
        assert (answer["verdict"], answer["proved"]) == ("named", True)
        effect = answer["effects"][0]
        assert effect["name"].startswith("backlash")
        size, u = effect["parameters"]["strength"], effect["parameters"]["u_strength"]
        assert -size == pytest.approx(LOST_UM[name], abs=max(3.0 * u, 0.15))
