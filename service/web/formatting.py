"""Times, names of figures and numbers as text for the screens."""

from __future__ import annotations

import re
from datetime import UTC, datetime, tzinfo

_UNITS = {"um": "µm", "urad": "µrad", "mm": "mm", "ppm": "ppm", "s": "s", "c": "°C", "percent": "%"}

_NAME = r"\babbe (?!command)[a-z]{3}"
_COMMAND = re.compile(_NAME)
_SPAN = re.compile(r"`?" + _NAME + r"[^`;,。]*`?")
_ASIDE = re.compile(r" ?[(（][^()（）]*" + _NAME + r"[^()（）]*[)）]")
_PARTS = re.compile(r"((?<=[;.]) |(?<=。))")
_MOST_WORDS = 4
"""A part of a text that has more words than this beside its command says more than the command, and is kept."""


def stamp(time: datetime, zone: tzinfo = UTC) -> str:
    """A time in a time zone: ``2026-11-23 06:00:12``."""
    return f"{time.astimezone(zone):%Y-%m-%d %H:%M:%S}"


def figure_name(key: str) -> tuple[str, str]:
    """Name and unit of a figure: ``body_diagonal_um`` is ("Body diagonal", "µm")."""
    stem, _, unit = key.rpartition("_")
    if not stem or unit not in _UNITS:
        stem, unit = key, ""
    name = stem.replace("_", " ").replace("rms", "RMS")
    return name[:1].upper() + name[1:], _UNITS.get(unit, "")


def number(value: float | None) -> str:
    """A value with two decimals below 1, one below 100, and none from 100 on; a dash for None."""
    if value is None:
        return "–"
    size = abs(value)
    return f"{value:.0f}" if size >= 100 else f"{value:.1f}" if size >= 1 else f"{value:.2f}"


def without_commands(text: str) -> str:
    """Return a text without the brackets and parts that only name a command, because the page has no command line.

    A part with other content is kept whole: it may state a cause, or what to do first.
    """
    if not _COMMAND.search(text):
        return text
    parts = _PARTS.split(_ASIDE.sub("", text))
    kept = [part + end for part, end in zip(parts[::2], [*parts[1::2], ""], strict=True) if not _only_names_command(part)]
    return "".join(kept).rstrip(" ;:")


def _only_names_command(part: str) -> bool:
    if not _COMMAND.search(part):
        return False
    beside = re.findall(r"\w+", _SPAN.sub(" ", part))
    return sum(1 if word.isascii() else max(1, len(word) // 3) for word in beside) <= _MOST_WORDS
