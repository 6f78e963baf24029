"""What a person sees of a complete run: one line, each failure at once, and what is slow first."""

from __future__ import annotations

import io
import subprocess
import sys
from pathlib import Path

import pytest

from tests.progress import REPEATED_S, Progress, in_turn, read_seconds

ROOT = Path(__file__).resolve().parents[2]


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def counting(out: io.StringIO) -> Progress:
    progress = Progress(out, {"slow.py": 80.0, "quick.py": 20.0}, clock=0.0)
    progress.expect(["slow.py::a", "quick.py::a", "quick.py::b"])
    return progress


def test_slow_files_come_first_and_those_that_talk_to_devices_are_spread_over_the_run() -> None:
    seconds = {
        "tests/system/a.py": 30.0,
        "tests/push/b.py": 10.0,
        "tests/system/c.py": 20.0,
        "tests/unit/x.py": 40.0,
        "tests/unit/y.py": 20.0,
    }
    wanted = ["tests/system/a.py", "tests/unit/x.py", "tests/system/c.py", "tests/unit/y.py", "tests/push/b.py"]
    assert in_turn(sorted(seconds), seconds) == wanted


def test_what_is_left_is_told_from_what_the_files_took_before() -> None:
    progress = counting(io.StringIO())
    progress.end("quick.py::a", failed=False)
    assert progress.line(40.0) == "1 of 3 tests, 40 s, about 6 min left"  # a tenth is done
    progress.end("slow.py::a", failed=False)
    assert progress.line(180.0) == "2 of 3 tests, 3 min, about 20 s left"


def test_a_failed_test_is_named_once_and_at_once() -> None:
    out = io.StringIO()
    progress = counting(out)
    progress.end("slow.py::a", failed=True)
    progress.show(1.0)
    assert out.getvalue() == "FAILED slow.py::a\n"
    assert "1 FAILED" in progress.line(10.0)


def test_elsewhere_than_on_a_terminal_a_line_a_minute() -> None:
    out = io.StringIO()
    progress = counting(out)
    for second in range(1, int(2.5 * REPEATED_S)):
        progress.show(float(second))
    assert len(out.getvalue().splitlines()) == 2


def test_on_a_terminal_the_line_is_written_over_and_taken_away() -> None:
    out = Terminal()
    progress = counting(out)
    progress.show(1.0)
    progress.show(2.0)
    progress.clear()
    assert "\n" not in out.getvalue()
    assert out.getvalue().endswith("\r\x1b[K")


def test_every_slow_file_is_there() -> None:
    assert [name for name in read_seconds() if not (ROOT / name).is_file()] == []


@pytest.mark.parametrize("workers", [(), ("-n", "2", "--dist", "loadfile", "--no-loadscope-reorder")], ids=["one process", "side by side"])
def test_nothing_else_is_printed(tmp_path: Path, workers: tuple[str, ...]) -> None:
    (tmp_path / "test_it.py").write_text("def test_good(): pass\n\ndef test_bad(): assert False\n")
    command = [sys.executable, "-m", "pytest", "-c", str(ROOT / "pyproject.toml"), "-p", "tests.progress"]
    command += ["-p", "no:cacheprovider", "-p", "no:schemathesis"]  # takes a second to import
    done = subprocess.run([*command, *workers, str(tmp_path)], cwd=ROOT, capture_output=True, text=True, check=False)
    lines = [line for line in done.stdout.splitlines() if line]
    assert lines[0].startswith("FAILED "), done.stdout
    assert lines[0].endswith("test_it.py::test_bad")
    assert lines[-1].startswith("1 failed, 1 passed in"), done.stdout
    assert not any(set(line) <= set(".FEsx") for line in lines), done.stdout
