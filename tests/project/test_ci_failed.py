"""Which failures of a complete run may be asked once more, alone (docs/decisions/0024-asked-once-more.md)."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).resolve().parents[2] / ".ci" / "failed.py"
ENDED = "1 failed, 9 passed in 3.00s\nmake: *** [Makefile:26: test] Error 1\n"


def asked(logs: Path, failed: list[str], code: int = 2, text: str = ENDED) -> tuple[int, str]:
    """Return exit code and answer of the script for a run with these failed tests and this exit code of make."""
    cache = logs / "cache" / "v" / "cache"
    cache.mkdir(parents=True)
    if failed:  # pytest writes no file where nothing ever failed
        (cache / "lastfailed").write_text(json.dumps(dict.fromkeys(failed, True)))
    (logs / "log").write_text(text)
    done = subprocess.run([sys.executable, SCRIPT, logs, str(code)], capture_output=True, text=True, check=False)
    return done.returncode, done.stdout + done.stderr


def test_up_to_three_failed_tests_are_named_one_a_line(tmp_path: Path) -> None:
    tests = ["tests/b.py::test_b", "tests/a.py::test_a[x y]", "tests/b.py::test_c"]
    assert asked(tmp_path, tests) == (0, "tests/a.py::test_a[x y]\ntests/b.py::test_b\ntests/b.py::test_c\n")


@pytest.mark.parametrize(
    ("failed", "code", "text", "why"),
    [
        (["t.py::a", "t.py::b", "t.py::c", "t.py::d"], 2, ENDED, "4 tests failed"),
        (["t.py::a"], 124, "", "did not end by itself"),  # the time-out of the whole run
        (["t.py::a"], 2, "make: *** [Makefile:26: test] Error 3\n", "did not end by itself"),  # an error within pytest
        ([], 2, ENDED, "did not end by itself"),  # a fixture of the whole session
        (["t.py"], 2, ENDED, "could not be read"),  # a module that cannot be imported
    ],
)
def test_what_is_no_single_test_failure_counts_as_it_is(tmp_path: Path, failed: list[str], code: int, text: str, why: str) -> None:
    returned, said = asked(tmp_path, failed, code, text)
    assert returned == 1
    assert said.startswith("not asked once more: ")
    assert why in said


@pytest.mark.parametrize(
    "test",
    [
        "tests/push/test_sweep.py::test_a",
        "tests/faults/test_interlocks.py::test_a",
        "tests/scenarios/test_pending.py::test_a",
        "tests/scenarios/test_push_stopped.py::test_a",
        "tests/scenarios/test_worse.py::test_a",
        "tests/system/test_serve_recovery.py::test_a",
        "tests/system/test_serve_rollback.py::test_a[x]",
        "tests/drivers/contract/test_cnc_banks.py::test_a",
    ],
)
def test_a_test_of_safety_is_never_asked_twice(tmp_path: Path, test: str) -> None:
    returned, said = asked(tmp_path, [test, "tests/service/storage/test_store.py::test_a"])
    assert returned == 1
    assert f"a test of safety failed: {test}" in said
