"""Whatever a measurement or a push says when it stops is told in every language: causes, remedies, and reasons against a table."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from abbe.service import push, sequences
from abbe.service.compensation import gate, proposal_decisions
from abbe.service.rendering.phrases import LANGUAGES, is_whole
from abbe.service.web.formatting import without_commands

FOLDER = Path(sequences.__file__).parent
# Their parts are filled in from a few words, or they hold the words of another error.
COMPOSED = {"the laser's beam is {}", "{}: {}", "{}: its radius comes out {} mm too {}", "{}; then resume"}
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


FOLDERS = (*sorted(Path(push.__file__).parent.glob("*.py")), Path(gate.__file__), Path(proposal_decisions.__file__))
# A length of a list, a digest, a place: parts of a sentence that is tested with them.
PARTS = {"boot {} then, {} now", "table of {} over {}", "{}, by the service", "{}; pushed by {}", "FORM {} (table of {} over {})"}
PARTS |= {"the controller restarted since the proposal ({}): measure again"}


def reasons() -> Iterator[str]:
    """Sentences that are yielded, returned, or given as ``why``."""
    for file in FOLDERS:
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            told = [node.value] if isinstance(node, ast.Yield | ast.Return) else []
            told += [one.value for one in getattr(node, "keywords", ()) if one.arg in {"why", "again", "pending"}]
            for one in told:
                first = one.elts[0] if isinstance(one, ast.Tuple) and one.elts else one
                text = "" if first is None else _text(first)
                if text.count(" ") > 1 and re.search("[a-z]{3}", text.replace("{}", "")):
                    yield re.sub(r"^[A-Z ]+: ", "", text)


@pytest.mark.parametrize("lang", LANGUAGES[1:])
def test_every_reason_is_told(lang: str) -> None:
    found = [text for text in dict.fromkeys(reasons()) if text not in PARTS]
    found.append("the controller restarted since the proposal (boot 0000005A then, 0000005B now): measure again")
    assert len(found) > 60
    assert [text for text in found if not is_whole(lang, text.replace("{}", "5"))] == []
