"""Semantic digest of a table in two ways that share no code: from the computed tables, and from the content of a bank.

If the encoder gets a sign, an axis or a unit wrong, the two differ. Only the physical probe shows what both get wrong.
"""

from __future__ import annotations

import hashlib

from abbe.drivers.second_decoder import UnreadableImage, read_axis_tables
from abbe.models.compensation.tables import NineTables
from abbe.service.push.entries import canonical

_POSITIONS_PER_MM = 1e5
_VALUES_PER_MM = 1e6

Rows = list[tuple[str, str, list[tuple[int, int]]]]


def semantic_digest_of_tables(tables: NineTables) -> str:
    """Digest of corrections (added to the command): position in 10 nm and correction in nm, for each moved and each corrected axis."""
    rows: Rows = []
    for a, moved in enumerate("XYZ"):
        for i, corrected in enumerate("XYZ"):
            pairs = zip(tables.position_mm[a].tolist(), tables.correction_mm[a][:, i].tolist(), strict=True)
            rows.append((moved, corrected, [(round(p * _POSITIONS_PER_MM), round(c * _VALUES_PER_MM)) for p, c in pairs]))
    return _digest(rows)


def semantic_digest_of_image(image: bytes) -> str:
    """Digest of a bank as the independent decoder reads it; ``"unreadable"`` if it cannot."""
    try:
        curves = read_axis_tables(image)
    except UnreadableImage:
        return "unreadable"
    rows: Rows = []
    for (moved, corrected), pairs in curves.items():
        rows.append((moved, corrected, [(round(p * _POSITIONS_PER_MM), round(c * _VALUES_PER_MM)) for p, c in pairs]))
    return _digest(rows)


def _digest(rows: Rows) -> str:
    return hashlib.sha256(canonical(sorted(rows))).hexdigest()
