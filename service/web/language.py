"""The words of the screens in four languages: one catalogue file each, all with the same keys and the same places for values.

What was stored in words (verdict sentences, refusals, remarks of reports) stays as it was stored, in English.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from datetime import datetime
from functools import cache
from pathlib import Path

from abbe.service.web.words import figure_name

NAMES: Mapping[str, str] = {"en": "English", "de": "Deutsch", "ja": "日本語", "ko": "한국어"}
DEFAULT = "en"
FOLDER = Path(__file__).parent / "catalogues"
SPAN_KEYS = ("span.s", "span.min", "span.h", "span.days", "due.in", "due.now", "ago", "job.left", "job.unknown", "lost.core")
"""What the script of the home page fills with numbers."""


@cache
def catalogue(language: str) -> Mapping[str, str]:
    """Key and text of one language."""
    loaded: dict[str, str] = json.loads((FOLDER / f"{language}.json").read_text(encoding="utf-8"))
    return loaded


def say(language: str, key: str, **values: object) -> str:
    """The text of a key with its places filled; KeyError for a key that no catalogue has."""
    text = catalogue(language)[key]
    return text.format(**values) if values else text


def known(language: str, key: str, otherwise: str) -> str:
    """The text of a key that may not be there, e.g. of a state that a newer version stored."""
    return catalogue(language).get(key, otherwise)


def wanted(accepted: str) -> str:
    """The language of ours that a browser likes most, from its ``Accept-Language``; English if none."""
    best, found = 0.0, DEFAULT
    for part in accepted[:500].split(","):
        name, _, rest = part.strip().partition(";")
        weight = _weight(rest)
        short = name.strip().lower().partition("-")[0]
        if short in NAMES and weight > best:
            best, found = weight, short
    return found


def _weight(text: str) -> float:
    name, _, value = text.strip().partition("=")
    if name.strip() != "q":
        return 1.0
    try:
        return float(value)
    except ValueError:
        return 0.0


def span(language: str, seconds: float) -> str:
    """A length of time in the largest sensible unit, as `abbe.service.queries.timetable.span`."""
    s = abs(seconds)
    if s < 90:
        return say(language, "span.s", n=f"{s:.0f}")
    if s < 90 * 60:
        return say(language, "span.min", n=f"{s / 60:.0f}")
    if s < 36 * 3600:
        return say(language, "span.h", n=f"{s / 3600:.0f}")
    return say(language, "span.days", n=f"{s / 86400:.0f}")


def due(language: str, moment: datetime, now: datetime) -> str:
    """How long until something is due."""
    left_s = (moment - now).total_seconds()
    return say(language, "due.in", span=span(language, left_s)) if left_s > 0 else say(language, "due.now")


def ago(language: str, moment: datetime, now: datetime) -> str:
    """How long ago something was."""
    return say(language, "ago", span=span(language, (now - moment).total_seconds()))


def figure(language: str, key: str) -> tuple[str, str]:
    """Name and unit of a figure of a check: ``body_diagonal_um`` is ("Body diagonal", "µm")."""
    name, unit = figure_name(key)
    stem = key.rpartition("_")[0] if unit else key
    if stem.startswith("diagonal_") and len(stem) == len("diagonal_ppp"):
        return say(language, "figure.diagonal", name=stem.removeprefix("diagonal_")), unit
    return known(language, f"figure.{stem}", name), unit
