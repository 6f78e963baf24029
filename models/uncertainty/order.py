"""What error motions of higher order than the chosen one may still do: the price of a smooth model.

A campaign is solved up to some Legendre order. Higher orders are small, but not zero; they disturb the estimate through the readings and
are missing at the point. Both at once: with phi the omitted coefficients (prior S of the same family as the solution's), B their design at
the readings and G at the point, the prediction is off by (D K B - G) phi. What the residuals of the campaign say of phi counts:
its covariance is (S^-1 + B^T (W - W A C A^T W) B)^-1 about the value the residuals ask for, not S.
"""

from __future__ import annotations

import numpy as np
from scipy import linalg

from abbe.models.arrays import F1, F2
from abbe.models.geometry.bases import Term, smooth_terms
from abbe.models.solvers.joint import JointSolution
from abbe.models.solvers.observe import run_design
from abbe.models.solvers.priors import Priors, term_prior_sd
from abbe.models.uncertainty.response import Response


def order_source(solution: JointSolution, r: Response, orders_above: int) -> tuple[tuple[Term, ...], F2]:
    """Terms of the solution and of the orders above it, and the factor of what the latter do to all of them, shape (P, q).

    The prediction stays the one of the chosen order, so what the residuals ask of the higher orders is no correction: it counts as one more
    column, in full.
    """
    above = omitted_terms(max((t.order for t in solution.terms), default=0), orders_above)
    terms = (*solution.terms, *above)
    if not above:
        return terms, np.zeros((len(terms), 0))
    n = len(solution.terms)
    omitted = _design(solution, above)
    weighted = omitted * r.weight[:, None]
    carried = r.covariance @ (r.design.T @ weighted)  # K B
    seen = omitted.T @ weighted - (weighted.T @ r.design) @ carried
    sd = omitted_prior_sd(solution, above)
    normal = np.eye(len(above)) + 0.5 * np.outer(sd, sd) * (seen + seen.T)
    lower = linalg.cholesky(normal, lower=True)
    root = sd[:, None] * linalg.solve_triangular(lower, np.eye(len(above)), lower=True).T
    residual = np.concatenate([fit.residual_mm for fit in solution.runs])
    asked = root @ (root.T @ (weighted.T @ residual))
    phi = np.concatenate([root, asked[:, None]], axis=1)
    return terms, np.concatenate([carried[:n] @ phi, -phi])


def chosen_order(solution: JointSolution) -> int:
    """Legendre order that the data support; terms of the solution above it are there only to be allowed for."""
    return solution.order


def omitted_terms(order: int, orders_above: int) -> tuple[Term, ...]:
    """Terms of the ``orders_above`` Legendre orders above ``order``."""
    return tuple(t for t in smooth_terms(order + orders_above) if t.order > order) if orders_above else ()


def omitted_prior_sd(solution: JointSolution, above: tuple[Term, ...]) -> F1:
    """Prior standard deviation of the omitted terms, shape (len(above),): the documented one, scaled as the solver scaled that motion's.

    The solver may have found that this machine's errors are larger or smaller than the documented priors; the omitted orders of a motion
    follow its highest order that was kept.
    """
    documented = Priors()
    kept = term_prior_sd(solution.machine, solution.terms, documented)
    last: dict[str, tuple[int, float]] = {}
    for i, t in enumerate(solution.terms):
        if t.order and t.order >= last.get(t.motion, (0, 0.0))[0]:
            last[t.motion] = (t.order, float(solution.prior_sd[i] / kept[i]))
    scale = np.array([last[t.motion][1] if t.motion in last else 1.0 for t in above])
    return np.asarray(term_prior_sd(solution.machine, above, documented) * scale)


def _design(solution: JointSolution, above: tuple[Term, ...]) -> F2:
    rows = [run_design(solution.machine, above, run, solution.setup)[:, : len(above)] for run in solution.data]
    return np.concatenate(rows)
