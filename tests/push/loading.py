"""The push protocol as modules: the real ones, or a private copy with edited source (mutants and variants), never written to disk."""

from __future__ import annotations

import itertools
import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType, SimpleNamespace

ROOT = Path(__file__).resolve().parents[2]
NAMES = ("journal", "operations", "validate", "back", "machine", "execute")
"""In the order of their imports."""
OUTSIDE = {"second_decoder": "drivers/second_decoder.py", "one_bank": "drivers/one_bank.py", "codec": "service/tables/nine_tables.py"}
_counter = itertools.count()

Edits = tuple[tuple[str, str, str], ...]
"""(module, text that occurs exactly once, what stands there instead)."""


def real() -> SimpleNamespace:
    """The modules as they are."""
    found = {name: import_module(f"abbe.service.push.{name}") for name in NAMES}
    return SimpleNamespace(**found, codec=import_module("abbe.service.tables.nine_tables"), one_bank=import_module("abbe.drivers.one_bank"))


def edited(edits: Edits) -> SimpleNamespace:
    """A copy of the protocol with these edits; the real modules are not touched."""
    package = f"push_copy_{next(_counter)}"
    sys.modules[package] = ModuleType(package)
    sources = {name: (ROOT / f"service/push/{name}.py").read_text(encoding="utf-8") for name in NAMES}
    sources |= {name: (ROOT / path).read_text(encoding="utf-8") for name, path in OUTSIDE.items()}
    for module, old, new in edits:
        assert sources[module].count(old) == 1, f"{module}: {sources[module].count(old)} times: {old!r}"
        sources[module] = sources[module].replace(old, new)
    made = {}
    for name in ("second_decoder", *NAMES, "codec", "one_bank"):
        text = (
            sources[name].replace("abbe.service.push.", f"{package}.").replace("abbe.drivers.second_decoder", f"{package}.second_decoder")
        )
        module = ModuleType(f"{package}.{name}")
        sys.modules[f"{package}.{name}"] = module
        exec(compile(text, f"{package}/{name}.py", "exec"), module.__dict__)
        made[name] = module
    return SimpleNamespace(**made)
