"""A working directory full of modules that are called like ours, and like those of Python: nothing of it is ever imported."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import httpx
import pytest

from tests.patience import within
from tests.scenarios.world import wait_for
from tests.system.serve_bench import free_port
from tests.system.test_serve_users import MACHINE

pytestmark = pytest.mark.timeout(300)

ABBE = Path(sys.executable).with_name("abbe")
OURS = ("abbe", "service", "drivers", "models", "simulators")
FILES = (
    "models",
    "drivers",
    "simulators",
    "service",
    "abbe",
    "numpy",
    "json",
    "random",
    "socket",
    "multiprocessing",
    "structlog",
    "sitecustomize",
)
SPRUNG = "sprung"
TRAP = f"import os\nopen(os.path.join({{folder!r}}, {SPRUNG!r}), 'a').write(__name__ + '\\n')\n"
PATIENCE_S = 60.0


@pytest.fixture
def traps(tmp_path: Path) -> Iterator[Path]:
    """The folder; at the end no trap has been sprung."""
    folder = tmp_path / "traps"
    folder.mkdir()
    code = TRAP.format(folder=str(tmp_path))
    for package in (*OURS, "abbe/service", "abbe/simulators", "service/web", "service/cli"):
        (folder / package).mkdir()
        for name in ("__init__", "__main__", "process"):
            (folder / package / f"{name}.py").write_text(code)
    for name in FILES:
        (folder / f"{name}.py").write_text(code)
    yield folder
    assert not (tmp_path / SPRUNG).exists(), (tmp_path / SPRUNG).read_text()


@contextmanager
def abbe(folder: Path, *words: str | Path) -> Iterator[subprocess.Popen[str]]:
    """The command as it is installed, with the traps for its working directory; ended with the block."""
    with (folder.parent / "said").open("w") as said:
        process = subprocess.Popen([ABBE, *words], cwd=folder, stdin=subprocess.DEVNULL, stdout=said, stderr=said, text=True)
    try:
        yield process
    finally:
        process.send_signal(signal.SIGINT)
        with suppress(subprocess.TimeoutExpired):
            process.wait(timeout=within(20))
        process.kill()
        process.wait()


def said(folder: Path) -> str:
    return (folder.parent / "said").read_text()


def test_the_traps_work(tmp_path: Path, traps: Path) -> None:
    """As children were started before; and as `multiprocessing` starts its own."""
    for words in (
        ["-m", "abbe.service.web.process"],
        ["-m", "abbe.simulators"],
        ["-c", "import models"],
        ["-c", "from multiprocessing.spawn import x"],
    ):
        subprocess.run(
            [sys.executable, *words], cwd=traps, env=os.environ | {"PYTHONPATH": ""}, capture_output=True, check=False, timeout=60
        )
        assert (tmp_path / SPRUNG).exists(), words
        (tmp_path / SPRUNG).unlink()


def test_sim(traps: Path) -> None:
    with abbe(traps, "sim"):
        ready = wait_for(lambda: next((line for line in said(traps).splitlines() if '"ready"' in line), None), PATIENCE_S, "the simulators")
        assert json.loads(ready)["ready"] is True
    assert "Traceback" not in said(traps)


def test_demo(traps: Path) -> None:
    """Until the simulated machine is measured: by then its children are up, and every module of ours that it needs is loaded."""
    with abbe(traps, "demo", "--speed", "200", "--keep", traps.parent / "kept"):
        wait_for(lambda: "identify: " in said(traps) or None, PATIENCE_S, f"the first run; {said(traps)}")
    assert "Traceback" not in said(traps)


def test_serve(traps: Path) -> None:
    port = free_port()
    (traps / "m.toml").write_text(MACHINE + f"port = {port}\n")
    with abbe(traps, "serve", "-m", "m.toml"):

        def answer() -> str | None:
            with suppress(httpx.TransportError):
                return httpx.get(f"http://127.0.0.1:{port}/", timeout=10).text
            return None

        assert "<html" in wait_for(answer, PATIENCE_S, "the page")
    assert "Traceback" not in said(traps)


def test_workers(traps: Path) -> None:
    """Python's own way of starting processes looks in the working directory, too. The parent is a script, as `abbe` is: without ``-P``."""
    program = traps.parent / "program.py"
    words = "print(list(ProcessExecutor(2).map(neg, [1, 2, 3])))"
    imports = "from operator import neg; from abbe.service.identification.reanalysis import ProcessExecutor"
    program.write_text(f"if __name__ == '__main__':\n    {imports}\n    {words}\n")
    done = subprocess.run(
        [sys.executable, program], cwd=traps, capture_output=True, text=True, check=False, timeout=120, env=os.environ | {"PYTHONPATH": ""}
    )
    assert (done.returncode, done.stdout) == (0, "[-1, -2, -3]\n"), done.stderr
