"""The least error that any solver can leave on the average over machines: Bayesian Cramer-Rao bound of a campaign on a machine of known
statistics.

The solver of the bound is told what nobody knows of a real machine: how large each of its 21 error motions is and how their Legendre
coefficients belong together (from the population's own law), how well bars, cups, mirrors and wavelength are set, and the noise. Everything
enters linearly, so the posterior covariance is the bound (van Trees). It is an expectation over machines and readings: on one machine a
solver may come out below it by chance, on all of them together only within their sampling error
(`tests.experiments.campaigns.accuracy.pooled`).
"""

from dataclasses import replace
from functools import cache

import numpy as np
from numpy.polynomial import legendre

from abbe.models.compensation.distances import Pairs
from abbe.models.geometry.bases import Term, smooth_terms
from abbe.models.geometry.chain import design
from abbe.models.solvers.observe import run_design, setup_unknowns
from abbe.models.solvers.priors import Priors
from abbe.simulators.truth.draws import draw
from tests.experiments.campaigns.population import Case

ORDER = 12
FUNCTIONS = 600


def bound_mm(case: Case, pairs: Pairs) -> float:
    """Rms error of the distances between pairs of points that the best solver leaves in expectation, mm."""
    conditions = case.truth.rig.conditions
    priors = true_priors(case)
    terms = smooth_terms(ORDER)
    runs = tuple(r if r.kind == "laser" else replace(r, u_length_mm=conditions.bar_length_sd_mm, length_calibrated=True) for r in case.runs)
    setup = setup_unknowns(runs, priors)
    noise = {"bar": conditions.bar_noise_mm, "laser": conditions.laser_noise_mm}
    blocks = [run_design(case.machine, terms, r, setup) * (np.sqrt(r.weight_n) / noise[r.kind])[:, None] for r in runs]
    a = np.concatenate(blocks)
    sd = np.concatenate([np.full(3, priors.backlash_mm), setup.prior_sd])
    n = len(terms)
    root = np.zeros((a.shape[1], a.shape[1]))  # unknowns = root @ independent unit normals: the prior becomes the unit matrix
    root[:n, :n] = _term_root(case, terms)
    root[n:, n:] = np.diag(sd)
    whitened = a @ root
    information = np.eye(a.shape[1]) + whitened.T @ whitened
    both = [np.einsum("ni,nik->nk", pairs.unit, design(case.machine, terms, p)) for p in (pairs.first_mm, pairs.second_mm)]
    rows = (both[1] - both[0]) @ root[:n]
    half = np.linalg.solve(np.linalg.cholesky(information), rows.T)
    return float(np.sqrt(np.mean(np.sum(half**2, axis=0))))


def true_priors(case: Case) -> Priors:
    """How well bars, cups, mirrors, beams and zeros of this population are set and how fast it drifts: standard deviations, no guesses."""
    conditions, m = case.truth.rig.conditions, case.truth.rig.scenario.magnitudes
    drift = m.drift_sd_um * 1e-3 / (60.0 * float(np.mean(m.drift_tau_min))) if conditions.drift else 1e-12
    return Priors(
        backlash_mm=_rms(m.backlash_um) * 1e-3,
        cup_mm=_rms(m.cup_offset_um) * 1e-3 / np.sqrt(3.0),
        tilt_rad=_rms(m.mirror_tilt_urad) * 1e-6 / np.sqrt(2.0),
        cosine=0.5 * (_rms(m.mirror_tilt_urad) ** 2 + _rms(m.beam_misalignment_urad) ** 2) * 1e-12,
        zero_mm=conditions.laser_noise_mm,
        drift_mm_s=drift,
        bar_drift_mm_s=drift,
        laser_scale=conditions.wavelength_sd,
    )


def _term_root(case: Case, terms: tuple[Term, ...]) -> np.ndarray:
    """Square root of the prior covariance of the terms' coefficients on this machine."""
    draws, m = case.truth.rig.draws, case.truth.rig.scenario.magnitudes
    length = case.machine.length_mm
    shape, start = spectrum()
    out = np.zeros((len(terms), len(terms)))
    for i, t in enumerate(terms):
        if t.order == 0:  # the model counts angles from the start of the stroke: what they are there turns the axes' directions
            out[i, i] = np.hypot(m.squareness_sd_urad * 1e-6, 2.0 * np.mean(m.angle_rms_urad) * 1e-6 * start)
        elif t.order == 1:
            out[i, i] = m.scale_sd_um_per_m * 1e-6 * length[t.axis] / 2 if t.component < 3 else m.angle_slope_sd_urad * 1e-6 / 2
    for axis in range(3):
        for c in range(6):
            mine = [i for i, t in enumerate(terms) if t.axis == axis and t.component == c and t.order >= 2]
            out[np.ix_(mine, mine)] = draws.rms[axis, c] * shape
    return out


@cache
def spectrum() -> tuple[np.ndarray, float]:
    """Of the population's functions of unit rms: root of the covariance of Legendre coefficients 2..ORDER; rms value at the start."""
    u, weight = legendre.leggauss(120)
    f = draw(np.random.default_rng(12), (-1.0, 1.0), np.ones(FUNCTIONS), np.zeros(FUNCTIONS))
    k = np.arange(ORDER + 1)
    c = 0.5 * (2.0 * k + 1.0)[:, None] * (legendre.legvander(u, ORDER).T * weight) @ f(u)
    values, vectors = np.linalg.eigh(c[2:] @ c[2:].T / FUNCTIONS)
    return vectors * np.sqrt(np.maximum(values, 0.0)), float(np.sqrt(np.mean(f(np.array([-1.0])) ** 2)))


def _rms(ends: tuple[float, float]) -> float:
    a, b = ends
    return float(np.sqrt((a * a + a * b + b * b) / 3.0))
