"""Processor time until a command begins its own work: every command on an input that it refuses, and those that only read on their answer.

Processor time, since a command waits for the computer at its start like everything else; the best of several calls, since what other
programs do to the caches is not the command's. `tests/project/test_project.py` holds what no start may import.
"""

from __future__ import annotations

import importlib.util
import json
import os
import resource
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

from tests.service.cli.every_command import CASES, filled_folder

CALLS = 5
GOAL_S = 0.4
COMPUTES = frozenset(
    ("plan", "measure", "solve", "solve-all", "discover", "simulate", "errors", "report", "comp export", "comp step", "papers")
)
"""Commands whose answer is computed: they are measured on the refused input only."""
SLOW = frozenset(("user add", "user password", "user token new"))
"""A password's hash is slow on purpose."""
PREPARES = ("user add", "user token new", "comp export")
"""Commands that leave what the answers of others begin with; they are called first, and not measured then."""


class Folders:
    """What `filled_folder` asks of pytest's factory."""

    def __init__(self, base: Path) -> None:
        self.base = base

    def getbasetemp(self) -> Path:
        """The folder for all."""
        return self.base

    def mktemp(self, name: str) -> Path:
        """A new folder."""
        return Path(tempfile.mkdtemp(prefix=name, dir=self.base))


def compared(progress: Callable[[str], None]) -> dict:
    """Seconds of processor time by command: ``refused`` and ``answer``. ``right``: exit codes are those promised.

    Nothing without the developers' environment, whose libraries fill the folder.
    """
    if importlib.util.find_spec("httpx") is None:
        return {}
    with tempfile.TemporaryDirectory() as name:
        progress("start: filling a folder")
        folder = filled_folder(Folders(Path(name)))
        for command in PREPARES:
            _best(CASES[command].words, folder, CASES[command].typed)
        answers = {"--help": _best("--help", folder)}
        rows = {"--help": {"answer": answers["--help"][0], "right": answers["--help"][1] == 0}}
        for command, case in CASES.items():
            progress(f"start: {command}")
            refused_s, code = _best(case.wrong, folder, case.typed)
            rows[command] = {"refused": refused_s, "right": code == 2}
            if not case.proof and command not in COMPUTES | SLOW:
                answer_s, code = _best(case.words, folder, case.typed)
                rows[command] |= {"answer": answer_s, "right": rows[command]["right"] and code in case.codes}
    progress("")
    return rows


def _best(words: str, folder: Path, typed: str = "") -> tuple[float, int]:
    """Least processor time of several calls, and the exit code of the first; ``#`` is the number of the call."""
    names = json.loads((folder / "words.json").read_text())
    for name, value in names.items():
        words = words.replace(name, str(value))
    own = {key: value for key, value in os.environ.items() if not key.startswith("ABBE_")} | {"OPENBLAS_NUM_THREADS": "1"}
    own.pop("PYTHONDONTWRITEBYTECODE", None)
    times, codes = [], []
    for number in range(1, CALLS + 1):
        began = _spent_s()
        command = [sys.executable, "-m", "abbe.service.cli", *shlex.split(words.replace("#", str(number)))]
        done = subprocess.run(command, cwd=folder, env=own, input=typed, capture_output=True, text=True, check=False)
        times.append(_spent_s() - began)
        codes.append(done.returncode)
    return min(times), codes[0]


def _spent_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def lines(found: dict) -> list[str]:
    """The printed table, the slowest first."""
    out = ["", f"{'Start of every command, s of processor time':<44}{'refused':>9}{'answer':>9}   goal {GOAL_S}"]
    for command, one in sorted(found.items(), key=lambda item: -_longest(item[1])):
        met = "" if _longest(one) <= GOAL_S else "   NOT MET"
        out.append(f"  {command:<42}{_cell(one, 'refused')}{_cell(one, 'answer')}{met}{'' if one['right'] else '   DIFFERS'}")
    late = sum(_longest(one) > GOAL_S for one in found.values())
    return [*out, f"  {len(found)} commands, {late} above {GOAL_S} s; best of {CALLS} calls each; no figure: the answer is computed."]


def _longest(one: dict) -> float:
    return max(one.get("refused", 0.0), one.get("answer", 0.0))


def _cell(one: dict, key: str) -> str:
    return f"{one[key]:9.2f}" if key in one else f"{'-':>9}"
