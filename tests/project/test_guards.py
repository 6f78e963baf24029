"""The guards of tests/conftest.py catch what they are for, and nothing else."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

CONFTEST = Path(__file__).resolve().parents[1] / "conftest.py"

GUILTY = """
import asyncio, subprocess, sys, time

async def test_task():
    asyncio.create_task(asyncio.sleep(100), name="sleeper")

async def test_connection():
    try:
        await asyncio.open_connection("10.0.0.1", 1)
    except OSError:
        pass

async def test_lookup():
    try:
        await asyncio.open_connection("somewhere.net", 1)
    except OSError:
        pass

def test_child():
    code = "import time; print(1, flush=True); time.sleep(100) # simulators"
    global child
    child = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE)
    child.stdout.readline()

def test_after():
    child.wait()
    child.stdout.close()

def test_demand(require):
    require("moon", False, "no moon here")
"""

INNOCENT = """
import asyncio, subprocess, sys
import pytest

@pytest.fixture
async def ticking():
    task = asyncio.create_task(asyncio.sleep(100))
    yield
    task.cancel()

async def test_fixture_ends_its_task(ticking): pass
def test_sync_with_async_fixture(ticking): pass
def test_own_loop(): asyncio.run(asyncio.sleep(0))

@pytest.mark.asyncio(loop_scope="module")
async def test_other_loop(): await asyncio.sleep(0)

async def test_cancelled_in_the_last_line():
    asyncio.create_task(asyncio.sleep(100)).cancel()

async def test_this_computer():
    server = await asyncio.start_server(lambda reader, writer: writer.close(), "127.0.0.1", 0)
    _, writer = await asyncio.open_connection("localhost", server.sockets[0].getsockname()[1])
    writer.close()
    server.close()
    await server.wait_closed()

@pytest.mark.parametrize("host", ["nowhere.invalid", "192.0.2.1"])
async def test_nowhere(host):
    with pytest.raises(OSError):
        await asyncio.open_connection(host, 1)

def test_child_that_ended():
    subprocess.run([sys.executable, "-c", "# simulators"], check=True)

def test_something_missing(require):
    require("sun", False, "no sun here")
"""


def run(folder: Path, source: str, **environment: str) -> str:
    shutil.copy(CONFTEST, folder / "conftest.py")
    (folder / "test_it.py").write_text(source)
    options = [
        "-p",
        "no:cacheprovider",
        "-p",
        "no:schemathesis",  # takes a second to import
        "-o",
        "asyncio_mode=auto",
        "-o",
        "asyncio_default_fixture_loop_scope=function",
        "-W",
        "error",
        "-rA",
    ]
    command = [sys.executable, "-m", "pytest", *options, str(folder)]
    surroundings = {**os.environ, "ABBE_TEST_REQUIRE": "moon"} | environment
    return subprocess.run(command, cwd=folder, env=surroundings, capture_output=True, text=True, check=False).stdout


def test_the_guilty_are_named(tmp_path: Path) -> None:
    out = run(tmp_path, GUILTY)
    for sign in (
        "tasks left running: sleeper",
        "another computer: 10.0.0.1",
        "another computer: somewhere.net",
        "simulators left running",
        "moon is required",
    ):
        assert sign in out, out
    assert re.search(r"1 failed, 5 passed, 4 errors", out), out


def test_the_innocent_pass(tmp_path: Path) -> None:
    out = run(tmp_path, INNOCENT)
    assert re.search(r"9 passed, 1 skipped", out), out
    assert "no sun here" in out


# One alone is the moon of the guilty; ABBE_TEST_LONG=1 plays it here, too.
@pytest.mark.parametrize("demanded", ["sun", "socat, sun"] if os.environ.get("ABBE_TEST_LONG") == "1" else ["socat, sun"])
def test_what_is_demanded_must_be_there(tmp_path: Path, demanded: str) -> None:
    out = run(tmp_path, INNOCENT, ABBE_TEST_REQUIRE=demanded)
    assert "sun is required here (ABBE_TEST_REQUIRE): no sun here" in out
