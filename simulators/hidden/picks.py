"""Which packaged scenario a seed stands for: whoever only knows the seed does not know what is hidden, or whether anything is."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from simulators.scenario import DEFAULT_PATH, Scenario, load

STREAM_PICK = 61


def packaged() -> list[Path]:
    """Scenarios that keep a secret, and the one in which nothing is hidden, by name."""
    return sorted(DEFAULT_PATH.parent.glob("hidden-*.toml"))


def picked(seed: int) -> Scenario:
    """The scenario of a seed; the machine is drawn by the same seed.

    Raises
    ------
    ScenarioError
        The seed is negative.
    """
    paths = packaged()
    place = int(np.random.default_rng([STREAM_PICK, abs(seed)]).integers(len(paths)))
    return replace(load(paths[place]), seed=seed)
