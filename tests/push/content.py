"""What the worlds of the push tests hold: small sets of nine tables, as the given encoder writes them, and what they mean."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from abbe.drivers.tables import NO_CORRECTION, TableImage, encode
from abbe.models.compensation.tables import NineTables


@cache
def tables(scale: int, sign: int = 1) -> NineTables:
    """A small set of nine tables whose columns all differ, values in whole LSB of 100 nm."""
    position = tuple(np.array([0.0, 100.0 + 50.0 * a]) for a in range(3))
    values = tuple(np.array([[0.0] * 3, [sign * 1e-4 * (scale + 7 * a + 3 * i) for i in range(3)]]) for a in range(3))
    nothing = np.full((2, 3), np.nan)
    return NineTables((position[0], position[1], position[2]), (values[0], values[1], values[2]), (nothing, nothing, nothing))


@cache
def images(codec: Any) -> tuple[bytes, bytes, bytes]:
    """(factory, base, candidate) as the given encoder makes them."""
    factory = encode(TableImage(NO_CORRECTION, 0, 100, (0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (0, 0, 0), ()))
    return factory, encode(codec.table_image(tables(40), 100, 1)), encode(codec.table_image(tables(55), 100, 2))


@cache
def meanings(module: Any) -> Any:
    return cache(module.semantic_digest_of_image)
