"""The one word for a solution: what layout, uncertainty reached, flags and residuals make of it."""

from dataclasses import replace

import numpy as np
import pytest

from abbe.models.geometry.volume import volume_grid
from abbe.models.solvers.joint import solve_joint
from abbe.models.solvers.observability.volume import Number
from abbe.models.uncertainty.prediction import Prediction
from abbe.service.compensation.proposals import change_of
from abbe.service.errors import TableRefused
from abbe.service.identification.solve import Solved
from abbe.service.identification.solve_report import VERDICTS, assess, solution_of, solution_verdict, verdict
from abbe.service.identification.solve_tables import deviation_text, scale_free
from tests.experiments.campaigns.population import draw_case
from tests.experiments.campaigns.scoring import INPUTS


def layout(value: float, word: str) -> Number:
    return Number(value, value, 0.03, 0.03 / value, np.zeros(3), word, f"Observability {value:g} ({word})")


def known(error_mm: float, u_mm: float) -> Prediction:
    """Four points with the same error along X, each component known to u / sqrt(3): the vector to u."""
    points = np.arange(12.0).reshape(4, 3)
    cov = np.broadcast_to(np.eye(3) * u_mm**2 / 3.0, (4, 3, 3))
    variance = np.full((1, 4, 3), u_mm**2 / 3.0)
    return Prediction(points, np.tile([error_mm, 0.0, 0.0], (4, 1)), cov, ("noise_bar",), variance, np.full((4, 3), np.inf), 0.95)


GOOD = layout(30.0, "good")


def test_everything_well_is_good_without_reasons():
    told = verdict(GOOD, known(0.02, 1e-3), 1.0)
    assert (told.word, told.sign, told.reasons) == ("good", "ok", ())
    assert "20 µm rms" in told.text


@pytest.mark.parametrize(
    ("number", "prediction", "share", "more", "word", "reason"),
    [
        (
            layout(4.0, "usable with care"),
            known(0.02, 1e-3),
            1.0,
            {},
            "usable with care",
            "can make a typical machine's error at most 4.0 times smaller",
        ),
        (layout(1.2, "mostly assumption"), known(0.02, 1e-3), 1.0, {}, "mostly assumption", "at most 1.2 times smaller"),
        (GOOD, known(0.02, 0.025), 0.9, {}, "mostly assumption", "only 1.2 times smaller"),
        (GOOD, known(0.02, 1e-3), 0.7, {}, "usable with care", "in 30% of the volume the error is smaller"),
        (GOOD, known(0.5e-3, 1e-3), 0.3, {}, "mostly assumption", "in 70% of the volume"),
        (GOOD, known(0.02, 1e-3), 1.0, {"flags": 2}, "usable with care", "2 open flags"),
        (GOOD, known(0.02, 1e-3), 1.0, {"not_noise": 1}, "usable with care", "1 run with residuals that are not noise"),
    ],
)
def test_one_weak_point_holds_the_word_down_and_is_named(number, prediction, share, more, word, reason):
    told = verdict(number, prediction, share, **more)
    assert told.word == word
    assert any(reason in r for r in told.reasons), told.reasons
    assert reason in told.text


def test_more_weak_points_never_make_it_better():
    all_of_them = verdict(layout(4.0, "usable with care"), known(0.02, 0.025), 0.3, flags=1, not_noise=1)
    assert all_of_them.word == VERDICTS[0]
    assert len(all_of_them.reasons) == 5


def assessed(kind: str):
    case = draw_case(8, kind)
    runs = [replace(r, length_calibrated=False, u_length_mm=None) if r.kind == "bar" else r for r in case.runs]
    return assess(Solved(solve_joint(case.machine, tuple(runs), model="rigid6"), {}, {}, inputs=INPUTS))


def test_a_bar_of_unknown_length_alone_is_said_without_the_common_scale_too():
    found = assessed("ballbar_only")
    free, stated = scale_free(found), solution_of(found).uncertainty
    assert free.left_out == stated.without_scale.scales == "common"
    assert stated.without_scale.rms_um < 0.71 * stated.rms_um
    largest = stated.without_scale.expanded_vector_um
    assert (
        f"without the common scale, poorly determined by these runs, 9 µm rms known to ± {largest:.2g} µm" in solution_verdict(found).text
    )
    assert free.observability.number.value > found.observability.number.value
    assert "without" not in solution_verdict(free).text

    (change, promised, left_out), (_, whole, nothing) = (change_of(found.solved, without_scale=k) for k in (True, False))
    assert left_out == ("the common scale, poorly determined by the runs: left out",)
    assert nothing == ()
    assert promised.u_model_mm < 0.71 * whole.u_model_mm
    assert promised.after_mm < promised.before_mm
    at = volume_grid(found.joint.machine.stroke_mm, 5)
    assert abs(np.sum(change.correction_at(at) * (at - at.mean(axis=0)))) < 1e-9 * np.sum((at - at.mean(axis=0)) ** 2)  # stretches nothing

    points = found.prediction.points_mm
    whole, rest = (deviation_text(one, points) for one in (found, free))
    assert "# frame: the common scale removed, too" in rest
    assert "# frame" not in whole
    u = [np.genfromtxt(text.splitlines(), delimiter=",", comments="#", names=True)["U_dx_um"] for text in (whole, rest)]
    assert np.sum(u[1] ** 2) < np.sum(u[0] ** 2)


def test_bar_and_laser_together_know_the_scale_and_nothing_is_left_out():
    found = assessed("joint")
    assert solution_of(found).uncertainty.without_scale is None
    with pytest.raises(TableRefused, match="determine the scales as well as the rest"):
        scale_free(found)
