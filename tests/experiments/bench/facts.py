"""What the figures depend on: processor, cores, versions."""

from __future__ import annotations

import os
import platform
import re
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from tests.experiments.bench.contestants import cpu_count

LIBRARIES = ("numpy", "scipy", "numba", "sympy", "pytransform3d", "lmfit", "GTC", "uncertainties", "scikit-learn", "statsmodels")


def facts() -> dict:
    """For the head of the report and the JSON file."""
    return {
        "processor": _processor(),
        "cores": cpu_count(),
        "threads": _threads(),
        "load": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        **{name: _version(name) for name in LIBRARIES},
    }


def _version(name: str) -> str:
    """Version, or that the library is not in this environment: parts that compare with nobody run without the peers."""
    try:
        return version(name)
    except PackageNotFoundError:
        return "absent"


def _threads() -> int:
    try:
        import numba
    except ImportError:
        return 1
    return int(numba.get_num_threads())


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    found = re.search(r"^model name\s*:\s*(.+)$", info.read_text(), re.MULTILINE) if info.exists() else None
    return found[1] if found else platform.processor() or "unknown"
