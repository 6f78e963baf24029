"""How much of the gap a finding closes on fitted runs, left out block by block; for campaigns without holdout runs."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import scipy

from abbe.models.arrays import F1, F2
from abbe.models.discovery.answer import Gap
from abbe.models.discovery.lack import Floor
from abbe.models.discovery.solved_model import SolvedModel
from abbe.models.discovery.whitened_problem import WhitenedProblem

BLOCKS = 5
"""Number of blocks of a run. Each fit leaves out one block of every run; this block lies on another part of the path from run to run."""


def left_out_gap(problem: WhitenedProblem, solved: SolvedModel, floor: Mapping[str, Floor]) -> Gap | None:
    """Return the gap of the fitted runs, each block predicted by a fit to the other blocks; None if a finding has no mean effects.

    Unknowns of the simulation and coefficients of the effects are fitted anew without the block. Selection and non-linear parameters
    of the effects come from all readings. So this proves less than a holdout run, and more than the residuals of the fit.
    """
    if not solved.picks:
        return None
    raw = [p.raw(problem) for p in solved.picks]
    sd = [p.prior_sd(problem, r.shape[1]) for p, r in zip(solved.picks, raw, strict=True)]
    used = problem.use > 0
    before = _left(problem, np.zeros((problem.gap.size, 0)), np.zeros(0))[used]
    after = _left(problem, np.concatenate(raw, axis=1), np.concatenate(sd))[used]
    noise = np.repeat([floor[k].sd_mm for k in problem.kinds], problem.lengths)[used]
    return Gap(*(float(np.sqrt(np.mean(v**2))) for v in (before, after, noise)))


def _left(problem: WhitenedProblem, effects: F2, sd: F1) -> F1:
    """Return the residual of every reading from fits to the other blocks, mm, shape (n,); ``effects``: columns (n, k), mm per unit."""
    block = np.concatenate([(BLOCKS * np.arange(n) // n + i) % BLOCKS for i, n in enumerate(problem.lengths)])
    tangent, p = problem.tangent, problem.base.size
    read = problem.gap + tangent.raw @ problem.theta
    white, noise = problem.white(np.column_stack([read, effects])), problem.sd_mm()
    root = scipy.linalg.block_diag(problem.base.root, np.diag(sd))
    normal = []
    for b in range(BLOCKS):
        at = block == b
        a = np.concatenate([tangent.columns[at] / noise[at, None], white[at, 1:]], axis=1) @ root
        normal.append((a.T @ a, a.T @ white[at, 0]))
    gram, right = (np.sum(part, axis=0) for part in zip(*normal, strict=True))
    out = np.zeros(read.size)
    for b, (own, own_right) in enumerate(normal):
        x = root @ np.linalg.solve(gram - own + np.eye(len(root)), right - own_right)
        out[block == b] = (read - tangent.raw @ x[:p] - effects @ x[p:])[block == b]
    return out
