"""The verdict on a solution from the layout of the campaign, the reached uncertainty, and open flags."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from abbe.models.solvers.observability.volume import GOOD, USABLE, Number
from abbe.models.uncertainty.prediction import Prediction

WORDS = ("mostly assumption", "usable with care", "good")
ENOUGH, HALF = 0.8, 0.5
"""Shares of the volume where the error is larger than its uncertainty."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """``word``: one of `WORDS`; ``text``: its basis in numbers; ``reasons``: why it is not better."""

    word: str
    text: str
    reasons: tuple[str, ...]

    @property
    def sign(self) -> str:
        """``ok``, ``open`` or ``bad``."""
        return ("bad", "open", "ok")[WORDS.index(self.word)]


def verdict(number: Number, prediction: Prediction, share: float, *, flags: int = 0, not_noise: int = 0) -> Verdict:
    """Judge what a solution can be used for.

    The layout limits the verdict. If the model does not fit, the reached uncertainty far exceeds that limit, and counts.

    Parameters
    ----------
    number : Number
        The observability number: the limit of the layout.
    prediction : Prediction
        Over the volume, rigid motion removed.
    share : float
        Share of the volume where the error exceeds its uncertainty.
    flags : int
        Number of open flags.
    not_noise : int
        Number of runs with residuals that are not noise.
    """
    u, error = float(prediction.u_vector_mm.max()), float(np.sqrt(np.mean(np.sum(prediction.deviation_mm**2, axis=1))))
    reached = number.before_mm / u if u > 0.0 else np.inf
    level, reasons = WORDS.index(number.verdict), []
    if level < WORDS.index("good"):
        reasons.append(f"the layout of the campaign allows no more than {number.value:.1f} times")
    if reached < GOOD:
        level = min(level, 1 if reached >= USABLE else 0)
        reasons.append(f"the uncertainty that was reached makes a typical machine's error only {reached:.1f} times smaller")
    if share < ENOUGH:
        level = min(level, 0 if share < HALF and error < u else 1)
        reasons.append(f"in {1.0 - share:.0%} of the volume the error is smaller than its uncertainty and cannot be compensated")
    if flags:
        level = min(level, 1)
        reasons.append(f"{flags} open flag{'s' if flags > 1 else ''}")
    if not_noise:
        level = min(level, 1)
        reasons.append(f"{not_noise} run{'s' if not_noise > 1 else ''} with residuals that are not noise")
    largest = float(prediction.expanded_vector_mm.max())
    text = f"Error of {error * 1e3:.2g} µm rms over the volume, known to ± {largest * 1e3:.2g} µm at the worst (95 %, rigid motion removed)"
    return Verdict(WORDS[level], text + (": " + "; ".join(reasons) if reasons else "") + ".", tuple(reasons))


def layout_line(number: Number) -> str:
    """The observability number as text: a property of the layout, not of the readings."""
    return "What the layout of the campaign allows, if the model fits: " + number.text.replace(f" ({number.verdict})", "")
