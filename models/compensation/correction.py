"""Correction function, common to all kinds of table: commanded positions to corrections."""

from __future__ import annotations

from collections.abc import Callable

from abbe.models.arrays import F2

Correction = Callable[[F2], F2]
"""Commanded positions, shape (n, 3), to corrections added to the command, shape (n, 3), mm."""
