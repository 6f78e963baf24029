"""Effects of the scatter beside those of the mean: found in what the mean leaves, then kept away from the search for the mean."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.discovery.candidates import Pick
from abbe.models.discovery.noise import unscaled
from abbe.models.discovery.prediction import solve
from abbe.models.discovery.variance.scatter_effects import VarianceFinding, extra_variance
from abbe.models.discovery.whitened_problem import Scene, Tangent, taken_out

GATE = 1.3
"""Readings at less than this times the speed at which an axis sticks do not count for the mean."""
MOST_GATED = 0.35
"""... unless they are more than this share of all readings."""


def scattered(scene: Scene, picks: Sequence[Pick]) -> tuple[VarianceFinding, ...]:
    """What the scatter of the readings shows once simulation and ``picks`` are taken out; lone readings of lasers are in it again."""
    solved = solve(scene, picks)
    model = scene.tangent.raw @ (solved.theta - scene.theta)
    for pick, c in zip(solved.picks, solved.coefficients, strict=True):
        model = model + pick.raw(scene) @ c
    valid = np.concatenate([r.valid.astype(float) for r in scene.runs])
    left = (scene.gap - model) * valid
    white = unscaled(left[:, None], scene.lengths, scene.kinds, scene.colours)[:, 0] / scene.sd_mm()
    sigma = tuple(scene.colours[k].sd_mm for k in scene.kinds)
    leverage = tuple(scene.by_run(scene.space.leverage))
    return extra_variance(scene.paths, tuple(scene.by_run(white * valid)), sigma, leverage=leverage, colours=scene.colours)


def without(scene: Scene, findings: Sequence[VarianceFinding]) -> Scene:
    """The scene whose mean is free of the findings: a vibration's waves are taken out run by run, loud readings do not count."""
    waves, use = [scene.also], scene.use
    for f in findings:
        if f.name == "vibration":
            waves.append(_waves(scene, "XYZ".index(f.key), f.parameters["frequency_hz"]))
        elif f.name == "stick_slip":
            loud = _slow(scene, "XYZ".index(f.key), f.parameters["v_c"])
            use = use * (1.0 - loud) if loud.mean() < MOST_GATED else use
        elif f.name == "unnamed_burst":
            use = use * (1.0 - _moment(scene, f.parameters["t0_s"], f.parameters["width_s"]))
    scene = replace(scene, also=np.concatenate(waves, axis=1))
    if (use != scene.use).any():
        tangent = Tangent.of(scene.tangent.raw, use, scene.lengths, scene.kinds, scene.colours)
        scene = replace(scene, use=use, tangent=tangent)
    return taken_out(scene)


def _waves(scene: Scene, axis: int, frequency_hz: float) -> F2:
    """Sine and cosine of unknown size and phase in every ball-bar run, mm."""
    out = np.zeros((scene.gap.size, 2 * sum(k == "bar" for k in scene.kinds)))
    start = column = 0
    for path in scene.paths:
        if path.kind == "bar":
            phase = 2.0 * np.pi * frequency_hz * (path.at.t_s - path.at.t_s[0])
            out[start : start + path.n, column : column + 2] = path.look[:, axis, None] * np.stack([np.sin(phase), np.cos(phase)], axis=1)
            column += 2
        start += path.n
    return out


def _slow(scene: Scene, axis: int, v_mm_s: float) -> F1:
    return np.concatenate([(np.abs(p.at.v_mm_s[:, axis]) < GATE * v_mm_s) * float(p.kind == "bar") for p in scene.paths])


def _moment(scene: Scene, t0_s: float, width_s: float) -> F1:
    return np.concatenate([(np.abs(p.at.t_s - t0_s) < 1.5 * width_s) * float(p.kind == "bar") for p in scene.paths])
