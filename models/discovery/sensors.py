"""Whether the temperature column of a warming part follows the warm-up that the readings show; if not, the columns may be exchanged."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from abbe.models.arrays import F1
from abbe.models.effects.columns import warmth
from abbe.models.effects.effect import Values
from abbe.models.effects.path import Path

FEWEST_RUNS = 8
FOLLOWS, STRAYS = 0.99, 0.95
"""Correlations with the warm-up: another column follows the warm-up if its correlation reaches `FOLLOWS`; the part's own column does not if
its correlation stays below `STRAYS`. In the practice set every own column reaches 0.999.
"""


def exchanged_sensor(paths: Sequence[Path], name: str, key: str, values: Values) -> str:
    """Return a warning if a named growth follows another temperature column and not the growing part's own, else an empty text.

    Parameters
    ----------
    paths : the fitted runs.
    name, key, values : the named effect; only growth of an axis and drift of the spindle have a sensor of their own.
    """
    own = {"axis_thermal_growth": key.lower(), "spindle_thermal_drift": "spindle"}.get(name)
    seen = [p for p in paths if own in p.at.temp_c]
    if own is None or len(seen) < FEWEST_RUNS:
        return ""
    course = warmth(np.array([p.at.t_s.mean() for p in seen]), values["tau_s"])
    sensors = [s for s in seen[0].at.temp_c if s != own and all(s in p.at.temp_c for p in seen)]
    like = {s: _alike(course, seen, s) for s in (own, *sensors)}
    best = max(like, key=lambda s: like[s])
    if like[own] >= STRAYS or like[best] < FOLLOWS:
        return ""
    return (
        f"temp_{own}_C does not follow the warm-up (correlation {like[own]:.2f}), but temp_{best}_C does ({like[best]:.2f}): "
        "see whether the columns are exchanged"
    )


def _alike(course: F1, paths: Sequence[Path], sensor: str) -> float:
    """Correlation of a warm-up with the mean temperature of every run; 0 for a constant or missing temperature."""
    mean = np.array([p.at.temp_c[sensor].mean() for p in paths])
    if not np.isfinite(mean).all() or np.ptp(mean) == 0.0 or np.ptp(course) == 0.0:
        return 0.0
    return float(np.corrcoef(course, mean)[0, 1])
