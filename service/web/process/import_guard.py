"""Modules that the web process must never load: an attacker who takes it over must find no way to a device in it."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

FORBIDDEN = (
    "abbe.drivers.registry",
    "pymodbus",
    "serial",
    "abbe.service.devices.session",
    "abbe.service.push.execute",
    "abbe.service.core",
    "abbe.simulators",
)


class ImportGuard(MetaPathFinder):
    """Refuses every import of a module in `FORBIDDEN`."""

    def find_spec(self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None) -> ModuleSpec | None:
        """Raise ImportError for a forbidden module; leave all others to the next finder."""
        if is_forbidden(fullname):
            raise ImportError(f"the web process does not import {fullname}", name=fullname)
        return None


def is_forbidden(module: str) -> bool:
    """Whether the web process must not load a module."""
    return any(module == name or module.startswith(f"{name}.") for name in FORBIDDEN)


def install() -> None:
    """Refuse forbidden imports in this process from now on."""
    sys.meta_path.insert(0, ImportGuard())
