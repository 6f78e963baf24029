"""Which packaged scenario a seed stands for: whoever only knows the seed does not know what is hidden, or whether anything is."""

import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np

from abbe.simulators.scenario import DEFAULT_PATH, Scenario, load

STREAM_PICK = 61


def packaged() -> list[Path]:
    """Scenarios that keep a secret, and the one in which nothing is hidden, by name."""
    return sorted(DEFAULT_PATH.parent.glob("hidden-*.toml"))


def picked(seed: int) -> Scenario:
    """The scenario of a seed; the machine is drawn by the same seed.

    Every scenario draws a lot of its own, the highest wins: one more scenario takes over the seeds that it wins and changes no other.

    Raises
    ------
    ScenarioError
        The seed is negative.
    """
    return replace(load(winner(seed, packaged())), seed=seed)


def winner(seed: int, paths: list[Path]) -> Path:
    """The scenario that draws the highest lot with a seed."""

    def lot(path: Path) -> float:
        return float(np.random.default_rng([STREAM_PICK, abs(seed), zlib.crc32(path.name.encode())]).random())

    return max(paths, key=lot)
