"""Start Abbe's own modules in child processes, so that no module in the working directory shadows them.

A plain ``python -m`` or ``python -c`` looks for modules in the working directory first: a folder ``abbe`` there would run instead.
Children therefore start with this file's absolute path and ``-P``: ``python -P .../service/children.py MODULE ARGUMENT ...``.
"""

from __future__ import annotations

import gc
import os
import runpy
import sys
from collections.abc import Iterator
from contextlib import contextmanager

SAFE = "PYTHONSAFEPATH"
ROOT = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
"""Parent directory of the package ``abbe``."""


def python_command(module: str, *arguments: object) -> list[str]:
    """Return the command line that runs a module of Abbe; ``module`` as after ``python -m``."""
    return [sys.executable, "-P", os.path.abspath(__file__), module, *map(str, arguments)]


@contextmanager
def started_safely() -> Iterator[None]:
    """Set ``PYTHONSAFEPATH`` for every Python process started in this block, for example by ``multiprocessing``."""
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
    gc.set_threshold(50_000)  # as in `abbe.service.cli.main`
    module, sys.argv[1:] = sys.argv[1], sys.argv[2:]
    if ROOT not in sys.path:
        sys.path.append(ROOT)  # last: needed only where Abbe runs from a folder and is not installed
    runpy.run_module(module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    _run()
