"""What of a text in another language is still English: neither data (names, codes, units) nor known as a word of both languages."""

from __future__ import annotations

import json
import re
from collections.abc import Collection
from functools import cache

from abbe.service.rendering.phrases import FOLDER
from abbe.service.web.language import catalogue
from tests.pages_world import USERS


def words(text: str) -> set[str]:
    return set(text.split())


NAMES = words("mill june late weekly night quick check verify ann VMC auth usb serial modbus dev ballbar laser") | set(USERS)
NAMES |= words("helix lineX lineY lineZ diagonal ppp npp pnp ppn XYZ ZYX Europe Berlin UTC done user norm cup back")
NAMES |= words("Werk Nord Ringstr Bonn Meier Muster GmbH Talweg dppp dnpp dpnp dppn legendre order heldout numpy scipy typst abbe")
NAMES |= words("Kakino Pahk Wang Edlén Edl Procedia CIRP sin tau beta")
"""Of authors, formulas, machine, campaigns, runs, schedules, recipes, people, devices, zones and programs of the worlds."""
REMARKS = (
    "the colour of the machine",
    "worse on the gauge block",
    "look at it",
    "lease taken",
    "bank 1 written and read back, equal",
    "03:38:06 activated",
    "03:39:51 verified",
)
"""What people of the world wrote."""
SHORT = words("cron English Deutsch") | words(
    "Abbe PIN RMS PDF CSV PNG JSON CUSUM EWMA MQTT GUM ISO IEC CRC SHA POST CNC LSC CAL rms max min ppm hPa mrad µrad µin"
)
CODES = (
    r"CAL-[-0-9a-f]+",
    r"[0-9a-f]{16,}(?:\+changes)?",
    r"[0-9a-f]{4}(?:-[0-9a-f]{4})+",
    r"[A-Z]{3}-\d+",
    r"E[XYZABC][XYZ](?:\.\d+)?",
    r"[ABC]0[XYZ]",
    r"F_[XY]{2},m(?:ax|in)",
    r"[0-9A-F]{8}",
    r"[a-z]+(?:_[a-zA-Z0-9]+)+",
    r"[A-Z][A-Z_]{3,}",
    r"rigid21(?:/\S+)?",
    r"abbe [a-z]+ ?[a-z]*",
    r"lateral_play\S*",
)
"""Certificates, digests, errors, motions, figures, checksums, keys, states, models, commands, effects; the longest first."""
CODE = re.compile(r"\b(?:" + "|".join(CODES) + r")|/[a-z]\S*|'\w+'|\[issuer\] \w+|\[item\] \w+|\{\w+\}")
ENGLISH_ONLY = words(
    "the of and is are not with for from by to at which this that has have runs than be were its it when where but or on into"
)
"""Words of sentences that German does not have."""


@cache
def of_both() -> frozenset[str]:
    """Texts that are the same in English and German."""
    pairs = [(text, catalogue("de")[key]) for key, text in catalogue("en").items()]
    for file in FOLDER.glob("*.json"):
        pairs += [(key, told["de"]) for key, told in json.loads(file.read_text(encoding="utf-8")).items()]
    return frozenset(_open(text) for text, told in pairs if text == told)


def _open(text: str) -> str:
    """The text with its places and numbers left open."""
    return re.sub(r"\{\w+\}|\d+", "#", text)


def english(lang: str, text: str, originals: Collection[str] = ()) -> set[str]:
    """Words of a told text that are English; ``originals``: texts of the same thing in English, none of which German may repeat."""
    for remark in REMARKS:
        text = text.replace(remark, " ")
    left = set(re.findall(r"[A-Za-zµÄÖÜäöüß]{2,}", CODE.sub(" ", text))) - NAMES - SHORT
    long = {word for word in left if len(word) > 2}
    if lang != "de":
        return long
    return left & ENGLISH_ONLY or (long if text in originals and _open(text) not in of_both() else set())
