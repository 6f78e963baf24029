"""Writes docs/reference/python.md from the docstrings: ``python -m tests.project.python_page`` (``--check``: is it current?)."""

from __future__ import annotations

import inspect
import re
import sys
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from types import ModuleType
from typing import Any

import abbe
from tests.written_page import run

PAGE = Path(__file__).resolve().parents[2] / "docs" / "reference" / "python.md"
GROUPS = {
    "Campaigns": ("read_campaign", "plan", "simulate", "Campaign", "Plan", "SimulatedInstruments"),
    "Answers": ("solve", "discover", "Solution", "DiscoveryAnswer", "Deviation", "Estimate", "NineTables", "Picture"),
    "Machines and their errors": ("Machine", "ErrorMotions", "Polynomial", "Legendre", "Table", "read_errors"),
    "Tests": ("identification", "verification", "discovery_campaign", "CampaignPlan", "Helix", "Circle", "Diagonal", "Linear"),
    "Effects": ("Effect", "Parameter", "Form", "Path", "Places", "columns"),
    "Errors": ("AbbeError",),
}
_HEAD = """# Python

`python -m tests.project.python_page` writes this page from the docstrings; a test checks that it is current. All names are those of `import
abbe`; they keep their meaning within a minor version (0.2), and everything else may change. Lengths are mm, angles rad, times s, unless a
name says otherwise. Three notebooks show them at work: [understand](../notebooks/understand.ipynb), [plan](../notebooks/plan.ipynb),
[own effect](../notebooks/own-effect.ipynb). Start Python with `OMP_NUM_THREADS=1`, or `discover` takes about four times as long on two
cores (50 s instead of 12 s): its matrices are too small for several threads.
"""


def page() -> str:
    """The whole page."""
    return _HEAD + "".join(f"\n## {title}\n" + "".join(entry(name) for name in names) for title, names in GROUPS.items())


def entry(name: str) -> str:
    """One public name: how it is called, what it does, and for a class or module what it has."""
    thing = getattr(abbe, name)
    call = f"abbe.{name}" + ("" if isinstance(thing, ModuleType) else _signature(thing))
    members = "".join(f"- `{head}`: {_summary(one)}\n" for head, one in _members(thing))
    return f"\n### {name}\n\n    {call}\n\n{_markdown(inspect.getdoc(thing) or '')}\n" + (f"\n{members}" if members else "")


def _signature(thing: Any) -> str:
    if inspect.isclass(thing) and (issubclass(thing, Exception) or "esult of `" in (inspect.getdoc(thing) or "")):
        return ""  # raised, or made by a function of this page
    parts, star = [], False
    for one in inspect.signature(thing).parameters.values():
        if one.kind is one.KEYWORD_ONLY and not star:
            parts, star = [*parts, "*"], True
        shown = "..." if callable(one.default) or "factory" in repr(one.default) else repr(one.default)
        parts.append(one.name if one.default is one.empty else f"{one.name}={shown}")
    return f"({', '.join(parts)})"


def _members(thing: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(thing, ModuleType):
        for name, one in vars(thing).items():
            if inspect.isfunction(one) and one.__module__ == thing.__name__ and not name.startswith("_"):
                yield f"{name}{_names(one)}", one
    elif inspect.isclass(thing):
        for name, one in vars(thing).items():
            if name.startswith("_") or not (inspect.isfunction(one) or isinstance(one, property | cached_property | classmethod)):
                continue
            inner = one.__func__ if isinstance(one, classmethod) else one
            yield f"{name}{_names(inner)}" if inspect.isfunction(inner) else name, inner


def _names(function: Any) -> str:
    return f"({', '.join(name for name in inspect.signature(function).parameters if name not in ('self', 'cls'))})"


def _summary(thing: Any) -> str:
    return _inline(" ".join((inspect.getdoc(thing) or "").split("\n\n")[0].split()))


def _inline(text: str) -> str:
    return text.replace("``", "`")


def _markdown(doc: str) -> str:
    """A docstring with numpy's sections as Markdown."""
    out: list[str] = []
    listed = False
    lines = doc.splitlines()
    for line, below in zip(lines, [*lines[1:], ""], strict=True):
        if re.fullmatch("-{3,}", line):
            continue
        if re.fullmatch("-{3,}", below):
            out, listed = [*out, f"**{line}**", ""], True
        elif listed and line and not line.startswith(" "):
            head, _, kind = line.partition(" : ")
            out.append(f"- `{head}`" + (f" ({_inline(kind)}):" if kind else ":"))
        else:
            out.append(_inline(f"  {line.strip()}" if line.startswith(" ") else line))
    return "\n".join(out)


if __name__ == "__main__":
    sys.exit(run(PAGE, page, "tests.project.python_page", __doc__))
