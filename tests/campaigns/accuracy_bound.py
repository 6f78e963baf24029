"""The least error that any solver can leave: Bayesian Cramer-Rao bound of a campaign on a machine whose statistics are known beforehand.

The solver of the bound is told what nobody knows of a real machine: how large each of its 21 error motions is and how their Legendre
coefficients belong together (from the population's own law), how well bars, cups, mirrors and wavelength are set, and the noise. Everything
enters linearly, so the posterior covariance is the bound (van Trees).
"""

from functools import cache

import numpy as np
from numpy.polynomial import legendre

from models.compensation.distances import Pairs
from models.geometry.bases import Term, smooth_terms
from models.geometry.chain import design
from models.solvers.observe import run_design, setup_unknowns
from models.solvers.priors import Priors
from simulators.truth.functions import draw
from tests.campaigns.population import Case

ORDER = 12
FUNCTIONS = 600


def bound_mm(case: Case, pairs: Pairs) -> float:
    """Rms error of the distances between pairs of points that the best solver leaves, mm."""
    conditions, magnitudes = case.truth.rig.conditions, case.truth.rig.scenario.magnitudes
    priors = Priors(
        backlash_mm=float(np.mean(magnitudes.backlash_um)) * 1e-3,
        cup_mm=_rms(magnitudes.cup_offset_um) * 1e-3 / np.sqrt(3.0),
        tilt_rad=_rms(magnitudes.mirror_tilt_urad) * 1e-6 / np.sqrt(2.0),
        laser_scale=conditions.wavelength_sd,
    )
    terms = smooth_terms(ORDER)
    setup = setup_unknowns(case.runs, priors)
    noise = {"bar": conditions.bar_noise_mm, "laser": conditions.laser_noise_mm}
    blocks = [run_design(case.machine, terms, r, setup) * (np.sqrt(r.weight_n) / noise[r.kind])[:, None] for r in case.runs]
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
