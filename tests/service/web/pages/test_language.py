"""The catalogues say the same things in every language, and everything that a screen says is in them."""

from __future__ import annotations

import json
import re
from pathlib import Path
from string import Formatter

import pytest

from abbe.service.web import frame, language
from abbe.service.web.page import HERE

LANGUAGES = list(language.NAMES)
TEMPLATES = sorted((HERE / "templates").glob("*.html"))
USED = {key for path in TEMPLATES for key in re.findall(r'\bt\("([^"]+)"', path.read_text(encoding="utf-8"))}


def places(text: str) -> set[str]:
    return {name for _, name, _, _ in Formatter().parse(text) if name is not None}


@pytest.mark.parametrize("lang", LANGUAGES)
def test_every_language_has_the_same_keys_and_places(lang: str) -> None:
    english, other = language.catalogue("en"), language.catalogue(lang)
    assert set(other) == set(english)
    assert {key: places(text) for key, text in other.items()} == {key: places(text) for key, text in english.items()}
    assert all(text.strip() for text in other.values())


def test_catalogue_files_are_sorted_and_name_no_key_twice() -> None:
    assert sorted(p.stem for p in language.FOLDER.glob("*.json")) == sorted(LANGUAGES)
    for lang in LANGUAGES:
        pairs = json.loads(Path(language.FOLDER / f"{lang}.json").read_text(encoding="utf-8"), object_pairs_hook=list)
        keys = [key for key, _ in pairs]
        assert keys == sorted(set(keys)), lang


def test_every_text_of_a_template_is_in_the_catalogue() -> None:
    assert len(USED) > 120
    assert USED - set(language.catalogue("en")) == set()
    assert {word for _, word, _, _ in frame.SCREENS} <= set(language.catalogue("en"))
    assert set(language.SPAN_KEYS) <= set(language.catalogue("en"))


def test_no_words_stand_in_a_template_itself() -> None:
    """What a person reads comes from the catalogue: outside of tags, a template holds signs, units and commands only."""
    allowed = {"Abbe", "abbe", "serve", "MACHINE", "toml", "once", "schedule", "devices", "audit", "verify", "MQTT", "m", "u"}
    allowed |= {"mm", "min", "s", "Hz", "C", "measure", "recipe", "user", "add", "NAME", "machine"}
    allowed |= {"X", "Y", "Z", "dX", "dY", "dZ", "U", "mm"}
    for path in TEMPLATES:
        text = re.sub(r"\{#.*?#\}|\{%.*?%\}|\{\{.*?\}\}", " ", path.read_text(encoding="utf-8"), flags=re.DOTALL)
        text = re.sub(r"<[^<>]*>|&\w+;", " ", text)
        assert set(re.findall(r"[A-Za-z]+", text)) <= allowed, path.name


@pytest.mark.parametrize(
    ("header", "expected"),
    [
        ("", "en"),
        ("ko-KR,ko;q=0.9,en;q=0.5", "ko"),
        ("fr-FR, de;q=0.4, ja;q=0.7", "ja"),
        ("de;q=0, en;q=0.1", "en"),
        ("fr", "en"),
        ("de;q=x, ja;q=0.2", "ja"),
        ("*;q=0.5", "en"),
        (",;;,=" * 300, "en"),
    ],
)
def test_the_browser_s_wish_is_heard(header: str, expected: str) -> None:
    assert language.preferred(header) == expected


def test_figures_and_spans_have_names_in_every_language() -> None:
    assert language.figure("de", "body_diagonal_um") == ("Raumdiagonale", "µm")
    assert language.figure("en", "diagonal_ppp_um") == ("Diagonal ppp", "µm")
    assert language.figure("ko", "odd_ppm") == ("Odd", "ppm")
    assert [language.span("en", s) for s in (5, 600, 7200, 200000)] == ["5 s", "10 min", "2 h", "2 days"]
    assert language.span("ja", 200000) == "2 日"


def test_a_state_that_nobody_translated_stays_as_it_is() -> None:
    assert frame.Frame("de").state("slot", "missed: 3 h late") == "missed: 3 h late"
    assert frame.Frame("de").state("standing", "approved") == "genehmigt"
