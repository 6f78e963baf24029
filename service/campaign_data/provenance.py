"""Provenance of a solution: digests of the runs' data, and versions of the program."""

from __future__ import annotations

import hashlib
import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from importlib.metadata import PackageNotFoundError, distribution, version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from abbe.models.arrays import F1
from abbe.models.machine import Machine
from abbe.service.domain.run import Run

SETUP_OF_DATA = ("deviation_mm", "x_mm", "y_mm", "z_mm", "t_s", "valid")
POINTS_OF_DATA = ("feature", "deviation_x_mm", "deviation_y_mm", "deviation_z_mm", "u_mm", "temperature_C", "touch_start_deg")


def run_digest(run: Run) -> str:
    """Return the SHA-256 of test, set-up and the columns that a solution uses; label and campaign are left out."""
    out = hashlib.sha256(json.dumps([run.test, run.setup.document], sort_keys=True).encode())
    columns = run.columns.by_name()
    for name in SETUP_OF_DATA + (POINTS_OF_DATA if run.columns.of_artefact else ()):
        values = columns.get(name)
        out.update(name.encode())
        out.update(b"-" if values is None else _bytes(values))
    return out.hexdigest()


def with_changed_readings(run: Run, deviation_mm: F1, removed: str) -> Run:
    """Return the run with new readings, the digest of its measured data, and descriptions of the subtracted effects."""
    changed = run.with_readings(deviation_mm)
    return replace(changed, measured_digest=measured_digest(run), subtracted=(*run.subtracted, removed))


def measured_digest(run: Run) -> str:
    """Return the `run_digest` of the measured data, before any subtraction."""
    return run.measured_digest or run_digest(run)


def removals_of(runs: list[Run]) -> list[str]:
    """Describe everything that was subtracted from the readings, without duplicates."""
    return sorted({text for run in runs for text in run.subtracted})


def whole_run_digest(run: Run) -> str:
    """Return the SHA-256 of everything that a search can use of a run: label, test, role, machine, set-up and all columns.

    Changed readings enter by the digest of the measured readings and by descriptions of the subtracted effects: the subtracted values
    may differ in the last digit between computers.
    """
    out = hashlib.sha256(json.dumps([run.run_id, run.test, run.role, run.machine, run.setup.document], sort_keys=True).encode())
    if run.measured_digest:
        out.update(json.dumps([run.measured_digest, list(run.subtracted)]).encode())
    for name, values in sorted(run.columns.by_name().items()):
        if not (name == "deviation_mm" and run.measured_digest):
            out.update(name.encode() + _bytes(values))
    return out.hexdigest()


def _bytes(values: NDArray[Any]) -> bytes:
    """Return the bytes of a column: numbers as float64, names as text."""
    return "\n".join(values.tolist()).encode() if values.dtype.kind == "U" else np.asarray(values, dtype="<f8").tobytes()


def code_digest(function: Callable[..., Any]) -> str:
    """Return the SHA-256 of a function's file, so that an edited plug-in is another plug-in; without a file, of its module name."""
    inner = getattr(function, "func", function)  # functools.partial
    name = str(getattr(inner, "__module__", type(inner).__module__))
    file = getattr(sys.modules.get(name), "__file__", None)
    return hashlib.sha256(name.encode() if file is None else Path(file).read_bytes()).hexdigest()


def machine_digest(machine: Machine) -> str:
    """Return the SHA-256 of the geometry: chain, strokes, pivots, tool. The machine's name is left out."""
    out = hashlib.sha256(machine.chain.encode())
    for values in (machine.stroke_mm, machine.pivots_mm, machine.tool_mm):
        out.update((np.asarray(values, dtype="<f8") + 0.0).tobytes())  # + 0.0: minus zero is zero
    return out.hexdigest()


def campaign_digest(digests: dict[str, str], model: str, machine: str) -> str:
    """Return the SHA-256 of all runs in any order, the model and the machine's digest; equal for repeated solutions of a campaign."""
    return hashlib.sha256("\n".join([model, machine, *sorted(digests.values())]).encode()).hexdigest()


def versions() -> dict[str, str]:
    """Return the versions of Abbe, NumPy and SciPy, and Abbe's revision if known."""
    out = {name: _version(name) for name in ("abbe", "numpy", "scipy")}
    found = revision()
    return out if found is None else out | {"revision": found}


@cache
def _version(package: str) -> str:
    return version(package)


@cache
def revision() -> str | None:
    """Return the commit of the sources if they were installed from a repository or are in a work tree, else None. Cached per process.

    The suffix ``+changes`` marks a work tree whose program differs from its commit.
    """
    try:
        text = distribution("abbe").read_text("direct_url.json")
    except PackageNotFoundError:
        text = None
    commit = json.loads(text).get("vcs_info", {}).get("commit_id") if text else None
    if commit:
        return str(commit)
    tree = Path(__file__).resolve().parents[2]
    found = _of_tree(tree / ".git")
    return found + "+changes" if found and _changed(tree) else found


def _changed(tree: Path) -> bool:
    """Whether files of the program differ from the commit; False without git."""
    git = shutil.which("git")
    if git is None:
        return False
    command = [git, "--no-optional-locks", "-C", str(tree), "status", "--porcelain", "--", "abbe", "models", "service"]
    try:
        found = subprocess.run(command, capture_output=True, timeout=20, check=False)  # noqa: S603 - fixed command, no shell
    except (OSError, subprocess.TimeoutExpired):
        return False
    return found.returncode == 0 and bool(found.stdout.strip())


def _of_tree(git: Path) -> str | None:
    try:
        head = (git / "HEAD").read_text(encoding="ascii").strip()
        if not head.startswith("ref: "):
            return head
        name = head.removeprefix("ref: ")
        if (git / name).exists():
            return (git / name).read_text(encoding="ascii").strip()
        packed = (git / "packed-refs").read_text(encoding="ascii").splitlines()
        return next((line.split()[0] for line in packed if line.endswith(f" {name}")), None)
    except (OSError, UnicodeDecodeError, IndexError):
        return None
