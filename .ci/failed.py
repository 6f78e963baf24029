"""Print the tests that failed in .ci/run and may be asked once more, alone; exit 1 where a failure is not of that kind.

Of that kind are at most three failed tests, none of them a test of safety, in a run that ended by itself: no time-out, no interruption, no
error of pytest, no module that could not be read.
"""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

MOST = 3
RUN_FAILED = 2  # what make says when its command failed; a time-out says 124
TESTS_FAILED = re.compile(r"^make(\[\d+\])?: \*\*\* .*\] Error 1$", re.MULTILINE)  # what pytest told make
SAFETY = re.compile(
    r"^tests/(push|faults|linuxcnc)/|/test_[a-z0-9_]*"
    r"(alarm_manager|banks|commission|correct|desk|devices_first|door|interlock|kill|order|pending|proposal|push|recover|rollback|session|stop|table|unverified"
    r"|verified|watch|worse)"
)
"""Tests of pushes, tables, recovery, interlocks and faults, by folder or by a word of the file's name: one failure is a failure."""


def failed(logs: Path) -> list[str]:
    """Return the failed tests, as pytest's own cache names them."""
    cache = logs / "cache/v/cache/lastfailed"
    return sorted(json.loads(cache.read_text())) if cache.exists() else []


def refusal(logs: Path, code: int) -> str | None:
    """Return why the failures count as they are, or None where they may be asked once more."""
    tests = failed(logs)
    if code != RUN_FAILED or not tests or not TESTS_FAILED.search((logs / "log").read_text(errors="replace")):
        return "the run did not end by itself, or failed without a failed test"
    if not all("::" in test for test in tests):
        return "a module could not be read"
    if safety := [test for test in tests if SAFETY.search(test)]:
        return f"a test of safety failed: {', '.join(safety)}"
    if len(tests) > MOST:
        return f"{len(tests)} tests failed, and no more than {MOST} are asked once more"
    return None


def main() -> None:
    """Judge the log and cache in the folder named first by make's exit code."""
    logs, code = Path(sys.argv[1]), int(sys.argv[2])
    if why := refusal(logs, code):
        sys.exit(f"not asked once more: {why}")
    sys.stdout.writelines(f"{test}\n" for test in failed(logs))


if __name__ == "__main__":
    main()
