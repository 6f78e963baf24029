"""What the box sends in the capture benchmark, and who takes it."""

from __future__ import annotations

from typing import Any

NEED_HZ = 1000
SAMPLES = {"ours": 300_000, "plain-batch": 30_000, "plain": 500}
"""How many each contestant is given; rates are per sample."""


def device_us(seq: Any) -> Any:
    """Device clock of a sample, µs; of an int or of an array."""
    return 1000 * (seq + 1)


def reading_nm(seq: Any) -> Any:
    """Reading of a sample: smooth, within the stroke, and another one for each neighbour."""
    return (seq * 17) % 20_000 - 10_000
