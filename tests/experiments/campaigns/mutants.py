"""Mistakes in the product's source that named tests have to notice: ``python -m tests.experiments.campaigns.mutants [--fast] [--page FILE]
[WORDS]``.

Every mutant (`tests.experiments.campaigns.source_mutants`) is patched into a copy of the tree, never into the tree itself, and its tests
run there.
First they run without it: what fails anyway proves nothing. WORDS: only mutants whose name holds them. Ends with 1 unless all were killed.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from tests.experiments.campaigns.source_mutants import MUTANTS, Mutant

ROOT = Path(__file__).resolve().parents[3]
COPIED = ("abbe", "service", "drivers", "models", "simulators", "tests", "pyproject.toml")
TEST_S, RUN_S = 400, 3600
HEAD = """# Mistakes that the tests have to notice

Each mistake is put into a copy of the source. A test of the file named here must fail with it and pass without it;
`tests/experiments/campaigns/source_mutants.py` names the test and the line. CI runs those marked *, all at once. The push protocol has
mutants of its own ([develop](../how-to/develop.md)).

    python -m tests.experiments.campaigns.mutants --page docs/explanation/mutants.md      # half an hour, two cores; writes this page

{date}: {killed} of {all} killed.

"""


@dataclass(frozen=True, slots=True)
class Found:
    """What the tests said: ``failed`` are node ids; ``word``: what came of a mutant."""

    code: int
    failed: tuple[str, ...]
    said: str

    @property
    def word(self) -> str:
        if self.code == 0:
            return "SURVIVED"
        if self.code != 1 or not self.failed:
            return "no result"
        return "timed out" if "Timeout" in self.said else "killed"


@contextmanager
def copied() -> Iterator[Path]:
    """A copy of the tree that may be spoilt."""
    with tempfile.TemporaryDirectory() as name:
        for part in COPIED:
            if (ROOT / part).is_dir():
                shutil.copytree(ROOT / part, Path(name) / part, symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
            else:
                shutil.copy(ROOT / part, Path(name) / part)
        yield Path(name)


def stale(mutant: Mutant, root: Path = ROOT) -> bool:
    """Whether the text that it changes no longer stands there exactly once."""
    path = root / mutant.path
    return not path.is_file() or path.read_text(encoding="utf-8").count(mutant.old) != 1


@contextmanager
def patched(copy: Path, mutants: Iterable[Mutant]) -> Iterator[None]:
    """The copy with these mistakes; as it was afterwards."""
    before: dict[Path, str] = {}
    for mutant in mutants:
        path = copy / mutant.path
        text = path.read_text(encoding="utf-8")
        before.setdefault(path, text)
        assert text.count(mutant.old) == 1, f"{mutant.name}: its text does not stand once in {mutant.path}"
        _write(path, text.replace(mutant.old, mutant.new))
    try:
        yield
    finally:
        for path, text in before.items():
            _write(path, text)


def _write(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8")
    for compiled in (path.parent / "__pycache__").glob(f"{path.stem}.*"):
        compiled.unlink()  # a change within the same second and of the same length would not be seen


def noticed(copy: Path, tests: Iterable[str], *more: str) -> Found:
    """Run tests in the copy, which comes before any installed source."""
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "--tb=line", "-rfE", "--timeout", str(TEST_S), *more, *tests]
    environment = os.environ | {"PYTHONPATH": str(copy), "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(command, cwd=copy, env=environment, capture_output=True, text=True, timeout=RUN_S, check=False)
    failed = tuple(line.split()[1] for line in done.stdout.splitlines() if line.startswith(("FAILED ", "ERROR ")))
    return Found(done.returncode, failed, done.stdout + done.stderr)


def outcome(copy: Path, mutant: Mutant, good: dict[tuple[str, ...], Found]) -> tuple[str, str]:
    """(word, the test that noticed it) of one mutant; ``good``: what was found without any, filled as it is needed."""
    if stale(mutant, copy):
        return "STALE", "its text does not stand there once any more"
    if mutant.tests not in good:
        good[mutant.tests] = noticed(copy, mutant.tests)
    if good[mutant.tests].code:
        return "no result", f"without it: {good[mutant.tests].said[-200:]!r}"
    with patched(copy, [mutant]):
        found = noticed(copy, mutant.tests, "-x")
    return found.word, found.failed[0] if found.failed else ""


def page(rows: list[tuple[Mutant, str, str]]) -> str:
    """The list for docs/explanation/mutants.md, by the file of the test that noticed a mistake."""
    noticed_in: dict[str, list[str]] = {}
    for mutant, word, by in rows:
        where = f"`{by.partition('::')[0]}`" if word == "killed" else f"**{word}** in `{mutant.path}`"
        noticed_in.setdefault(where, []).append(mutant.name + (" *" if mutant.fast else ""))
    killed = sum(word == "killed" for _, word, _ in rows)
    head = HEAD.format(date=datetime.now(UTC).date(), killed=killed, all=len(rows))
    return head + "".join(f"- {where}: {'; '.join(names)}\n" for where, names in sorted(noticed_in.items()))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("words", nargs="*")
    parser.add_argument("--fast", action="store_true")
    parser.add_argument("--page", type=Path)
    arguments = parser.parse_args()
    chosen = [m for m in MUTANTS if all(word in m.name for word in arguments.words) and (m.fast or not arguments.fast)]
    rows: list[tuple[Mutant, str, str]] = []
    good: dict[tuple[str, ...], Found] = {}
    with copied() as copy:
        for mutant in chosen:
            rows.append((mutant, *outcome(copy, mutant, good)))
            print(f"{rows[-1][1]:10s} {mutant.name}: {rows[-1][2]}", flush=True)  # noqa: T201
    if arguments.page:
        arguments.page.write_text(page(rows), encoding="utf-8")
    return int(any(word != "killed" for _, word, _ in rows))


if __name__ == "__main__":
    raise SystemExit(main())
