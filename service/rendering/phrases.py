"""Translate English sentences (stored verdicts and remarks, reports, pictures) to the reader's language.

A file of the folder ``phrases`` maps English patterns to patterns in each language: ``"{n} runs"`` fits "17 runs". The text in the place of
a name in braces is translated by the same rules, unless the name is in `NAMED`. This text never contains the end of a sentence, and no
blanks if the name has one letter. A phrase has no full stop at its end. A text without a pattern is split into sentences and their parts,
and each part is tried; a part without a pattern stays English. Tests search all screens and reports for texts without a pattern.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from functools import cache, lru_cache
from html import escape, unescape
from pathlib import Path

from markupsafe import Markup

FOLDER = Path(__file__).parent / "phrases"
ENGLISH = "en"
LANGUAGES = (ENGLISH, "de", "ja", "ko")
LONGEST = 2000
"""Longest text that is translated, characters."""
NAMED = frozenset(("campaign", "file", "machine", "run", "setup", "who"))
"""Names in braces that stand for names given by people; their texts contain no semicolon."""
_PLACE = re.compile(r"\{(\w+)\}")
_SHOWN = re.compile(r'>([^<>]+)<|aria-label="([^"]*)"')
_WORD = re.compile("[A-Za-z]{2}|/")
_ENDS = (". ", "; ", ": ", ", the ", " and the ", " or ", ", ")
_OWN_ENDS = {
    "de": {", the ": ", ", " and the ": " und ", " or ": " oder "},
    "ja": {". ": "。", ", ": "、", ".": "。", ", the ": "、", " and the ": "、", " or ": "、または"},
    "ko": {", the ": ", ", " and the ": ", ", " or ": " 또는 "},
}
"""Ends of sentences and parts in a language; languages without entries use those of English."""


@dataclass(frozen=True, slots=True)
class _Pattern:
    """A phrase with places: its text before the first place and after the last, an expression for the whole phrase, and the translation."""

    head: str
    tail: str
    fits: re.Pattern[str]
    told: str


@cache
def _phrases(lang: str) -> tuple[dict[str, str], tuple[_Pattern, ...]]:
    """Phrases without places, and patterns for phrases with places, the most literal first."""
    known: dict[str, str] = {}
    for file in sorted(FOLDER.glob("*.json")):
        known |= {key: told[lang] for key, told in json.loads(file.read_text(encoding="utf-8")).items() if lang in told}
    placed = sorted((key for key in known if _PLACE.search(key)), key=lambda key: -len(_PLACE.sub("", key)))
    return {k: v for k, v in known.items() if not _PLACE.search(k)}, tuple(_pattern(key, known[key]) for key in placed)


def _pattern(key: str, told: str) -> _Pattern:
    parts = _PLACE.split(key)
    places = {part: r"\S+?" if len(part) == 1 else rf"(?:(?!{'[.;]' if part in NAMED else '[.]'} ).)+?" for part in parts[1::2]}
    text = "".join(re.escape(part) if k % 2 == 0 else f"(?P<{part}>{places[part]})" for k, part in enumerate(parts))
    return _Pattern(parts[0], parts[-1], re.compile(text, re.DOTALL), told)


@lru_cache(16384)
def phrase(lang: str, text: str) -> str:
    """The text in a language, as far as there are phrases for it."""
    if lang == ENGLISH or len(text) > LONGEST or not _WORD.search(text):
        return text
    bare, ends = text.removesuffix("."), _OWN_ENDS.get(lang, {})
    said = _fitting(lang, bare) or _within_a_sentence(lang, bare)
    if said is not None:
        return said if bare == text else said + ends.get(".", ".")
    for end in _ENDS:
        parts = text.split(end)
        told = [phrase(lang, part) for part in parts] if len(parts) > 1 else parts
        if told != parts:
            return ends.get(end, end).join(told)
    return text


def is_whole(lang: str, text: str) -> bool:
    """Whether a language has phrases for all parts of a text, so that `phrase` leaves nothing English."""
    if lang == ENGLISH or not _WORD.search(text):
        return True
    bare = text.removesuffix(".")
    if (_fitting(lang, bare) or _within_a_sentence(lang, bare)) is not None:
        return True
    parts = next((parts for end in _ENDS if len(parts := text.split(end)) > 1), [])
    return bool(parts) and all(is_whole(lang, part) for part in parts)


@lru_cache(4096)
def _likely(lang: str, first: str, last: str) -> tuple[_Pattern, ...]:
    """Patterns that a text with these first two letters and this last one may fit, in their order."""
    return tuple(one for one in _phrases(lang)[1] if first.startswith(one.head[:2]) and last.endswith(one.tail[-1:]))


def _fitting(lang: str, text: str) -> str | None:
    exact = _phrases(lang)[0]
    if text in exact:
        return exact[text]
    for one in _likely(lang, text[:2], text[-1:]):
        if text.startswith(one.head) and text.endswith(one.tail):
            found = one.fits.fullmatch(text)
            if found is not None:
                values = found.groupdict().items()
                return one.told.format(**{name: value if name in NAMED else phrase(lang, value) for name, value in values})
    return None


def _within_a_sentence(lang: str, text: str) -> str | None:
    """Translate a text that begins a sentence but whose phrase begins with a small letter; None without such a phrase."""
    said = _fitting(lang, text[:1].lower() + text[1:]) if text[:1].isupper() else None
    return None if said is None else said[:1].upper() + said[1:]


def pictured(lang: str, svg: str) -> Markup:
    """A picture of our own writer with its texts in a language."""
    if lang == ENGLISH:
        return Markup(svg)  # noqa: S704 - the writer has escaped every text

    def say(found: re.Match[str]) -> str:
        if found[1] is not None:
            return f">{escape(phrase(lang, unescape(found[1])), quote=False)}<"
        return f'aria-label="{escape(phrase(lang, unescape(found[2])))}"'

    return Markup(_SHOWN.sub(say, svg))  # noqa: S704 - escaped again above
