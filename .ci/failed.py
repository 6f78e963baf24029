"""Print the tests that failed in the streams of .ci/run and may be asked once more, alone; exit 1 where a failure is not of that kind.

Of that kind are at most three failed tests, in streams that ended by themselves: no time-out, no interruption, no error of pytest, no
module that could not be read.
"""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

MOST = 3
STREAM_FAILED = 2  # what make says when its command failed; a time-out says 124
TESTS_FAILED = re.compile(r"^make(\[\d+\])?: \*\*\* .*\] Error 1$", re.MULTILINE)  # what pytest told make


def failed(logs: Path) -> dict[str, list[str]]:
    """Return the failed tests by stream, as pytest's own caches name them."""
    caches = {path.name: path / "v/cache/lastfailed" for path in sorted((logs / "failed").iterdir())}
    return {name: sorted(json.loads(cache.read_text())) if cache.exists() else [] for name, cache in caches.items()}


def refusal(logs: Path, codes: list[int]) -> str | None:
    """Return why the failures count as they are, or None where they may be asked once more."""
    tests = failed(logs)
    broken = [name for name, names in tests.items() if names]
    number = sum(len(names) for names in tests.values())
    if sum(code != 0 for code in codes) != len(broken) or {*codes} - {0, STREAM_FAILED}:
        return "a stream did not end by itself, or failed without a failed test"
    if not all(TESTS_FAILED.search((logs / name).read_text(errors="replace")) for name in broken):
        return "a stream ended by something else than failed tests"
    if not all("::" in test for names in tests.values() for test in names):
        return "a module could not be read"
    if number > MOST:
        return f"{number} tests failed, and no more than {MOST} are asked once more"
    return None


def main() -> None:
    """Judge the logs of the folder named first by the streams' exit codes."""
    logs, codes = Path(sys.argv[1]), [int(word) for word in sys.argv[2:]]
    if why := refusal(logs, codes):
        sys.exit(f"not asked once more: {why}")
    sys.stdout.writelines(f"{test}\n" for names in failed(logs).values() for test in names)


if __name__ == "__main__":
    main()
