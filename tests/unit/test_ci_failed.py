"""Which failures of a complete run may be asked once more, alone (docs/decisions/0024-asked-once-more.md)."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).resolve().parents[2] / ".ci" / "failed.py"
ENDED = "1 failed, 9 passed in 3.00s\nmake: *** [Makefile:26: test] Error 1\n"


def asked(logs: Path, streams: dict[str, list[str]], codes: list[int], text: str = ENDED) -> tuple[int, str]:
    """Return exit code and answer of the script for streams with these failed tests and exit codes."""
    for name, failed in streams.items():
        cache = logs / "failed" / name / "v" / "cache"
        cache.mkdir(parents=True)
        if failed:  # pytest writes no file where nothing ever failed
            (cache / "lastfailed").write_text(json.dumps(dict.fromkeys(failed, True)))
        (logs / name).write_text(text if failed else "10 passed in 3.00s\n")
    done = subprocess.run([sys.executable, SCRIPT, logs, *map(str, codes)], capture_output=True, text=True, check=False)
    return done.returncode, done.stdout + done.stderr


def test_nothing_failed_and_nothing_is_asked(tmp_path: Path) -> None:
    assert asked(tmp_path, {"wires": [], "parts": []}, [0, 0]) == (0, "")


def test_up_to_three_failed_tests_are_named_one_a_line(tmp_path: Path) -> None:
    streams = {"wires": ["tests/a.py::test_a[x y]"], "parts": ["tests/b.py::test_b", "tests/b.py::test_c"], "faults": []}
    assert asked(tmp_path, streams, [2, 2, 0]) == (0, "tests/b.py::test_b\ntests/b.py::test_c\ntests/a.py::test_a[x y]\n")


@pytest.mark.parametrize(
    ("failed", "codes", "text", "why"),
    [
        (["t.py::a", "t.py::b", "t.py::c", "t.py::d"], [2, 0], ENDED, "4 tests failed"),
        (["t.py::a"], [124, 0], "", "did not end by itself"),  # the time-out of the whole stream
        (["t.py::a"], [2, 2], ENDED, "did not end by itself"),  # another stream failed and does not say with which test
        (["t.py::a"], [0, 0], ENDED, "did not end by itself"),
        (["t.py::a"], [2, 0], "make: *** [Makefile:26: test] Error 3\n", "something else"),  # an error within pytest
        (["t.py"], [2, 0], ENDED, "could not be read"),  # a module that cannot be imported
    ],
)
def test_what_is_no_single_test_failure_counts_as_it_is(tmp_path: Path, failed: list[str], codes: list[int], text: str, why: str) -> None:
    code, said = asked(tmp_path, {"wires": failed, "parts": []}, codes, text)
    assert code == 1
    assert said.startswith("not asked once more: ")
    assert why in said
