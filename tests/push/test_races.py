"""Two services, or two operators of one, push into one simulated controller at once: one owner, and no writes of both mixed."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.push.bench import Zygote
from tests.push.races import DATABASES, races
from tests.scenarios.conftest import simulated

pytestmark = [pytest.mark.scenario, pytest.mark.timeout(600)]

COUNT = 100 if os.environ.get("ABBE_TEST_LONG") == "1" else 5


@pytest.fixture(scope="module")
def zygotes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Zygote, Zygote]]:
    folder = tmp_path_factory.mktemp("zygotes")
    two = Zygote(folder / "one.log"), Zygote(folder / "other.log")
    yield two
    for made in two:
        made.close()


@pytest.mark.parametrize("case", DATABASES)
def test_two_that_push_at_once(tmp_path: Path, case: str, zygotes: tuple[Zygote, Zygote]) -> None:
    """`python -m tests.experiments.campaigns.push races` does 200 of each."""
    met = writes = 0
    for seed in range(3, 9):  # beside other tests two processes may miss each other; then they race again
        folder = tmp_path / str(seed)
        folder.mkdir()
        with simulated(folder, "--speed", "60") as sims:
            found = races(sims.ready["cnc"], sims.ask, folder, DATABASES[case], COUNT, seed, zygotes=zygotes)
        assert found.violations == [], found.text()
        met, writes = met + found.met, writes + found.writes
        if met >= COUNT // 2:
            break
    assert met >= COUNT // 2
    assert writes > 0
