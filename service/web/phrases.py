"""Sentences that others have written in English (stored verdicts and remarks, reports, pictures), in the reader's language.

A phrase file maps English patterns to the language: ``"{n} runs"`` fits "17 runs", and the same rules translate what stands in the
braces; a place with a name of one letter holds no blanks. A text without a pattern stays as it is, so that nothing is lost; a test walks
all screens and finds what has none.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from functools import cache, lru_cache
from html import escape, unescape
from pathlib import Path

from markupsafe import Markup

FOLDER = Path(__file__).parent / "phrases"
_PLACE = re.compile(r"\{(\w+)\}")
_SHOWN = re.compile(r'>([^<>]+)<|aria-label="([^"]*)"')
_ENDS = (". ", "; ", ", ")
LONGEST = 2000
"""Longer texts are no sentences."""


@cache
def _phrases(lang: str) -> tuple[dict[str, str], Sequence[tuple[re.Pattern[str], str]]]:
    """Phrases without places, and patterns of those with some, the most literal first."""
    file = FOLDER / f"{lang}.json"
    known: dict[str, str] = json.loads(file.read_text(encoding="utf-8")) if file.exists() else {}
    patterns = sorted((key for key in known if _PLACE.search(key)), key=lambda key: -len(_PLACE.sub("", key)))
    return {k: v for k, v in known.items() if not _PLACE.search(k)}, [(_pattern(key), known[key]) for key in patterns]


def _pattern(key: str) -> re.Pattern[str]:
    parts = _PLACE.split(key)
    places = {part: r"\S+?" if len(part) == 1 else ".+?" for part in parts[1::2]}
    return re.compile("".join(re.escape(part) if k % 2 == 0 else f"(?P<{part}>{places[part]})" for k, part in enumerate(parts)), re.DOTALL)


@lru_cache(8192)
def phrase(lang: str, text: str) -> str:
    """The text in a language, as far as its phrases know it."""
    exact, patterns = _phrases(lang)
    if not (exact or patterns) or not text or len(text) > LONGEST:
        return text
    if text in exact:
        return exact[text]
    for pattern, told in patterns:
        found = pattern.fullmatch(text)
        if found is not None:
            return told.format(**{name: phrase(lang, value) for name, value in found.groupdict().items()})
    for end in _ENDS:
        parts = text.split(end)
        if len(parts) > 1:
            said = [phrase(lang, part) for part in parts]
            if said != parts:
                return end.join(said)
    return text


def pictured(lang: str, svg: str) -> Markup:
    """A picture of our own writer with its texts in a language."""
    if not _phrases(lang)[0]:
        return Markup(svg)  # noqa: S704 - the writer has escaped every text

    def say(found: re.Match[str]) -> str:
        if found[1] is not None:
            return f">{escape(phrase(lang, unescape(found[1])), quote=False)}<"
        return f'aria-label="{escape(phrase(lang, unescape(found[2])))}"'

    return Markup(_SHOWN.sub(say, svg))  # noqa: S704 - escaped again above
