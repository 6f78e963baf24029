"""All named effects: built-in ones and those that other packages offer (docs/how-to/own-effect.md)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from difflib import get_close_matches
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any

import numpy as np

from abbe.models.effects.catalogue import CATALOGUE
from abbe.models.effects.effect import Effect
from abbe.models.effects.self_test import declaration_faults, probe_paths, signal_faults
from abbe.service.effects.axis_test import SLOW_DRIFT
from abbe.service.errors import EffectPluginBroken, EffectUnknown

GROUP = "abbe.effects"


@dataclass(frozen=True)
class Plugins:
    """Plug-in effects that passed the self-test, and one error per rejected plug-in."""

    effects: tuple[Effect, ...]
    broken: tuple[EffectPluginBroken, ...]


def catalogue() -> tuple[Effect, ...]:
    """Return all named effects: the built-in ones, then the plug-ins that passed the self-test."""
    return CATALOGUE + plugins().effects


@cache
def plugins() -> Plugins:
    """Return the plug-in effects, looked up once per process, and the rejected plug-ins."""
    return installed(e.name for e in CATALOGUE)


def effect_named(name: str) -> Effect:
    """Return one effect of the catalogue.

    Raises
    ------
    EffectUnknown
        The catalogue has no such effect; the error suggests similar names.
    """
    found = {e.name: e for e in (*catalogue(), SLOW_DRIFT)}
    if name not in found:
        close = get_close_matches(name, found, n=3, cutoff=0.4)
        raise EffectUnknown(
            f"the catalogue has no effect {name!r}", f"did you mean {', '.join(close)}?" if close else "`abbe effects` lists all"
        )
    return found[name]


def installed(known: Iterable[str]) -> Plugins:
    """Return the effects that installed packages offer; ``known``: names that the catalogue already uses.

    Never raises. A plug-in is left out, and an error names it, if it cannot be imported, is no `Effect`, reuses a name or fails the
    self-test (`abbe.models.effects.self_test`).
    """
    taken, effects, broken = set(known), [], []
    for entry in sorted(entry_points(group=GROUP), key=lambda e: (e.name, e.value)):
        try:
            found = _load(entry)
            _check(entry, found, taken)
        except EffectPluginBroken as fault:
            broken.append(fault)
            continue
        effects += found
        taken |= {e.name for e in found}
    return Plugins(tuple(effects), tuple(broken))


def _load(entry: EntryPoint) -> list[Effect]:
    try:
        thing: Any = entry.load()
    except Exception as fault:  # an error in a foreign module must not end the program
        raise _left_out(entry, f"{type(fault).__name__}: {fault}") from fault
    found = list(thing) if isinstance(thing, tuple | list) else [thing]
    for effect in found:
        if not isinstance(effect, Effect):
            raise _left_out(entry, f"expected an Effect or a tuple of Effects, got {type(effect).__name__}")
    if not found:
        raise _left_out(entry, "it offers no effect")
    return found


def checked(effects: tuple[Effect, ...], taken: Iterable[str]) -> tuple[Effect, ...]:
    """Return the effects that a caller supplies, after the same self-test as plug-ins.

    Raises
    ------
    EffectPluginBroken
        An effect breaks a rule, or reuses a name.
    """
    fault = _fault(list(effects), set(taken))
    if fault:
        raise EffectPluginBroken(f"effect left out: {fault}", "docs/how-to/own-effect.md lists what an effect must define")
    return effects


def _check(entry: EntryPoint, found: list[Effect], taken: set[str]) -> None:
    fault = _fault(found, taken)
    if fault:
        raise _left_out(entry, fault)


def _fault(found: list[Effect], taken: set[str]) -> str:
    """Return the first rule that an effect breaks; empty if none."""
    names = [e.name for e in found]
    for effect in found:
        if effect.name in taken or names.count(effect.name) > 1:
            return f"the name {effect.name!r} is taken"
        if effect.kind != "mean":  # each effect of scatter has a test of its own in the search
            return f"{effect.name}: kind {effect.kind!r}: expected 'mean', as nothing searches for the scatter of an effect from outside"
        try:
            with np.errstate(all="ignore"):
                faults = declaration_faults(effect) or signal_faults(effect, probe_paths())
        except Exception as error:  # noqa: BLE001 - foreign code runs here
            return f"{effect.name}: {type(error).__name__}: {error}"
        if faults:
            return f"{effect.name}: {faults[0]}" + (f" (and {len(faults) - 1} more)" if len(faults) > 1 else "")
    return ""


def _left_out(entry: EntryPoint, why: str) -> EffectPluginBroken:
    package = entry.dist.name if entry.dist is not None else entry.module
    return EffectPluginBroken(
        f"plug-in {entry.name} of {package} ({entry.value}) is left out: {why}",
        "repair or uninstall the package; docs/how-to/own-effect.md lists the rules",
    )
