"""Fault scenarios: kind, time and number of faults, as plain data from TOML or a test. Each player (a proxy or line) defines its kinds.

.. code-block:: toml

    name = "late answer to the third request"
    seed = 7

    [[fault]]
    kind = "delay_reply"     # a kind that the player supports
    at = 2                   # first event of its sort that it hits, counted from 0 (requests, replies, frames, connections)
    times = 1                # number of events in a row that it hits; 0: all from there on
    seconds = 0.3            # for kinds that wait
    value = 0                # for kinds that change something
    on = "any"               # only events of this sort count, e.g. "read", "write"; the player defines the sorts
"""

from __future__ import annotations

import dataclasses
import tomllib
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any


class FaultScenarioError(ValueError):
    """The scenario cannot be played; the message is one line and names the key."""


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault; the module's example explains each key. ``data``: bytes in hex, for kinds that insert bytes."""

    kind: str
    at: int = 0
    times: int = 1
    seconds: float = 0.0
    value: int = 0
    on: str = "any"
    data: str = ""

    def hits(self, number: int) -> bool:
        """Whether the fault hits the event of this number (from 0, counted among events of its sort)."""
        return number >= self.at and (self.times == 0 or number < self.at + self.times)


@dataclass(frozen=True, slots=True)
class FaultScenario:
    """Faults that are played together. ``seed``: seed of the player's random numbers."""

    name: str = ""
    seed: int = 1
    faults: tuple[Fault, ...] = ()

    def check(self, kinds: Collection[str], sorts: Collection[str] = ("any",)) -> None:
        """Check that a player supports all kinds and sorts of events.

        Raises
        ------
        FaultScenarioError
            Unknown kind or sort of event.
        """
        for number, fault in enumerate(self.faults, 1):
            if fault.kind not in kinds:
                raise FaultScenarioError(f"fault {number}: kind {fault.kind!r} is none of {', '.join(sorted(kinds))}")
            if fault.on not in sorts:
                raise FaultScenarioError(f"fault {number}: on {fault.on!r} is none of {', '.join(sorted(sorts))}")


def scenario(*faults: Fault, name: str = "", seed: int = 1) -> FaultScenario:
    """Return a scenario of these faults, for tests."""
    return FaultScenario(name, seed, faults)


def load(path: Path) -> FaultScenario:
    """Read a scenario file.

    Raises
    ------
    FaultScenarioError
        File missing, not TOML, unknown key, wrong type or impossible value.
    """
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as exc:
        raise FaultScenarioError(f"{path}: {exc}") from exc
    return from_dict(data)


def from_dict(data: dict[str, Any]) -> FaultScenario:
    """Build a scenario from parsed TOML."""
    if unknown := sorted(set(data) - {"name", "seed", "fault"}):
        raise FaultScenarioError(f"unknown key: {unknown[0]}")
    entries = data.get("fault", [])
    if not isinstance(entries, list):
        raise FaultScenarioError("fault: a list of tables [[fault]] is expected")
    name, seed = data.get("name", ""), data.get("seed", 1)
    if not isinstance(name, str) or not isinstance(seed, int):
        raise FaultScenarioError("name must be text, seed a whole number")
    return FaultScenario(name, seed, tuple(_fault(entry, number) for number, entry in enumerate(entries, 1)))


def _fault(entry: Any, number: int) -> Fault:
    if not isinstance(entry, dict) or "kind" not in entry:
        raise FaultScenarioError(f"fault {number}: expected a table [[fault]] with the key kind")
    types = {field.name: field.type for field in dataclasses.fields(Fault)}
    for key, value in entry.items():
        if key not in types:
            raise FaultScenarioError(f"fault {number}: unknown key {key}")
        if not _fits(value, str(types[key])):
            raise FaultScenarioError(f"fault {number}: {key} = {value!r} is not of type {types[key]}")
    fault = Fault(**entry)
    if fault.at < 0 or fault.times < 0 or fault.seconds < 0:
        raise FaultScenarioError(f"fault {number}: at, times and seconds must not be below 0")
    try:
        bytes.fromhex(fault.data)
    except ValueError:
        raise FaultScenarioError(f"fault {number}: data = {fault.data!r} is not hexadecimal") from None
    return fault


def _fits(value: Any, kind: str) -> bool:
    if isinstance(value, bool):
        return False
    types: dict[str, tuple[type, ...]] = {"str": (str,), "int": (int,), "float": (int, float)}
    return isinstance(value, types[kind])
