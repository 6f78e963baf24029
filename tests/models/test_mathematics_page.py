"""docs/explanation/mathematics.md names functions that exist."""

import importlib
import re
from pathlib import Path

PAGE = Path(__file__).parents[2] / "docs" / "explanation" / "mathematics.md"
ENTRY = re.compile(r"`(abbe\.models\.[\w.]+)`: ((?:`\w+`(?:, )?)+)")


def test_every_name_on_the_page_exists_and_has_a_docstring():
    found = ENTRY.findall(PAGE.read_text(encoding="utf-8"))
    assert len(found) > 30
    for module, names in found:
        loaded = importlib.import_module(module)
        for name in re.findall(r"`(\w+)`", names):
            assert getattr(loaded, name).__doc__, f"{module}.{name}"


def test_no_module_is_mentioned_without_a_function():
    text = PAGE.read_text(encoding="utf-8")
    assert set(re.findall(r"(?:abbe\.)?models\.[\w.]+\w", text)) == {module for module, _ in ENTRY.findall(text)}
