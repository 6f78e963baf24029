"""Which rows and cases the fault matrix has: the tests take their cases from here, the page docs/reference/faults.md is written from here.

Every file ``tests/faults/rows_*.py`` holds ``ROWS``, a tuple of ``Row``.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

HERE = Path(__file__).parent


@dataclass(frozen=True, slots=True)
class Row:
    """One row of the matrix.

    Parameters
    ----------
    name : str
        ``M2``.
    fault : str
        What goes wrong, in a few words.
    required : str
        What has to happen beyond the five obligations.
    cases : tuple of str
        Every case by its name.
    test : str
        The file that plays them, from ``tests/faults``.
    left_out : tuple of (str, str)
        What of the specification's row is not here, and why.
    """

    name: str
    fault: str
    required: str
    cases: tuple[str, ...]
    test: str
    left_out: tuple[tuple[str, str], ...] = ()

    def __post_init__(self) -> None:
        if len(set(self.cases)) != len(self.cases):
            raise ValueError(f"row {self.name} names a case twice")


def rows() -> list[Row]:
    """All rows, in the order of the files and of the rows in them."""
    found: list[Row] = []
    for path in sorted(HERE.glob("rows_*.py")):
        spec = importlib.util.spec_from_file_location(f"tests.faults.{path.stem}", path)
        if spec is None or spec.loader is None:
            raise ImportError(f"cannot read {path}")
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        found += module.ROWS
    return found


def crossed(*parts: Iterable[str]) -> tuple[str, ...]:
    """Names of all combinations, ``"a b c"``."""
    names = [""]
    for part in parts:
        words = list(part)
        names = [f"{name} {word}".strip() for name in names for word in words]
    return tuple(names)
