"""Check of the vector files of a folder: compare every stored number with the one computed from the file's own inputs."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from abbe.service.errors import FileFormatError
from abbe.service.reference.vector_checks import Checks
from abbe.service.reference.vector_file import LAYOUT, VectorCase
from abbe.service.reference.vectors import kwon, pahk, paper_tables, probe, wang, yang
from abbe.service.runs.checks import strict_json

FORMAT = "abbe-vectors/1"
READERS: dict[str, Callable[[VectorCase, Checks], None]] = {
    "pahk_abbe.json": pahk.read_abbe,
    "pahk_volumetric.json": pahk.read_volumetric,
    "pahk_random.json": pahk.read_random,
    "pahk_diagonals.json": pahk.read_diagonals,
    "probe.json": probe.read,
    "kwon_kinematics.json": kwon.read_kinematics,
    "kwon_rsm.json": kwon.read_rsm,
    "yang_volumetric.json": yang.read_volumetric,
    "yang_helix.json": yang.read_helix,
    "yang_conditioning.json": yang.read_conditioning,
    "yang_ranks.json": yang.read_ranks,
    "yang_ballbar_complete.json": yang.read_ballbar,
    "wang_step_diagonal.json": wang.read,
    "paper_tables.json": paper_tables.read,
}
"""Reader by file name."""


def vector_files(folder: Path) -> list[Path]:
    """Return the vector files of a folder, sorted by name.

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


def check_file(path: Path) -> Checks:
    """Check one vector file; if it is unusable (no reader, unreadable, unknown layout), say why in ``error`` of the result."""
    checks = Checks(path.name)
    try:
        _read(path, checks)
    except FileFormatError as error:
        checks.error = str(error)
    return checks


def document(checked: list[Checks]) -> dict[str, Any]:
    """Return the JSON document for ``--json``."""
    missing = missing_files(checked)
    complete = not missing and not any(c.error for c in checked)
    files = [c.to_document() for c in checked]
    return {"format": FORMAT, "ok": all(c.ok for c in checked), "complete": complete, "files": files, "missing": missing}


def missing_files(checked: list[Checks]) -> list[str]:
    """Return the names of known vector files that were not checked."""
    return sorted(set(READERS) - {c.file for c in checked})


def _read(path: Path, checks: Checks) -> None:
    if path.name not in READERS:
        raise FileFormatError(f"{path}: there is no reader for this name", f"known names: {', '.join(READERS)}")
    case = VectorCase(_document(path), (path.name,))
    try:
        # A failed computation appears as a deviation in the result, not as a numpy warning on stderr.
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            READERS[path.name](case, checks)
    except (LookupError, TypeError, RecursionError) as error:
        # The layout differs: a number in place of a list, or an unknown key.
        what = f"{type(error).__name__} {error}".strip()
        raise FileFormatError(f"{path}: the layout differs from the expected one at {case.last} ({what})", LAYOUT) from None
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
