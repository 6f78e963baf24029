"""The traffic is real: programs that nobody here wrote read our wires (mbpoll of libmodbus; socat between driver and pty)."""

from __future__ import annotations

import json
import re
import select
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

from abbe.drivers.registry import open_ballbar
from tests.patience import within
from tests.scenarios.world import simulators_of, wait_for

pytestmark = [pytest.mark.scenario, pytest.mark.timeout(120)]


@pytest.fixture
def ready(tmp_path: Path):
    words = [sys.executable, "-m", "abbe.simulators", "--watch-stdin", "--speed", "1", "--link-dir", str(tmp_path)]
    process = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdin is not None
    assert process.stdout is not None
    yield json.loads(process.stdout.readline())
    process.stdin.close()
    process.wait(timeout=within(10))
    process.stdout.close()


@pytest.mark.parametrize("device", ["cnc", "laser"])
def test_mbpoll_reads_the_canary_registers(ready, require, device):
    require("mbpoll", shutil.which("mbpoll") is not None, "mbpoll is not installed")
    assert_canaries(re.search(r":(\d+)\?", ready[device]).group(1))


def assert_canaries(port: str) -> None:
    def poll(kind: str, register: int) -> str:
        words = ["mbpoll", "-m", "tcp", "-p", port, "-a", "1", "-t", kind, "-B", "-0", "-r", str(register), "-c", "1", "-1", "127.0.0.1"]
        found = subprocess.run(words, capture_output=True, text=True, timeout=20, check=True).stdout
        return re.search(rf"\[{register}\]:\s+(\S+)", found).group(1)

    assert int(poll("4:int", 0)) == 0x01020304
    assert float(poll("4:float", 2)) == 1234.5
    assert float(poll("3:float", 2)) == 1234.5  # the same as input register


def test_mbpoll_reads_a_running_demonstration(require, tmp_path):
    require("mbpoll", shutil.which("mbpoll") is not None, "mbpoll is not installed")
    folder = tmp_path / "kept"
    words = [sys.executable, "-c", "from abbe.service.cli import main; main()", "demo", "--speed", "1", "--keep", str(folder)]
    with subprocess.Popen(words, stderr=subprocess.PIPE, text=True) as demo:
        try:
            address = wait_for(lambda: cnc_port(folder / "machine.toml"), 30, "the demonstration's machine file")
            assert_canaries(address)
            assert demo.poll() is None
        finally:
            demo.terminate()
            _, err = demo.communicate(timeout=within(20))
    assert demo.returncode == 143, err
    assert "Traceback" not in err
    assert simulators_of(folder) == []


def cnc_port(machine_file: Path) -> str | None:
    """Port of the controller, once the machine file names it."""
    found = re.search(r'^cnc = "\S+:(\d+)\?', machine_file.read_text(), re.MULTILINE) if machine_file.exists() else None
    return found.group(1) if found else None


async def test_socat_between_driver_and_pty_shows_the_documented_frames(ready, require, tmp_path):
    require("socat", shutil.which("socat") is not None, "socat is not installed")
    device = re.match(r"serial://([^?]+)", ready["ballbar"]).group(1)
    ours, log = tmp_path / "bridge", tmp_path / "traffic"
    with log.open("wb") as err:
        words = ["socat", "-v", "-x", f"pty,raw,echo=0,link={ours}", f"open:{device},raw,echo=0"]
        bridge = subprocess.Popen(words, stderr=err)  # noqa: ASYNC220 - starting it blocks for a millisecond only
        try:
            end = time.monotonic() + within(10)
            while not ours.exists() and time.monotonic() < end:
                select.select([], [], [], 0.02)
            bar = await open_ballbar(f"serial://{ours}?baud=460800")
            try:
                info = await bar.identify()
                async with bar.stream(1000) as batches:
                    count = 0
                    async for batch in batches:
                        count += len(batch.samples)
                        if count >= 200:
                            break
            finally:
                await bar.close()
        finally:
            bridge.terminate()
            bridge.wait(timeout=within(10))
    seen = " ".join(re.findall(r"^ ((?:[0-9a-f]{2} ?)+)", log.read_text(errors="replace"), flags=re.MULTILINE)).replace("  ", " ")
    assert info.serial_no
    assert re.search(r"a5 5a 81 02 .. .. .. ..", seen)  # IDENTIFY with a tag
    assert re.search(r"a5 5a 82 04 .. .. e8 03 .. ..", seen)  # START at 1000 Hz
    assert re.search(r"a5 5a 02 1c", seen)  # INFO
    assert len(re.findall(r"a5 5a 01 12", seen)) >= 150  # SAMPLE frames (a frame cut between two reads of socat is not counted)
