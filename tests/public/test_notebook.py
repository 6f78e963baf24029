"""The notebook of the documentation runs in a folder that holds strangers' modules, and says what it promises."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

NOTEBOOK = Path(__file__).parents[2] / "docs/how-to/notebook.ipynb"


def code() -> list[str]:
    cells = json.loads(NOTEBOOK.read_text())["cells"]
    return ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]


def test_the_notebook_is_ten_lines():
    assert sum(sum(bool(line.strip()) for line in cell.splitlines()) for cell in code()) <= 11  # ten and the import


def test_it_runs_beside_a_foreign_models_py(tmp_path: Path):
    for name in ("models.py", "service.py", "drivers.py", "simulators.py"):
        (tmp_path / name).write_text("raise SystemExit('a module of a stranger was imported')\n")
    (tmp_path / "cells.py").write_text("\n".join(code()))
    ran = subprocess.run([sys.executable, "cells.py"], cwd=tmp_path, capture_output=True, text=True, timeout=300, check=False)
    assert ran.returncode == 0, ran.stderr
    verdict, parameters, answer = ran.stdout.splitlines()
    assert verdict.startswith("good")
    assert "µm/m" in parameters
    assert answer.startswith("named")
