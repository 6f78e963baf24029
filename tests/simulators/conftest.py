"""Worlds and processes for the tests of the simulators."""

import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import pytest

from abbe.simulators.scenario import Scenario, from_dict
from abbe.simulators.world import World
from tests.patience import within

QUIET = {
    "scale_sd_um_per_m": 0.0,
    "squareness_sd_urad": 0.0,
    "positioning_rms_um": [0.0, 0.0],
    "straightness_rms_um": [0.0, 0.0],
    "angle_rms_urad": [0.0, 0.0],
    "angle_slope_sd_urad": 0.0,
    "backlash_um": [0.0, 0.0],
    "cup_offset_um": [0.0, 0.0],
    "bar_length_sd_um": 0.0,
    "bar_noise_um": [0.0, 0.0],
    "mirror_tilt_urad": [0.0, 0.0],
    "beam_misalignment_urad": [0.0, 0.0],
    "drift_sd_um": 0.0,
}
"""Magnitudes of a perfect machine with perfect instruments."""


@pytest.fixture
def scenario() -> Callable[..., Scenario]:
    """``scenario(seed=3, backlash_um=[4, 4])``: perfect but for the magnitudes named."""

    def make(seed: int = 1, **magnitudes: Any) -> Scenario:
        return from_dict({"seed": seed, "magnitudes": {**QUIET, **magnitudes}})

    return make


@pytest.fixture
def quiet_world(scenario: Callable[..., Scenario]) -> Callable[..., World]:
    """``quiet_world(...)``: the world of ``scenario(...)``."""
    return lambda seed=1, **magnitudes: World(scenario(seed, **magnitudes))


@dataclass
class Running:
    """A simulator process that is ready."""

    process: subprocess.Popen[bytes]
    ready: dict[str, Any]

    def port(self, device: str) -> int:
        return int(self.ready[device].partition("127.0.0.1:")[2].partition("?")[0])

    def path(self, device: str) -> str:
        return str(self.ready[device].partition("://")[2].partition("?")[0])


@contextmanager
def running(*arguments: str) -> Iterator[Running]:
    """A simulator process that ends with the block."""
    process = subprocess.Popen(
        [sys.executable, "-m", "abbe.simulators", "--watch-stdin", *arguments], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    assert process.stdin is not None
    assert process.stdout is not None
    try:
        yield Running(process, json.loads(process.stdout.readline()))
    finally:
        process.stdin.close()
        process.stdout.close()
        process.wait(within(5))


@pytest.fixture
def start() -> Callable[..., Any]:
    """``with start("--speed", "10") as sim:``."""
    return running
