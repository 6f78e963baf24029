"""Programs of ours in a Python of their own: how each is started, so that nothing in the working directory is imported in place of ours.

A plain ``python -m`` or ``python -c`` looks for modules in the working directory first: a folder ``abbe`` that lies there would run.
Children are therefore started by this file's absolute path, with ``-P``: ``python -P .../service/children.py MODULE WORD ...``.
"""

from __future__ import annotations

import os
import runpy
import sys
from collections.abc import Iterator
from contextlib import contextmanager

SAFE = "PYTHONSAFEPATH"
ROOT = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
"""Where the package ``abbe`` lies."""


def python_words(module: str, *words: object) -> list[str]:
    """Return the command line that runs a module of ours.

    Parameters
    ----------
    module : str
        As after ``python -m``.
    *words : object
        Its arguments.
    """
    return [sys.executable, "-P", os.path.abspath(__file__), module, *map(str, words)]


@contextmanager
def started_safely() -> Iterator[None]:
    """Whatever Python is started inside, by ``multiprocessing`` for example, looks for no module in the working directory either."""
    before = os.environ.get(SAFE)
    os.environ[SAFE] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ[SAFE]
        else:
            os.environ[SAFE] = before


def _run() -> None:
    module, sys.argv[1:] = sys.argv[1], sys.argv[2:]
    if ROOT not in sys.path:
        sys.path.append(ROOT)  # last: of use where Abbe runs from a folder and is not installed
    runpy.run_module(module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    _run()
