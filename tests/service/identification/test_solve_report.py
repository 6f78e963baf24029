"""The one word for a solution: what layout, uncertainty reached, flags and residuals make of it."""

import numpy as np
import pytest

from abbe.models.solvers.observability.volume import Number
from abbe.models.uncertainty.prediction import Prediction
from abbe.service.identification.solve_report import VERDICTS, verdict


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
