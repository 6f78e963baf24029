"""How long a test waits for something that other processes do: long beside other tests, which share its cores, and short alone."""

from __future__ import annotations

import os

BESIDE_OTHERS = 6.0


def within(seconds: float) -> float:
    """The limit of a wait, in s, that ``seconds`` are enough for on a machine at rest. A limit ends a hang; it measures nothing."""
    return seconds * BESIDE_OTHERS if "PYTEST_XDIST_WORKER" in os.environ else seconds
