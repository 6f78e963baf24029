"""Arrays inside stored documents: short, exact to what a reading holds, readable by anybody."""

from __future__ import annotations

import base64
from typing import Any

import numpy as np

from abbe.models.arrays import F1, F2

READINGS = "base64 of float32, little endian, mm"
MATRIX = "base64 of float64, little endian, lower triangle by rows"


def packed(values: F1) -> dict[str, Any]:
    """Residuals or predictions of one run; float32 keeps 7 digits, a nanometre of 10 mm."""
    return {"encoding": READINGS, "n": int(values.size), "data": base64.b64encode(np.asarray(values, dtype="<f4").tobytes()).decode()}


def unpacked(doc: dict[str, Any]) -> F1:
    """What `packed` packed."""
    return np.frombuffer(base64.b64decode(doc["data"]), dtype="<f4").astype(np.float64)


def packed_covariance(matrix: F2) -> dict[str, Any]:
    """A symmetric matrix, its lower triangle only."""
    lower = np.asarray(matrix, dtype=np.float64)[np.tril_indices(len(matrix))]
    return {"encoding": MATRIX, "n": len(matrix), "data": base64.b64encode(lower.astype("<f8").tobytes()).decode()}


def unpacked_covariance(doc: dict[str, Any]) -> F2:
    """What `packed_covariance` packed."""
    n = int(doc["n"])
    out = np.zeros((n, n))
    out[np.tril_indices(n)] = np.frombuffer(base64.b64decode(doc["data"]), dtype="<f8")
    return np.asarray(out + np.tril(out, -1).T)
