"""Pages of docs/ that a program writes from the code: one way to write them, and to say whether they are current."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path


def run(page: Path, text_of: Callable[[], str], module: str, doc: str | None) -> int:
    """Write or check a page; the exit code.

    Parameters
    ----------
    page : Path
        The file.
    text_of : callable
        Makes its text.
    module : str
        What to run to have it written, as ``python -m`` takes it.
    doc : str
        For --help.
    """
    parser = argparse.ArgumentParser(description=doc)
    parser.add_argument("--check", action="store_true", help="write nothing; exit with 1 when the page is out of date")
    options = parser.parse_args()
    text = text_of()
    current = page.exists() and page.read_text(encoding="utf-8") == text
    if options.check:
        sys.stdout.write(f"{page.name} is {'current' if current else f'out of date: run python -m {module}'}\n")
        return 0 if current else 1
    page.write_text(text, encoding="utf-8")
    sys.stdout.write(f"{page.name}: {'unchanged' if current else 'written'}\n")
    return 0
