"""A campaign's files written by someone else: axes by other names, another order, another zero of the clock."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

Doc = dict[str, Any]
NEXT = {"X": "Y", "Y": "Z", "Z": "X", "x": "y", "y": "z", "z": "x", "A": "B", "B": "C", "C": "A"}
"""X becomes Y, Y becomes Z, Z becomes X: a rotation of the frame by a third of a turn about its space diagonal."""
POINTS = ("centre_mm", "start_mm", "end_mm", "nominal_beam", "increment_mm", "tool_mm")


def renamed(text: str) -> str:
    """A chain, plane, key or column by its new name: every letter of an axis and of a rotation."""
    return "".join(NEXT.get(c, c) for c in text)


def turned(vector: Sequence[float]) -> list[float]:
    """Components of a vector in the order of the new axes."""
    return [vector[2], vector[0], vector[1]]


def turned_machine(machine: Mapping[str, Any]) -> Doc:
    """The machine object with its axes renamed."""
    out = dict(machine) | {"chain": renamed(machine["chain"]), "vertical_axis": renamed(machine.get("vertical_axis", "Z"))}
    out["stroke_mm"] = {renamed(a): v for a, v in machine["stroke_mm"].items()}
    if "pivots_mm" in machine:
        out["pivots_mm"] = {renamed(a): turned(v) for a, v in machine["pivots_mm"].items()}
    return out


def turned_run(run: Mapping[str, Any]) -> Doc:
    """The run object with its axes renamed; ids stay."""
    setup, columns = dict(run["setup"]), run["columns"]
    setup |= {k: turned(setup[k]) for k in POINTS if isinstance(setup.get(k), list)}
    if setup.get("diagonal"):
        setup["diagonal"] = "".join(turned(setup["diagonal"]))
    setup |= {k: renamed(setup[k]) for k in ("axis", "order", "plane") if setup.get(k)}
    names = {k: renamed(k[:-3]) + "_mm" for k in ("x_mm", "y_mm", "z_mm")} | {f"temp_{a}_C": f"temp_{NEXT[a]}_C" for a in "xyz"}
    moved = {names.get(k, k): v for k, v in columns.items()}
    return dict(run) | {"machine": turned_machine(run["machine"]), "setup": setup, "columns": moved}


def later(run: Mapping[str, Any], by_s: float) -> Doc:
    """The run with all times moved: of its readings and of its set-up."""
    columns, setup = run["columns"], run["setup"]
    moved = columns | {"t_s": [t + by_s for t in columns["t_s"]]}
    return dict(run) | {"columns": moved, "setup": setup | {"t_set_s": setup["t_set_s"] + by_s}}
