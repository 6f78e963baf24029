"""What a planned campaign cannot tell, in words, before anything is measured."""

from __future__ import annotations

import numpy as np
from scipy import linalg

from models.planning.information import Problem
from models.planning.search import Chosen, Search

UNSEEN = 1e-9
"""Information, relative to that of the best-seen combination, below which one leaves no trace (the square of math.md 4.6's 1e-9 is out of
reach of an information matrix in double precision; a combination this weak is not seen through any noise)."""
LITTLE = 0.2
"""A coefficient of whose prior variance the campaign takes away less than this share rests on its prior (as in `abbe solve`)."""


def not_observable(search: Search, chosen: Chosen) -> tuple[str, ...]:
    """Sentences about what the chosen measurements leave open; empty: nothing."""
    what = search.what
    n = len(what.terms)
    information = search.information(chosen) - np.eye(what.size)
    # Lost motion, bar lengths and wavelength have their priors: they are not what is asked here.
    others = information[n:, n:] + np.eye(what.size - n)
    seen = information[:n, :n] - information[:n, n:] @ linalg.solve(others, information[n:, :n], assume_a="pos")
    value, vector = linalg.eigh(0.5 * (seen + seen.T))
    hidden = vector[:, value < UNSEEN * max(float(value[-1]), 1.0)]
    out = _mixed(what, hidden)
    share = 1.0 - np.diag(linalg.inv(search.information(chosen)))[:n]
    names = [t.name for t, s in zip(what.terms, share, strict=True) if s < LITTLE]
    if names:
        out.append(f"{len(names)} of {n} coefficients would rest on their prior, the readings hardly speak of them: {', '.join(names)}")
    tool = ", ".join(f"{v:g}" for v in what.machine.tool_mm)
    out.append(f"all of this is for the tool ({tool}) mm: what another tool length makes of the axes' rotations is not measured")
    return tuple(out)


def _mixed(what: Problem, hidden: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> list[str]:
    if not hidden.shape[1]:
        return []
    held = (hidden**2).sum(axis=1)
    by_motion: dict[str, float] = {}
    for term, share in zip(what.terms, held, strict=True):
        by_motion[term.motion] = by_motion.get(term.motion, 0.0) + float(share)
    motions = sorted((m for m, v in by_motion.items() if v > 0.02), key=lambda m: -by_motion[m])
    count = hidden.shape[1]
    return [f"{count} combination{'s' if count > 1 else ''} of {', '.join(motions)} would leave no trace in the readings"]
