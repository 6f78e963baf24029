"""Parameters in the Pahk vector files: ``d/YX`` is d_y(X), ``E/YX`` is E_y(X)."""

from __future__ import annotations

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.service.vectors.case import VectorCase

AXES = "XYZ"


def pair(part: VectorCase, key: str) -> F2:
    """Nine numbers of ``d`` or ``E`` as an array, shape (3 axes, 3 directions)."""
    return np.array([[part.number(key, direction + axis) for direction in AXES] for axis in AXES])


def squareness(part: VectorCase) -> F1:
    """alpha, beta1, beta2, shape (3,)."""
    return np.array([part.number(name) for name in ("alpha", "beta1", "beta2")])
