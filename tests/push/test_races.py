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
    with simulated(tmp_path, "--speed", "60") as sims:
        found = races(sims.ready["cnc"], sims.ask, tmp_path, DATABASES[case], COUNT, 3, zygotes=zygotes)
    assert found.violations == [], found.text()
    assert found.met >= COUNT // 2, found.text()
    assert found.writes > 0
