"""The store with one of everything that the tests of the interface use, and the read model over it."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from abbe.service.queries.reader import Reader
from tests.service.web.api_bench import NAME, Plant, open_plant


@pytest.fixture(scope="session")
def plant(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Plant]:
    with open_plant(tmp_path_factory) as found:
        yield found


@pytest.fixture
def reader(plant: Plant) -> Reader:
    return Reader(plant.store, NAME, plant.clock)
