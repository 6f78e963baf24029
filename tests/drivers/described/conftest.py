from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.drivers.described.foreign import FILE, World, compiled, free_port, program, serial_pair


@pytest.fixture(scope="session")
def foreign_program(tmp_path_factory: pytest.TempPathFactory) -> Path | None:
    return compiled(tmp_path_factory.mktemp("foreign"))


@pytest.fixture
def foreign_meter(require, foreign_program: Path | None) -> str:
    require("libmodbus", foreign_program is not None, "libmodbus-dev and a C compiler are not installed")
    return str(foreign_program)


@pytest.fixture
def world(tmp_path: Path) -> Iterator[World]:
    made = World(tmp_path / "world")
    yield made
    made.close()


@pytest.fixture
def url(foreign_meter: str, world: World) -> Iterator[str]:
    """The foreign meter on Modbus TCP, with its own device file."""
    port = free_port()
    with program(foreign_meter, "tcp", str(port), str(world.path), ready="ready"):
        yield f"modbus+tcp://127.0.0.1:{port}?device={FILE}"


@pytest.fixture
def rtu_url(require, foreign_meter: str, world: World, tmp_path: Path) -> Iterator[str]:
    """The same on Modbus RTU, over a pair of ptys of socat."""
    require("socat", shutil.which("socat") is not None, "socat is not installed")
    with serial_pair(tmp_path) as (ours, theirs), program(foreign_meter, "rtu", str(theirs), str(world.path), ready="ready"):
        yield f"modbus+rtu://{ours}?device={FILE}"
