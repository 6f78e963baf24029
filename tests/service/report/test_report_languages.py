"""Reports are in their language: every text of every kind of report, its PDF, and what happens without a font or a known language."""

from __future__ import annotations

import io
import os
import re
from collections.abc import Iterator
from dataclasses import replace
from html import unescape
from pathlib import Path
from typing import Any

import pypdf
import pytest

from abbe.service.domain.machine import Item
from abbe.service.effects.effect_catalogue import catalogue
from abbe.service.effects.model_book import REMEDIES
from abbe.service.errors import FileFormatError
from abbe.service.rendering import document_page
from abbe.service.rendering.document import Document, Instrument, Section, TextTable
from abbe.service.rendering.document_data import document_json, shown
from abbe.service.rendering.document_page import document_html, document_pdf, write_document
from abbe.service.rendering.laboratory import TRANSLATION
from abbe.service.rendering.phrases import LANGUAGES, phrase
from tests.conftest import Require
from tests.languages import english
from tests.pages_world import filled_once
from tests.report_world import documents

LONG = os.environ.get("ABBE_TEST_LONG") == "1"
OTHERS = LANGUAGES[1:]
LETTERS = {"de": "[äöüß]", "ja": "[\u3040-\u30ff\u4e00-\u9fff]", "ko": "[\uac00-\ud7ff]"}


@pytest.fixture(scope="module")
def reports(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Document]:
    return documents(filled_once(tmp_path_factory), tmp_path_factory)


def texts(value: Any) -> Iterator[str]:
    """What a person reads or hears of the data of a page."""
    if isinstance(value, dict):
        for key, one in value.items():
            yield from texts(one) if key not in {"kind", "sign", "layout", "lang", "format"} else ()
    elif isinstance(value, list):
        for one in value:
            yield from texts(one)
    elif isinstance(value, str) and value.startswith("<svg"):
        yield from (unescape(text) for text in re.findall(r">([^<>]+)<", value))
    elif isinstance(value, str):
        yield value


@pytest.mark.parametrize("lang", OTHERS)
def test_every_text_of_every_report_is_in_its_language(lang: str, reports: dict[str, Document], full_report: Document) -> None:
    """Of the report of a demonstration only what is not invented for it."""
    left: dict[str, str] = {}
    cycle = replace(full_report, title="Circle", about={}, verdict=None, remarks=(), not_observable=None, provenance={})
    for name, document in (reports | {"cycle": cycle}).items():
        originals = frozenset(texts(shown(document)))
        left |= {text: name for text in texts(shown(replace(document, lang=lang))) if english(lang, text, originals)}
    assert not left, "\n".join(f"{text}  {where}" for text, where in sorted(left.items()))


@pytest.mark.parametrize("lang", OTHERS)
def test_a_pdf_says_what_its_data_say_and_has_letters_for_it(lang: str, reports: dict[str, Document], require: Require) -> None:
    """Words of the templates are in the data, too: a PDF with another word has one that nobody could translate.

    Every report in one of the languages; in all of them in the long run.
    """
    found = lang not in document_page.FONTS_OF or bool(document_page.font_folders(lang))
    require("fonts", found, "neither fonts-noto-cjk nor those of deploy/npm_files.py are here")
    for name in reports if LONG else list(reports)[OTHERS.index(lang) :: len(OTHERS)]:
        own = replace(reports[name], lang=lang)
        reader = pypdf.PdfReader(io.BytesIO(document_pdf(own)))
        text = " ".join(page.extract_text() for page in reader.pages)
        assert re.search(LETTERS[lang], text), name
        assert words(text) - words(" ".join(texts(shown(own)))) == set(), name
        assert reader.trailer["/Root"]["/Lang"] == lang
        assert b"<pdfuaid:part>1<" in reader.trailer["/Root"]["/Metadata"].get_object().get_data(), name  # it has every letter


@pytest.mark.parametrize("lang", OTHERS)
def test_every_effect_of_the_catalogue_is_told(lang: str) -> None:
    """Also those that the discovery of the world did not find."""
    said: set[str] = set(REMEDIES.values())
    for one in catalogue():
        said |= {one.title, one.signature, one.remedy_text, one.source, *(f"{one.title} {key}".strip() for key in one.keys)}
        said |= {form.name for form in one.forms}
    assert {text: told for text in said if english(lang, told := phrase(lang, text), said)} == {}


def squeezed(made: bytes) -> str:
    return "".join("".join(page.extract_text() for page in pypdf.PdfReader(io.BytesIO(made)).pages).split())


def test_without_a_font_a_report_is_english_and_says_so(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """German needs no font of the computer; the digest and so the number of a certificate do not depend on what is said."""
    monkeypatch.setattr(document_page, "FONTS", (str(tmp_path),))
    monkeypatch.delenv("ABBE_FONTS", raising=False)
    plain = Document(kind="run", title="Run a/b", verdict=("ok", "Passed", ""))
    for lang in ("ja", "ko"):
        text = squeezed(document_pdf(replace(plain, lang=lang)))
        assert "".join(document_page.IN_ENGLISH.format(lang=lang).split()) in text
        assert "Passed" in text
    assert "Bestanden" in squeezed(document_pdf(replace(plain, lang="de")))
    assert document_json(plain) == document_json(replace(plain, lang="ja"))
    assert "合格" in document_html(replace(plain, lang="ja")), "a browser has its own fonts"


def test_the_command_line_takes_the_language_of_its_environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    plain, target = Document(kind="run", title="Run a/b", verdict=("ok", "Passed", "")), tmp_path / "a.html"
    for lang, word in {"": "Passed", "en": "Passed", "de": "Bestanden", "ko": "합격"}.items():
        monkeypatch.setenv("ABBE_LANGUAGE", lang)
        write_document(plain, target)
        assert word in target.read_text(encoding="utf-8")
    monkeypatch.setenv("ABBE_LANGUAGE", "fr")
    with pytest.raises(FileFormatError, match="no language 'fr'"):
        write_document(plain, target)


def test_a_certificate_in_another_language_is_a_translation_with_the_same_number(reports: dict[str, Document]) -> None:
    one = reports["certificate"]
    numbers = {lang: shown(replace(one, lang=lang))["certificate"]["number"] for lang in LANGUAGES}
    assert len(set(numbers.values())) == 1
    said = {lang: " ".join(shown(replace(one, lang=lang))["certificate"]["statements"]) for lang in LANGUAGES}
    assert [lang for lang in LANGUAGES if "English certificate" in said[lang] or phrase(lang, TRANSLATION) in said[lang]] == [*OTHERS]


def test_names_stay_names() -> None:
    """A machine called Table and a customer called Limit are no words to be told."""
    plain = Document(kind="run", title="t", about={"Machine": "Table", "Campaign": "Limit", "Feed": "10 to 20 mm/min"}, lang="de")
    assert [one["value"] for one in shown(plain)["about"]] == ["Table", "Limit", "10 bis 20 mm/min"]


@pytest.mark.parametrize("lang", OTHERS)
def test_names_that_people_gave_stay_in_sentences_tables_and_certificates(lang: str, reports: dict[str, Document]) -> None:
    for text in ("Campaign {}", "Run {}", "run {}: no data", "push 3 of machine {}", "accepted by {} at 2026-11-27"):
        told = phrase(lang, text.format("before"))
        assert "before" in told
        assert told != text.format("before")
    table = Section("Runs", [TextTable(("Run", "State"), [("test", "no data")])])
    plain = Document(kind="run", title="t", about={"File": "table"}, sections=[table], lang=lang)
    assert shown(plain)["about"][0]["value"] == "table"
    assert shown(plain)["sections"][0]["blocks"][0]["rows"] == [["test", phrase(lang, "no data")]]
    one = reports["certificate"]
    assert one.issuer is not None
    typed = {"accreditation": "none", "place": "customer", "prefix": "test", "procedure": "before; limit"}
    issuer = one.issuer.model_copy(update=typed)
    item = Item(maker="Limit", model="table", serial="before", place="test")
    bar = Instrument("Ball-bar", "test; before; valid to 2027-01-31", "nothing stated")
    made = shown(replace(one, lang=lang, issuer=issuer, item=item, instruments=[bar]))
    facts = {fact["name"]: fact["value"] for fact in made["certificate"]["facts"]}
    wanted = phrase(lang, "serial {n}").format(n="before")
    assert facts[phrase(lang, "Item")].endswith(f"Limit, table, {wanted}")
    assert facts[phrase(lang, "Place of calibration")] == phrase(lang, "at the customer's") + ", test"
    assert facts[phrase(lang, "Accreditation")] == "none"
    assert facts[phrase(lang, "Number")].startswith("test")
    assert facts[phrase(lang, "Procedure")].startswith("before; limit")
    assert made["instruments"][0]["certificate"] == "test; before; " + phrase(lang, "valid to 2027-01-31")


def words(text: str) -> set[str]:
    return set(re.findall("[A-Za-zäöüßÄÖÜ]{3,}", text))
