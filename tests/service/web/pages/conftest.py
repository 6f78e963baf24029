"""One running page over a filled store for all tests of the screens: filling and solving is what takes their time."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.pages_world import Served, filled_once, served


@pytest.fixture(scope="package")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with served(filled_once(tmp_path_factory)) as one:
        yield one
