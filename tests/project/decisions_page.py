"""Writes docs/decisions/README.md from the titles: ``python -m tests.project.decisions_page`` (``--check``: is it current?)."""

from __future__ import annotations

import sys
from pathlib import Path

from tests.written_page import run

PAGE = Path(__file__).resolve().parents[2] / "docs" / "decisions" / "README.md"
_HEAD = """# Decisions

One page each: the situation, what was decided, what follows. A decision that turns out wrong is not rewritten: a new one replaces it, and
both stay. The words may become fewer. Numbers 0026 to 0029 were never used. `python -m tests.project.decisions_page` writes this list.

| number | decision |
|---|---|
"""
_REPLACED = "\nReplaced by ["


def page() -> str:
    """The whole page."""
    return _HEAD + "".join(_row(path) for path in sorted(PAGE.parent.glob("[0-9]*.md")))


def _row(path: Path) -> str:
    text = path.read_text(encoding="utf-8")
    title = text.partition("\n")[0].removeprefix("# ").removeprefix(path.name[:4]).lstrip(": ")
    later = f" (replaced by {text.partition(_REPLACED)[2][:4]})" if _REPLACED in text else ""
    return f"| [{path.name[:4]}]({path.name}) | {title}{later} |\n"


if __name__ == "__main__":
    sys.exit(run(PAGE, page, "tests.project.decisions_page", __doc__))
