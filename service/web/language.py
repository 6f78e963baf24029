"""The texts of the screens in four languages: one catalogue file each, all with the same keys and placeholders.

Stored sentences (verdicts, refusals, remarks of reports) are English; `abbe.service.rendering.phrases` has their translations.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from datetime import datetime
from functools import cache
from pathlib import Path

from abbe.service.rendering.phrases import ENGLISH, LANGUAGES
from abbe.service.web.formatting import figure_name

NAMES: Mapping[str, str] = dict(zip(LANGUAGES, ("English", "Deutsch", "日本語", "한국어"), strict=True))
DEFAULT = ENGLISH
FOLDER = Path(__file__).parent / "catalogues"
Translate = Callable[..., str]
"""``translate(key, **values)``: the text of a key in the language of a reader."""
SPAN_KEYS = (
    "span.s", "span.min", "span.h", "span.days", "due.in", "due.now", "ago", "job.left", "job.unknown", "lost.core", "lost.at", "login",
    "strip.stopped", "strip.nothing", "strip.failed", "strip.unreached", "strip.out",
)  # fmt: skip
"""Texts of the script that every screen has."""


@cache
def catalogue(language: str) -> Mapping[str, str]:
    """Texts of one language by key."""
    loaded: dict[str, str] = json.loads((FOLDER / f"{language}.json").read_text(encoding="utf-8"))
    return loaded


def translate(language: str, key: str, **values: object) -> str:
    """The text of a key with its placeholders filled. Raises KeyError for an unknown key."""
    text = catalogue(language)[key]
    return text.format(**values) if values else text


def translate_or(language: str, key: str, default: str) -> str:
    """The text of a key that may be unknown, e.g. of a state that a newer version stored."""
    return catalogue(language).get(key, default)


def preferred(accepted: str) -> str:
    """The available language that the header ``Accept-Language`` prefers; English if none."""
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
    """A duration as text in the largest sensible unit, like `abbe.service.queries.timetable.span`."""
    s = abs(seconds)
    if s < 90:
        return translate(language, "span.s", n=f"{s:.0f}")
    if s < 90 * 60:
        return translate(language, "span.min", n=f"{s / 60:.0f}")
    if s < 36 * 3600:
        return translate(language, "span.h", n=f"{s / 3600:.0f}")
    return translate(language, "span.days", n=f"{s / 86400:.0f}")


def due(language: str, time: datetime, now: datetime) -> str:
    """Text of a due time relative to now."""
    left_s = (time - now).total_seconds()
    return translate(language, "due.in", span=span(language, left_s)) if left_s > 0 else translate(language, "due.now")


def ago(language: str, time: datetime, now: datetime) -> str:
    """Text of a past time relative to now."""
    return translate(language, "ago", span=span(language, (now - time).total_seconds()))


def figure(language: str, key: str) -> tuple[str, str]:
    """Name and unit of a figure of a check: ``body_diagonal_um`` is ("Body diagonal", "µm")."""
    name, unit = figure_name(key)
    stem = key.rpartition("_")[0] if unit else key
    if stem.startswith("diagonal_") and len(stem) == len("diagonal_ppp"):
        return translate(language, "figure.diagonal", name=stem.removeprefix("diagonal_")), unit
    return translate_or(language, f"figure.{stem}", name), unit
