"""README works word by word: a script types its lines into a shell, in an empty folder, beside the simulated machine of README."""

from __future__ import annotations

import os
import re
import shlex
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.conftest import LONG, ROOT
from tests.patience import within
from tests.service.cli.test_every_command import parsed

pytestmark = [pytest.mark.scenario, pytest.mark.timeout(1500)]
SECTION = (ROOT / "README.md").read_text(encoding="utf-8").split("## On your machine")[1].split("\n## ")[0]
LINES = [line.partition("#")[0].strip() for line in re.findall(r"^    (abbe .*)$", SECTION, re.MULTILINE)]
INIT, SIM, *WORKS, SERVE = LINES
"""Lines of README: for a machine of one's own, for the simulated one, the work on either, and the service, which does not end."""
FASTER = {"--speed 20": f"--speed {os.environ.get('ABBE_README_SPEED', '80')}"}
SHORT = 3
"""Number of lines that are typed in every run of the tests; all of them take minutes and belong to the long run."""


def test_every_line_is_a_command() -> None:
    assert (INIT, SERVE) == ("abbe init", "abbe serve")
    assert len(WORKS) == 10
    for line in LINES:
        assert parsed(shlex.split(line)[1:])


@pytest.fixture
def shell(tmp_path: Path) -> Iterator[dict[str, str]]:
    """The environment of a person in an empty folder, in whose other terminal the simulated machine runs."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith("ABBE_")}
    environment["PATH"] = f"{Path(sys.executable).parent}:{environment['PATH']}"
    words = SIM.replace(*next(iter(FASTER.items())))
    other = subprocess.Popen(words, shell=True, cwd=tmp_path, env=environment, stdout=subprocess.PIPE, start_new_session=True)
    assert other.stdout is not None
    assert other.stdout.readline().startswith(b'{"ready": true')
    yield environment
    os.killpg(other.pid, signal.SIGINT)
    other.communicate(timeout=within(20))


def test_the_lines_of_readme_work_in_their_order(shell: dict[str, str], tmp_path: Path) -> None:
    table = []
    for line in WORKS if LONG else WORKS[:SHORT]:
        done = subprocess.run(line, shell=True, cwd=tmp_path, env=shell, capture_output=True, text=True, check=False)
        table.append((done.returncode, line, done.stderr.splitlines()[-1:]))
        assert done.returncode == 0, f"{line}\n{done.stdout}{done.stderr}"
        assert done.stderr.splitlines()[-1].startswith("next: abbe "), line
    assert (tmp_path / "first.pdf").read_bytes().startswith(b"%PDF")
    if LONG:
        assert "body_diagonal_um" in done.stdout, "the trend of what was checked"
    for row in table:
        sys.stdout.write(f"{row}\n")
