"""The same machine on the simulated controller over real sockets with the journal in a real database; SIGKILL at every operation."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.push.bench import Bench, Zygote, image
from tests.push.random_kills import kills
from tests.scenarios.conftest import simulated

pytestmark = [pytest.mark.scenario, pytest.mark.timeout(600)]

LONG = os.environ.get("ABBE_TEST_LONG") == "1"
KILLS = 300 if LONG else 6
EVERY = 1 if LONG else 8
"""Every so manieth instant: not a multiple of three, so that before, during and after take turns."""


@pytest.fixture(scope="module")
def zygote(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Zygote]:
    made = Zygote(tmp_path_factory.mktemp("zygote") / "children.log")
    yield made
    made.close()


@pytest.fixture
def bench(tmp_path: Path, zygote: Zygote) -> Iterator[Bench]:
    with simulated(tmp_path, "--speed", "60") as sims:
        made = Bench(sims.ready["cnc"], tmp_path, zygote=zygote)
        yield made
        made.close()


def test_a_push_on_a_real_line_is_kept_or_goes_back(bench: Bench) -> None:
    kept = bench.do("push", height=40)["said"]
    assert (kept["state"], kept["active"], kept["lease"]) == ("KEEP", image(40), 0)
    back = bench.do("push", height=70, better=False)["said"]
    assert (back["state"], back["active"], back["lease"]) == ("ROLLED_BACK", image(40), 0)
    again = bench.do("recover")["said"]
    assert (again["state"], again["names"]) == ("ROLLED_BACK", ["LOOK"])


@pytest.mark.parametrize("better", [True, False], ids=["kept", "goes back"])
def test_killed_at_every_operation(bench: Bench, better: bool) -> None:
    base, height = image(40), 60
    assert bench.do("push", height=40)["said"]["state"] == "KEEP"
    names = bench.do("push", height=50, better=better)["said"]["names"]
    base, height = (image(50), 50) if better else (base, height)
    points = [(k, when) for k in range(len(names)) for when in ("before", "during", "after")]
    assert len(points) > 100
    for k, when in points[::EVERY]:
        died = bench.do("push", height=height, better=better, at=k, when=when)
        assert died["said"] is None, names[k]
        found = bench.do("recover")
        said = found["said"]
        assert said is not None, (names[k], when)
        assert found["took_s"] < 5.0, (names[k], when, said["names"])
        assert said["active"] in (base, image(height)), (names[k], when)
        assert said["settled"], (names[k], when, said)
        if said["state"] is None or said["state"] in ("ABORTED", "ROLLED_BACK"):
            assert said["active"] == base, (names[k], when)
        if said["state"] == "KEEP":
            base = said["active"]
        height = 60 if base == image(40) else 40
        assert said["lease"] == 0, (names[k], when)


def test_killed_from_outside_at_random_instants(bench: Bench) -> None:
    """`python -m tests.experiments.campaigns.push kills` does as many as ABBE_TEST_LONG=1: 300."""
    found = kills(bench, KILLS, 1)
    assert found.violations == [], found.text()
    assert found.killed >= KILLS, found.text()
    assert found.slowest_s < 5.0
