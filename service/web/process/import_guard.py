"""What the web process must never load: an attacker who takes it over finds no way to a device in it."""

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
    "abbe.service.push.adapter",
    "abbe.service.push.execute",
    "abbe.service.core",
    "abbe.simulators",
)


class Wall(MetaPathFinder):
    """Refuses to import `FORBIDDEN`, early or late, by whomever."""

    def find_spec(self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None) -> ModuleSpec | None:
        """Refuse, or say nothing.

        Raises
        ------
        ImportError
            It is one of those.
        """
        if behind(fullname):
            raise ImportError(f"the web process does not import {fullname}", name=fullname)
        return None


def behind(module: str) -> bool:
    """Tell whether a module is one that the web process must not load."""
    return any(module == name or module.startswith(f"{name}.") for name in FORBIDDEN)


def build() -> None:
    """From now on nothing behind the wall can be imported by this process."""
    sys.meta_path.insert(0, Wall())
