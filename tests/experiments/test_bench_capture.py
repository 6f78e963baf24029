"""The capture benchmark at a small size: every contestant stores exactly what the box sent."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.experiments.bench.capture import lines
from tests.experiments.bench.capture_case import SAMPLES


@pytest.mark.parametrize("name", SAMPLES)
def test_every_contestant_stores_what_was_sent(name: str, tmp_path: Path) -> None:
    words = [sys.executable, "-m", "tests.experiments.bench.capture_worker", name, str(tmp_path), "60"]
    found = json.loads(subprocess.run(words, capture_output=True, text=True, check=True).stdout)
    assert (found["samples"], found["right"]) == (60, True)
    assert found["cpu_s"] > 0.0


def test_the_table_marks_who_differs_and_gives_the_ratio() -> None:
    one = {"samples": 10, "per_core_hz": 100_000.0, "wall_hz": 5.0, "us_per_sample": 10.0, "right": True}
    found = {"ours": one, "plain-batch": one | {"per_core_hz": 5_000.0}, "plain": one | {"per_core_hz": 1_000.0, "right": False}}
    text = "\n".join(lines(found))
    assert text.count("DIFFERS") == 1
    assert text.split("commit every 50 ms")[-1].split()[0] == "20"
    assert "100.0" in text
