"""A value with its standard uncertainty."""

from __future__ import annotations

from typing import NamedTuple


class Estimate(NamedTuple):
    """A value and its standard uncertainty (GUM, k = 1), both in ``unit``.

    ``status``: "observed", "weak" or "not observable". A value that is not observable means nothing without the other values.
    """

    value: float
    u: float
    unit: str
    status: str

    def __str__(self) -> str:
        return f"{self.value:.3g} ± {2.0 * self.u:.2g} {self.unit} (k = 2, {self.status})"
