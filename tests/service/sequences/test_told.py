"""Whatever a measurement says when it stops is told in every language: cause and remedy of every error of this folder."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

from abbe.service import sequences
from abbe.service.rendering.phrases import LANGUAGES, is_whole
from abbe.service.web.formatting import without_commands

FOLDER = Path(sequences.__file__).parent
# Their parts are filled in from a few words, or they hold the words of another error.
COMPOSED = {"the laser's beam is {}", "feature {}: {}", "feature {}: its radius comes out {} mm too {}", "{}; then resume"}
BEAM = ("the laser's beam is lost", "the laser's beam is too weak (12 permille)")


def _text(node: ast.expr) -> str:
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    parts = node.values if isinstance(node, ast.JoinedStr) else []
    return "".join(str(one.value) if isinstance(one, ast.Constant) else "{}" for one in parts)


def said() -> Iterator[str]:
    """Sentences that are given to errors, or stand beside one in a table of conditions."""
    for file in sorted(FOLDER.glob("*.py")):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            named = isinstance(node, ast.Call) and getattr(node.func, "id", "")[:1].isupper()
            given = node.args if isinstance(node, ast.Call) and named else node.elts if isinstance(node, ast.Tuple) else []
            yield from (text for one in given if " " in (text := _text(one)) and len(text) > 12)


@pytest.mark.parametrize("lang", LANGUAGES[1:])
def test_every_sentence_is_told(lang: str) -> None:
    found = [without_commands(text) for text in dict.fromkeys(said()) if text not in COMPOSED]
    assert len(found) > 60
    radius = [f"feature 5: its radius comes out 0.030 mm too {how}" for how in ("large", "small")]
    assert [text for text in (*found, *BEAM, *radius) if text and not is_whole(lang, text.replace("{}", "5"))] == []
