"""A page is in its reader's language: every screen is walked, and what is left of English is a name, a code, a unit or an abbreviation."""

from __future__ import annotations

import asyncio
import json
import re
from html import unescape

import pytest

from abbe.drivers.fixture.driver import ConsoleFixture
from abbe.service.rendering.phrases import FOLDER, LANGUAGES, phrase, pictured
from abbe.service.web.formatting import without_commands
from tests.languages import english
from tests.pages_world import as_user, filled_once, screens, served

OTHERS = LANGUAGES[1:]


def texts(page: str) -> list[str]:
    """What a person reads or hears of a page."""
    body = re.sub(r"<script.*?</script>", "", page.partition("<body")[2], flags=re.DOTALL)
    said = re.findall(r">([^<>]+)<", body) + re.findall(r'aria-label="([^"]*)"', body)
    return [text for one in said if (text := unescape(one).strip())]


def test_every_screen_is_in_its_language(tmp_path_factory: pytest.TempPathFactory) -> None:
    """In a world of its own: other tests write remarks into the common one. None has a part that only names a command."""
    left: dict[str, str] = {}
    with served(filled_once(tmp_path_factory)) as running:
        read = {}
        for lang in LANGUAGES:
            with as_user(running, "anna", **{"Accept-Language": lang}) as client:
                read[lang] = {path: texts(client.get(path).text) for path in screens(running.filled)}
        for lang in OTHERS:
            for path, found in read[lang].items():
                originals = frozenset(read["en"][path])
                left |= {f"{lang} {text}": path for text in found if english(lang, text, originals)}
    assert not left, "\n".join(f"{text}  {where}" for text, where in sorted(left.items()))
    shown = [(path, text) for some in read.values() for path, found in some.items() for text in found]
    assert [(path, text) for path, text in shown if without_commands(text) != text and " · " not in text] == []


def test_a_report_of_the_page_is_in_the_readers_language(tmp_path_factory: pytest.TempPathFactory) -> None:
    wanted = {"en": "Verification 24", "de": "Nicht bestanden", "ja": "不合格", "ko": "불합격"}
    with served(filled_once(tmp_path_factory)) as running:
        for lang, word in wanted.items():
            with as_user(running, "anna", **{"Accept-Language": lang}) as client:
                page = client.get("/api/v1/reports/verification/24?form=html").text
                data = client.get("/api/v1/reports/verification/24?form=json").json()
            assert f'<html lang="{lang}">' in page
            assert word in page
            assert data["verdict"]["word"] == "Failed", "files for programs are English"


@pytest.mark.parametrize("lang", OTHERS)
def test_a_phrase_tells_its_parts_and_leaves_what_it_does_not_know(lang: str) -> None:
    for text in ("the spindle hums", "a hammer over there", "", "mill-7"):
        assert phrase(lang, text) == text
    weekly = {"de": "montags, 06:00", "ja": "月曜日 06:00", "ko": "월요일 06:00"}
    assert phrase(lang, "At 06:00 on Monday") == weekly[lang]
    ended = {"de": "Entfernt sich von der Grenze. Abc.", "ja": "限界から遠ざかっている。Abc.", "ko": "한계에서 멀어짐. Abc."}
    assert phrase(lang, "Moves away from the limit. Abc.") == ended[lang]


@pytest.mark.parametrize("lang", OTHERS)
def test_every_prompt_of_the_fixture_is_told(lang: str) -> None:
    """With the position of the spindle before it, as a campaign from the page shows it."""
    asked: list[str] = []

    async def ask(text: str) -> None:
        asked.append(f"Spindle at X 10.0 mm Y -2.5 mm Z 0.0 mm. {text}")

    async def every(fixture: ConsoleFixture) -> None:
        await fixture.mount_ballbar(150.0)
        await fixture.take_out_ballbar()
        await fixture.change_ballbar(100.0)
        await fixture.mount_laser((0.6, -0.8, 0.0))
        await fixture.mount_artefact((1.0, 2.0, 3.0), ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)))
        await fixture.unmount()

    asyncio.run(every(ConsoleFixture(ask)))
    assert len(asked) == 6
    assert [told for text in asked if english(lang, told := phrase(lang, text), asked)] == []


def test_a_picture_tells_its_texts() -> None:
    assert phrase("en", "At 06:00 on Monday") == "At 06:00 on Monday"
    assert phrase("ja", "Every 2 minutes, counted from 2026-01-01 00:00 UTC") == "2 分ごと、起点 2026-01-01 00:00 UTC"
    more = {"de": "> 5 × Rauschen", "ja": "ノイズの 5 倍超", "ko": "잡음의 5배 초과"}
    assert {lang: phrase(lang, "> 5 × noise") for lang in OTHERS} == more, "more than, not at least"
    told = pictured("ja", '<svg aria-label="limit"><title>limit</title><text>a &lt; b &amp; c</text></svg>')
    assert str(told) == '<svg aria-label="限界"><title>限界</title><text>a &lt; b &amp; c</text></svg>'


def test_phrases_are_in_every_language_keep_their_places_and_stand_in_order() -> None:
    seen: set[str] = set()
    for file in FOLDER.glob("*.json"):
        pairs = json.loads(file.read_text(encoding="utf-8"), object_pairs_hook=list)
        keys = [key for key, _ in pairs]
        assert keys == sorted(set(keys)), file.name
        assert seen.isdisjoint(keys)
        seen |= set(keys)
        for key, told in pairs:
            assert tuple(lang for lang, _ in told) == OTHERS, key
            assert not key.endswith("."), key
            for _, text in told:
                assert text, key
                assert set(re.findall(r"{(\w+)}", key)) == set(re.findall(r"{(\w+)}", text)), key
