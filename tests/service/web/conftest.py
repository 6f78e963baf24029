"""One plant for all tests that only look; a test that decides something makes proposals of its own."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.service.web.api_bench import Plant, open_plant


@pytest.fixture(scope="session")
def plant(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Plant]:
    with open_plant(tmp_path_factory) as found:
        yield found
