"""What only the long run proves: every test file that knows ``ABBE_TEST_LONG``, one after the other, at full size (``make test-long``).

Takes hours, so it can be stopped (Ctrl-C) and goes on where it was: what passed at this commit is not run again. Each file's
outcome is a line of ``.long.jsonl``, and the table at the end says what passed. docs/explanation/coverage.md keeps when that was last seen.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
BOOK = ROOT / ".long.jsonl"
WORD = "ABBE_TEST_LONG"
GUESS_S = 180.0
"""What a file takes that was never timed."""


def files() -> list[str]:
    """Return the test files that run longer, or at all, in the long run; helpers that know the word count for the files beside them."""
    knowing = {path for path in (ROOT / "tests").rglob("*.py") if WORD in path.read_text() and path != Path(__file__).resolve()}
    helpers = {path.stem for path in knowing if not path.name.startswith("test_")}
    using = re.compile(rf"\bimport\b.*\b({'|'.join(helpers)})\b|\b({'|'.join(helpers)}) import\b") if helpers else None
    tests = {path for path in (ROOT / "tests").rglob("test_*.py") if path in knowing or (using and using.search(path.read_text()))}
    return sorted(str(path.relative_to(ROOT)) for path in tests)


def revision() -> str:
    """Return the commit; with ``+`` where the tree holds something else."""
    words = ("git", "describe", "--always", "--dirty=+", "--abbrev=12", "--exclude=*")
    return subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()


def read_book() -> list[dict[str, Any]]:
    """Return what earlier runs have written."""
    return [json.loads(line) for line in BOOK.read_text().splitlines()] if BOOK.exists() else []


def play(name: str, commit: str) -> dict[str, Any]:
    """Run one file at full size; its row of the book."""
    start = time.monotonic()
    command = [sys.executable, "-m", "pytest", name, "-p", "no:cacheprovider", "--timeout", "3600"]
    done = subprocess.run(command, cwd=ROOT, env={**os.environ, WORD: "1"}, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.stdout.write(done.stdout[-8000:] + done.stderr[-2000:])
    counts = re.findall(r"(\d+ (?:passed|failed|skipped|errors?|xfailed|xpassed))", done.stdout.splitlines()[-1] if done.stdout else "")
    row = {"file": name, "commit": commit, "code": done.returncode, "counts": ", ".join(counts)}
    return row | {"seconds": round(time.monotonic() - start, 1), "utc": datetime.now(UTC).isoformat(timespec="seconds")}


def main() -> None:
    """Run what has not passed at this commit, or only the files named; exit code 1 if any failed."""
    commit, book = revision(), read_book()
    took = {row["file"]: row["seconds"] for row in book}
    passed = {row["file"] for row in book if row["commit"] == commit and row["code"] == 0 and not commit.endswith("+")}
    left = [one for one in sys.argv[1:] or files() if one not in passed]
    rows = [row for row in book if row["commit"] == commit and row["file"] in passed]
    for k, name in enumerate(left):
        eta_s = sum(took.get(one, GUESS_S) for one in left[k:])
        print(f"[{len(passed) + k + 1} of {len(passed) + len(left)}, about {eta_s / 60:.0f} min left] {name}", flush=True)  # noqa: T201
        rows.append(play(name, commit))
        with BOOK.open("a") as out:
            out.write(json.dumps(rows[-1]) + "\n")
    for row in rows:
        print(f"{'passed' if row['code'] == 0 else 'FAILED'}  {row['seconds']:7.0f} s  {row['file']}  ({row['counts']})")  # noqa: T201
    sys.exit(any(row["code"] for row in rows))


if __name__ == "__main__":
    try:
        main()
    except KeyboardInterrupt:
        sys.exit(f"stopped; `make test-long` goes on where it was ({BOOK.name})")
