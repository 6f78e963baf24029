"""A positioning test of one axis in one set-up reaches the catalogue: lost motion and scale, beside a drift, and nothing in its noise."""

from __future__ import annotations

import numpy as np
import pytest

from abbe.service.discovery.discovery_answer import answer_doc
from abbe.service.discovery.discovery_text import verdict_of
from tests.service.discovery.axis_bench import cycles, searched


@pytest.mark.parametrize("count", [1, 2, 5])
def test_lost_motion_and_scale_are_found_as_the_solver_finds_them(count: int) -> None:
    found, finding = searched(cycles(count, lost_um=15.0, scale_um_m=-100.0))
    assert [e.label for e in found.effects] == ["backlash:X"]
    assert abs(found.effects[0].strength - 15.0) < max(2.5 * found.effects[0].u_strength, 0.3)
    (scale,) = found.fitted
    assert (scale.name, scale.key, scale.unit) == ("scale", "X", "um/m")
    assert abs(scale.value + 100.0) < 3.0 * scale.u
    assert scale.u < 3.0
    assert answer_doc(finding)["fitted"][0]["value"] == scale.value
    assert answer_doc(finding)["proved"] is (count > 2)  # else no run only judges
    assert "In the present model, as fitted: scale of X" in verdict_of(finding)[2]


@pytest.mark.parametrize("seed", range(1, 6))
def test_nothing_is_named_where_visits_differ_by_noise_only(seed: int) -> None:
    found, _ = searched(cycles(seed=seed, noise_um=0.8))
    assert (found.verdict, found.effects) == ("none", ())


def test_a_drift_does_not_hide_lost_motion_nor_lost_motion_the_drift() -> None:
    found, finding = searched(cycles(lost_um=10.0, drift_um_h=40.0))
    sizes = {e.label: e.strength for e in found.effects}
    assert sizes["slow_drift:X"] == pytest.approx(40.0 * (4 * 600.0 - 600.0 + 210.0) / 3600.0, rel=0.1)  # over the fitted cycles
    assert sizes["backlash:X"] == pytest.approx(10.0, abs=0.8)
    assert finding.proved is True


def test_a_drift_alone_says_what_closed_on_the_cycle_that_was_never_fitted() -> None:
    found, finding = searched(cycles(drift_um_h=40.0))
    assert [e.label for e in found.effects] == ["slow_drift:X"]
    text = verdict_of(finding)[2]
    held = finding.gaps["holdout"]
    assert f"also on runs that were never fitted, from {held.before_um:.3g} to" in text
    assert text.count("closed)") == 1  # fitted runs flatter
    assert f"(noise alone: {held.floor_um:.3f} µm, {held.closed:.0%} closed)" in text


def test_a_repeatable_shape_beyond_the_present_model_is_not_called_complete() -> None:
    found, _ = searched(cycles(shape=lambda x: np.where((x > 100.0) & (x < 130.0), 12.0, 0.0)))
    assert found.verdict != "none"
