"""How large a named effect is, in the unit that people use for it, and how sure that is: noise, form, and what no data can show."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.discovery.candidates import Pick
from abbe.models.discovery.whitened_problem import Scene
from abbe.models.effects.effect import Effect, Family

TRUE_TO_FORM: dict[Family, float] = {"drive": 0.03, "structure": 0.03, "thermal": 0.12, "instrument": 0.05, "geometry": 0.1}
"""No machine is true to a formula: standard uncertainty of a strength from its form, relative, by family. A step is a step; what warms up
follows several time constants, whose end a campaign does not see."""
TRUE_TO_FORM_OF = {
    "contour_lag": 0.05,  # a second lag in the loop counts in the sum, but shrinks a circle less
    "cyclic_error": 0.1,  # swells along its screw, by a tenth to a third
    "vibration": 0.04,
    "stick_slip": 0.1,  # its teeth are not all of one height
    "beam_outliers": 0.05,
    "ram_sag": 0.05,  # the bending line is no parabola
    "mirror_tilt": 0.1,  # a mirror is not mounted equally badly every time
    "air_refraction": 0.1,  # a hall does not swing as a sine
    "dead_path": 0.1,  # nor does its air warm up at one rate
}
"""The same of effects that are less like their formula than their family."""
CARRYING = ("modulated", "sensor")
"""Forms of effects that do not warm up which hold part of their size."""
OFFSET = "offset"
"""A form that begins so has a constant first: what a sensor followed counts from where it began, and that is no part of a swing."""
TIME_TRUE_TO_FORM = 0.3
"""The same of a time constant: what has several of them looks quicker than it is in a campaign that ends before the slow one does."""


def true_to_form(name: str, family: Family) -> float:
    """Relative standard uncertainty of an effect's strength from its form."""
    return TRUE_TO_FORM_OF.get(name, TRUE_TO_FORM[family])


def shape_of(pick: Pick, u: Mapping[str, float]) -> dict[str, tuple[float, float]]:
    """Non-linear parameters by name with their standard uncertainty; that of a warming-up's time constant holds its form too."""
    times = {"tau_s"} if pick.effect.family == "thermal" else set()
    values = {name: float(pick.values[name]) for name in u}
    return {name: (v, float(np.hypot(u[name], TIME_TRUE_TO_FORM * v)) if name in times else u[name]) for name, v in values.items()}


def strength_of(scene: Scene, pick: Pick, c: F1, cov: F2) -> tuple[float, float]:
    """Strength and its standard uncertainty, in the effect's unit, from its coefficients (forms last) and their covariance.

    Four parts of the uncertainty: that of the coefficients (the non-linear parameters free), that of the form, what the present simulation
    swallows of the effect whatever it is (`Effect.unseen`), and how far it depends on what is called constant (`as_plain`).
    """
    effect = pick.effect
    plain = as_plain(scene, pick)
    c_plain, cov_plain = plain @ c, plain @ cov @ plain.T
    seen = float(effect.strength(c_plain, pick.values))
    slope = _slope(effect, c_plain, cov_plain, pick)
    own = float(np.sqrt(max(float(slope @ cov_plain @ slope), 0.0)))
    ratio, u_ratio = effect.unseen
    strength = ratio * seen
    otherwise = seen - float(effect.strength(as_plain(scene, pick, offset=False) @ c, pick.values))
    u = float(np.linalg.norm([ratio * own, true_to_form(effect.name, effect.family) * strength, u_ratio * seen, otherwise]))
    return strength / effect.per_unit, u / effect.per_unit


def _slope(effect: Effect, c: F1, cov: F2, pick: Pick) -> F1:
    """Change of the strength with each coefficient."""
    out = np.zeros(c.size)
    for j in range(c.size):
        step = max(1e-4 * abs(c[j]), 1e-3 * float(np.sqrt(max(cov[j, j], 1e-30))))
        ends = [effect.strength(c + s * step * np.eye(c.size)[j], pick.values) for s in (-1, 1)]
        out[j] = (ends[1] - ends[0]) / (2.0 * step)
    return out


def as_plain(scene: Scene, pick: Pick, *, offset: bool = True) -> F2:
    """Coefficients of the plain effect that comes nearest to the effect with its forms, per coefficient, shape (plain, all).

    Only forms that carry part of the size itself count: an amplitude that changes along the axis, other courses of a warming up, what a
    sensor followed. What a form adds beside (second harmonic, wind-up) is no part of the strength.
    """
    raw = pick.raw(scene)
    k = scene.raw(pick.effect.signal, pick.key, pick.values).shape[1]
    at = k
    for form in pick.forms:
        width = scene.raw(form.signal, pick.key, pick.values).shape[1]
        if pick.effect.family != "thermal" and not form.name.startswith(CARRYING):
            raw[:, at : at + width] = 0.0
        at += width
    if not raw[:, k:].any():
        return np.eye(k, raw.shape[1])
    beside = [scene.raw(f.signal, pick.key, pick.values)[:, :1] for f in pick.effect.forms if offset and f.name.startswith(OFFSET)]
    basis = np.concatenate([raw[:, :k], *beside], axis=1)
    scale = np.linalg.norm(basis, axis=0)
    scale[scale == 0.0] = 1.0
    return np.asarray(np.linalg.lstsq(basis / scale, raw, rcond=1e-9)[0] / scale[:, None])[:k]
