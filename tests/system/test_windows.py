"""What docs/how-to/windows.md says of Windows without Linux: planning, reading, solving work; what moves or serves is refused.

Windows itself is not here: `as_on_windows.py` takes its missing modules, signals and functions away.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import ROOT

FILE = (ROOT / "deploy" / "machine.example.toml").read_text(encoding="utf-8")
REFUSED = "error CFG-001: this system has no file locks: Abbe measures and serves on Linux only - docs/how-to/windows.md\n"
READS = ["check-config", "measure --recipe quick-check --dry-run"]
if os.environ.get("ABBE_TEST_LONG") == "1":
    READS += ["version", "effects backlash", "comp formats"]
LIBRARY = """
import abbe
machine = abbe.Machine("w-X-Y-b-Z-t", [[0, 600], [0, 500], [0, 450]])
errors = abbe.ErrorMotions({"EXX": abbe.Polynomial([0, 2e-5], 0.0)}, {"C0Y": 30e-6})
plan = abbe.plan(machine, minutes=12)
solution = abbe.solve(abbe.simulate(machine, plan.campaign, errors), model="rigid6")
solution.report("june.html")
print("solved", round(solution.parameters["C0Y"].value))
"""


def typed(folder: Path, *words: str) -> tuple[int, str, str]:
    command = [sys.executable, "-P", ROOT / "tests" / "system" / "as_on_windows.py", *words]
    known = os.environ | {"USER": "petra", "PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(command, cwd=folder, env=known, capture_output=True, text=True, check=False)
    return done.returncode, done.stdout, done.stderr


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "abbe.toml").write_text(FILE, encoding="utf-8")
    return tmp_path


def test_the_library_plans_solves_and_reports(folder: Path) -> None:
    (folder / "ten.py").write_text(LIBRARY)
    code, out, err = typed(folder, "ten.py")
    assert (code, out) == (0, "solved 30\n"), err
    assert "<svg" in (folder / "june.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("words", READS)
def test_what_only_reads_works(folder: Path, words: str) -> None:
    code, _, err = typed(folder, *words.split())
    assert code == 0, err


@pytest.mark.parametrize("words", ["measure --recipe quick-check --name a", "comp push 1", "serve --once"])
def test_what_moves_or_serves_is_refused_in_one_line(folder: Path, words: str) -> None:
    assert typed(folder, *words.split()) == (2, "", REFUSED)
