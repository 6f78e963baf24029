"""Arrays inside stored documents: compact, exact to the resolution of a reading, in an open encoding."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from typing import Self

import numpy as np

from abbe.models.arrays import F1, F2

READINGS = "base64 of float32, little endian, mm"
MATRIX = "base64 of float64, little endian, lower triangle by rows"


@dataclass(frozen=True, slots=True, kw_only=True)
class PackedReadings:
    """Residuals or predictions of one run, mm; float32 keeps 7 digits, a nanometre of 10 mm."""

    n: int
    data: str
    encoding: str = READINGS

    @classmethod
    def of(cls, values_mm: F1) -> Self:
        """Pack readings, shape (n,)."""
        return cls(n=int(values_mm.size), data=base64.b64encode(np.asarray(values_mm, dtype="<f4").tobytes()).decode())

    @property
    def values_mm(self) -> F1:
        """The readings, shape (n,)."""
        return np.frombuffer(base64.b64decode(self.data), dtype="<f4").astype(np.float64)


@dataclass(frozen=True, slots=True, kw_only=True)
class PackedCovariance:
    """A symmetric matrix, its lower triangle only."""

    n: int
    data: str
    encoding: str = MATRIX

    @classmethod
    def of(cls, matrix: F2) -> Self:
        """Pack a symmetric matrix, shape (n, n)."""
        lower = np.asarray(matrix, dtype=np.float64)[np.tril_indices(len(matrix))]
        return cls(n=len(matrix), data=base64.b64encode(lower.astype("<f8").tobytes()).decode())

    @property
    def matrix(self) -> F2:
        """The matrix, shape (n, n)."""
        out = np.zeros((self.n, self.n))
        out[np.tril_indices(self.n)] = np.frombuffer(base64.b64decode(self.data), dtype="<f8")
        return np.asarray(out + np.tril(out, -1).T)
