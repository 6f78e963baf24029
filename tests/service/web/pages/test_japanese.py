"""A Japanese page is Japanese: every screen is walked, and what is left in Latin letters is a name, a code, a unit or an abbreviation."""

from __future__ import annotations

import json
import re
from html import unescape

import pytest

from abbe.service.web.page import HERE
from abbe.service.web.phrases import phrase, pictured
from tests.pages_world import USERS, as_user, filled_once, screens, served


def words(text: str) -> set[str]:
    return set(text.split())


NAMES = words("mill june late weekly night quick check verify ann VMC auth usb serial modbus dev ballbar laser") | set(USERS)
NAMES |= words("helix lineX lineY lineZ diagonal ppp npp pnp ppn XYZ ZYX Europe Berlin UTC done user")
"""Of machine, campaigns, runs, schedules, recipes, people, devices and zones of the world."""
REMARKS = ("the colour of the machine", "worse on the gauge block", "look at it")
"""What people of the world wrote."""
SHORT = words("Abbe RMS PDF CSV PNG JSON CUSUM EWMA MQTT GUM ISO CRC SHA POST CNC rms max English Deutsch µrad µin")
CODES = (r"[A-Z]{3}-\d+", r"E[XYZABC][XYZ](?:\.\d+)?", r"[ABC]0[XYZ]", r"[0-9A-F]{8}", r"[0-9a-f]{40,}", r"[a-z]+(?:_[a-zA-Z0-9]+)+")
CODE = re.compile(r"\b(?:" + "|".join((*CODES, r"rigid21/\S+", r"abbe [a-z]+ ?[a-z]*", r"lateral_play\S*")) + r")|/[a-z]\S*|'\w+'")


def texts(page: str) -> list[str]:
    """What a person reads or hears of a page."""
    body = re.sub(r"<script.*?</script>", "", page.partition("<body")[2], flags=re.DOTALL)
    said = re.findall(r">([^<>]+)<", body) + re.findall(r'aria-label="([^"]*)"', body)
    return [text for one in said if (text := unescape(one).strip())]


def foreign(text: str) -> set[str]:
    for remark in REMARKS:
        text = text.replace(remark, " ")
    return set(re.findall(r"[A-Za-zµ]{3,}", CODE.sub(" ", text))) - NAMES - SHORT


def test_every_screen_is_japanese(tmp_path_factory: pytest.TempPathFactory) -> None:
    """In a world of its own: other tests write remarks into the common one."""
    left: dict[str, set[str]] = {}
    with served(filled_once(tmp_path_factory)) as running, as_user(running, "anna", **{"Accept-Language": "ja"}) as client:
        for path in screens(running.filled):
            for text in texts(client.get(path).text):
                if foreign(text):
                    left.setdefault(text, set()).add(path)
    assert "\n".join(f"{text}  {min(where)}" for text, where in sorted(left.items())) == ""


def test_a_phrase_tells_its_parts_and_leaves_what_it_does_not_know() -> None:
    assert phrase("ja", "At 06:00 on Monday") == "月曜日 06:00"
    assert phrase("ja", "Every 2 minutes, counted from 2026-01-01 00:00 UTC") == "2 分ごと、起点 2026-01-01 00:00 UTC"
    for text in ("the spindle hums", "a hammer over there", "", "mill-7"):
        assert phrase("ja", text) == text
    assert phrase("en", "At 06:00 on Monday") == "At 06:00 on Monday"
    told = pictured("ja", '<svg aria-label="limit"><title>limit</title><text>a &lt; b &amp; c</text></svg>')
    assert str(told) == '<svg aria-label="限界"><title>限界</title><text>a &lt; b &amp; c</text></svg>'


def test_phrases_keep_their_places_and_stand_in_order() -> None:
    for file in (HERE / "phrases").glob("*.json"):
        pairs = json.loads(file.read_text(encoding="utf-8"), object_pairs_hook=list)
        keys = [key for key, _ in pairs]
        assert keys == sorted(set(keys)), file.name
        assert [key for key, told in pairs if set(re.findall(r"{(\w+)}", key)) != set(re.findall(r"{(\w+)}", told))] == []
