"""Check of every vector file of a folder."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from abbe.service.errors import FileFormatError
from abbe.service.runs.json_text import strict_json
from abbe.service.vectors import (
    kwon_kinematics,
    kwon_rsm,
    pahk_abbe,
    pahk_diagonals,
    pahk_random,
    pahk_volumetric,
    paper_tables,
    probe,
    wang_step_diagonal,
    yang_ballbar_complete,
    yang_conditioning,
    yang_helix,
    yang_ranks,
    yang_volumetric,
)
from abbe.service.vectors.case import LAYOUT, VectorCase
from abbe.service.vectors.checks import Checks

Reader = Callable[[VectorCase, Checks], None]

READERS: dict[str, Reader] = {
    "pahk_abbe.json": pahk_abbe.read,
    "pahk_volumetric.json": pahk_volumetric.read,
    "pahk_random.json": pahk_random.read,
    "pahk_diagonals.json": pahk_diagonals.read,
    "probe.json": probe.read,
    "kwon_kinematics.json": kwon_kinematics.read,
    "kwon_rsm.json": kwon_rsm.read,
    "yang_volumetric.json": yang_volumetric.read,
    "yang_helix.json": yang_helix.read,
    "yang_conditioning.json": yang_conditioning.read,
    "yang_ranks.json": yang_ranks.read,
    "yang_ballbar_complete.json": yang_ballbar_complete.read,
    "wang_step_diagonal.json": wang_step_diagonal.read,
    "paper_tables.json": paper_tables.read,
}
"""Reader by file name."""


def check_file(path: Path) -> Checks:
    """Check one vector file.

    Raises
    ------
    FileFormatError
        The file cannot be read, is no JSON, has no reader, or lacks a part of its layout.
    """
    checks = Checks(path.name)
    _read(path, checks)
    return checks


def examine(path: Path) -> Checks:
    """Check one vector file like `check_file`, but record an unusable file in ``error``, so that the other files still run."""
    checks = Checks(path.name)
    try:
        _read(path, checks)
    except FileFormatError as error:
        checks.error = str(error)
    return checks


def _read(path: Path, checks: Checks) -> None:
    if path.name not in READERS:
        raise FileFormatError(f"{path}: there is no reader for this name", f"known names: {', '.join(READERS)}")
    case = VectorCase(_document(path), (path.name,))
    try:
        # A failed computation becomes a deviation in the result, not a warning of numpy on stderr.
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            READERS[path.name](case, checks)
    except (LookupError, TypeError, RecursionError) as error:
        # The layout differs: a number in place of a list, or an unknown key.
        what = f"{type(error).__name__} {error}".strip()
        raise FileFormatError(f"{path}: another layout than expected at {case.last} ({what})", LAYOUT) from None
    except (ValueError, ArithmeticError) as error:  # numpy's LinAlgError is a ValueError
        checks.refused = f"{case.last}: {error}"
    checks.unread = case.unread()


def _document(path: Path) -> dict[str, Any]:
    try:
        doc = strict_json(path.read_text(encoding="utf-8"), path, finite=False)
    except OSError as error:
        raise FileFormatError(f"{path}: {error.strerror}", "give a readable file") from None
    except UnicodeDecodeError as error:
        raise FileFormatError(f"{path}: byte {error.start} is not UTF-8", "restore the file") from None
    if not isinstance(doc, dict):
        raise FileFormatError(f"{path}: expected an object at the top", "restore the file")
    return doc


def vector_files(folder: Path) -> list[Path]:
    """Vector files of a folder, sorted by name.

    Raises
    ------
    FileFormatError
        The folder does not exist or holds no ``.json`` file.
    """
    if not folder.is_dir():
        raise FileFormatError(f"{folder}: there is no such folder", "give the folder of the vector files")
    files = sorted(folder.glob("*.json"))
    if not files:
        raise FileFormatError(f"{folder}: there is no vector file (*.json) in it", "give the folder of the vector files")
    return files
