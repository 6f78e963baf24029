"""The coefficients of a solution with their covariance, as stored, from which predictions can be recomputed.

Deviation at points = field @ coefficients, covariance = field @ covariance @ field^T, where field holds the deviation per unit of each term
(`abbe.models.geometry.volume.unit_deviation`, with the machine's tool and the requested frame).
"""

from __future__ import annotations

import base64

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.geometry.bases import Term
from abbe.models.uncertainty.sources import ErrorSources
from abbe.service.domain.solution_file import PackedMatrix, StoredPrediction

ENCODING = "base64 of float64, little endian, lower triangle by rows"


def prediction_of(sources: ErrorSources) -> StoredPrediction:
    """Return the terms (motion, order, axis, component), coefficients in mm and rad, and their covariance from all sources."""
    total = np.zeros((len(sources.terms), len(sources.terms)))
    for s in sources.sources:
        total += s.factor @ s.factor.T
        if s.subtracted is not None:
            total -= s.subtracted @ s.subtracted.T
    lower = total[np.tril_indices(len(total))]
    data = base64.b64encode(lower.astype("<f8").tobytes()).decode()
    return StoredPrediction(
        terms=[(t.motion, t.order, t.axis, t.component) for t in sources.terms],
        coefficients=[float(v) for v in sources.coefficients],
        covariance=PackedMatrix(encoding=ENCODING, shape=list(total.shape), data=data),
        scatter_mm=float(np.sqrt(sum(s.scatter_mm**2 for s in sources.sources))),
    )


def stored_prediction(stored: StoredPrediction) -> tuple[tuple[Term, ...], F1, F2]:
    """Return the terms, coefficients and covariance of a stored solution's ``prediction``."""
    n = stored.covariance.shape[0]
    out = np.zeros((n, n))
    out[np.tril_indices(n)] = np.frombuffer(base64.b64decode(stored.covariance.data), dtype="<f8")
    out = out + np.tril(out, -1).T
    return tuple(Term(*t) for t in stored.terms), np.asarray(stored.coefficients, dtype=np.float64), out
