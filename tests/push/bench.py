"""A simulated controller on real sockets and processes that push into it, forked from one that has imported everything."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from abbe.drivers.tables import encode
from abbe.service.tables.nine_tables import table_image
from tests.patience import within
from tests.push.pushing_child import tables

FIRST, OTHER = 40, 60


class Zygote:
    """A process that has everything imported and forks those who push; it knows no controller and no database by itself."""

    def __init__(self, log: Path) -> None:
        self._log = log.open("w")
        command = [sys.executable, "-m", "tests.push.pushing_child"]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._log, text=True)
        assert self.line() == "ready"

    def line(self) -> str:
        assert self.process.stdout is not None
        return self.process.stdout.readline().strip()

    def close(self) -> None:
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.close()
        self.process.wait(timeout=within(20))
        self.process.stdout.close()
        self._log.close()


class Bench:
    """A process that forks those who push into one controller, with their journal in one database.

    ``number``: of this bench among those on the same controller; owner ids of different benches differ. ``zygote``: that process, where
    several benches use it one after the other; whoever made it closes it.
    """

    def __init__(self, cnc: str, folder: Path, *, database: str = "abbe", number: int = 0, zygote: Zygote | None = None) -> None:
        self._cnc, self._store = cnc, f"sqlite:///{folder / database}.sqlite3"
        self._zygote = zygote or Zygote(folder / f"children{number}.log")
        self._own = self._zygote if zygote is None else None
        self.process = self._zygote.process
        self.owner = 1000 * number

    def begin(self, what: str, **words: Any) -> None:
        """Let a child begin; `answer` waits for its end."""
        self.owner += 1
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps({"do": what, "cnc": self._cnc, "store": self._store, "owner": self.owner, **words}) + "\n")
        self.process.stdin.flush()

    def answer(self) -> dict[str, Any]:
        """What became of the child: ``status`` of the process, ``said`` (None: it was killed), ``took_s`` from fork to end."""
        return json.loads(self._zygote.line())

    def do(self, what: str, **words: Any) -> dict[str, Any]:
        self.begin(what, **words)
        return self.answer()

    def close(self) -> None:
        if self._own is not None:
            self._own.close()


def image(height: int) -> str:
    """The bytes, in hex, of the table of that height."""
    return encode(table_image(tables(height), 100, height)).hex()
