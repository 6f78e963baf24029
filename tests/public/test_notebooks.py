"""The notebooks of the documentation run in a folder that holds strangers' modules, and show what they promise."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from abbe.service.sequences.recipes.recipe_file import read_recipe

FOLDER = Path(__file__).parents[2] / "docs/notebooks"
SHOWN = {
    "understand": (r"\ngood: ", r"\nnamed 5\.\d+ .*µm|\nnamed 6\.\d+ .*µm", r"'after_um'"),
    "plan": (
        r"\n +\d+% ",
        r"U = +\d+\.\d µm   laser along",
        r"\n(good|fair): ",
        r"EXX (19\.|20|20\.)\S* .* true: 20",
        r"\n<abbe.Plan: \d+ measurements, \d+ min, U = .* µm> <svg",
    ),
    "own-effect": (r"<abbe.Answer: unknown, no effect>", r"<abbe.Answer: named, clamp_step> (5\.9\d*|6|6\.\d+) "),
}
"""What each prints, in this order."""
SHORT = {"minutes=40": "minutes=25"}
"""A shorter plan in every run, the notebook's own one in the long run."""
MORE = {"plan": ["print(plan, plan.plot().svg[:4])"]}
IS_LONG = os.environ.get("ABBE_TEST_LONG") == "1"
LONG = pytest.mark.skipif(not IS_LONG, reason="two whole searches (ABBE_TEST_LONG=1); as test_public does")
PLAYED = [pytest.param(name, marks=LONG if name == "own-effect" else ()) for name in SHOWN]


def code(name: str) -> list[str]:
    cells = json.loads((FOLDER / f"{name}.ipynb").read_text(encoding="utf-8"))["cells"]
    return ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]


def test_each_notebook_is_here_without_outputs() -> None:
    assert {path.stem for path in FOLDER.iterdir()} == set(SHOWN)
    for name in SHOWN:
        cells = json.loads((FOLDER / f"{name}.ipynb").read_text(encoding="utf-8"))["cells"]
        assert [cell for cell in cells if cell.get("outputs") or cell.get("execution_count")] == []


@pytest.mark.parametrize("name", PLAYED)
@pytest.mark.timeout(400)
def test_it_runs_beside_a_foreign_models_py(name: str, tmp_path: Path) -> None:
    for foreign in ("models.py", "service.py", "drivers.py", "simulators.py"):
        (tmp_path / foreign).write_text("raise SystemExit('a module of a stranger was imported')\n")
    text = "\n".join([*code(name), *MORE.get(name, [])])
    for whole, part in () if IS_LONG else SHORT.items():
        text = text.replace(whole, part)
    (tmp_path / "cells.py").write_text(text)
    ran = subprocess.run([sys.executable, "cells.py"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    at = 0
    for pattern in SHOWN[name]:
        found = re.search(pattern, "\n" + ran.stdout[at:])
        assert found, f"{pattern}\n{ran.stdout}"
        at += found.end() - 1
    if name == "plan":
        assert read_recipe(tmp_path / "forty.toml")[1]
