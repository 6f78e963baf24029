"""Times and figures in words, for the page."""

from __future__ import annotations

from datetime import UTC, datetime, tzinfo

_UNITS = {"um": "µm", "urad": "µrad", "mm": "mm", "ppm": "ppm", "s": "s", "c": "°C", "percent": "%"}


def span(seconds: float) -> str:
    """Return a length of time in the largest sensible unit: ``40 s``, ``5 min``, ``3 h``, ``2 days``."""
    seconds = abs(seconds)
    if seconds < 90:
        return f"{seconds:.0f} s"
    if seconds < 90 * 60:
        return f"{seconds / 60:.0f} min"
    if seconds < 36 * 3600:
        return f"{seconds / 3600:.0f} h"
    return f"{seconds / 86400:.0f} days"


def due(moment: datetime, now: datetime, zone: tzinfo) -> str:
    """Return when something is due: ``Monday 23 November 06:00, in 2 days``."""
    left_s = (moment - now).total_seconds()
    local = moment.astimezone(zone)
    clock = f"{local:%H:%M}" if local.second == 0 else f"{local:%H:%M:%S}"
    day = "today" if local.date() == now.astimezone(zone).date() else f"{local:%A} {local.day} {local:%B}"
    return f"{day} {clock}, in {span(left_s)}" if left_s > 0 else f"{day} {clock}, now"


def ago(moment: datetime, now: datetime) -> str:
    """Return how long ago something was."""
    return f"{span((now - moment).total_seconds())} ago"


def stamp(moment: datetime, zone: tzinfo = UTC) -> str:
    """Return a moment as people of the zone write it down: ``2026-11-23 06:00:12``."""
    return f"{moment.astimezone(zone):%Y-%m-%d %H:%M:%S}"


def figure_name(key: str) -> tuple[str, str]:
    """Return name and unit of a figure: ``body_diagonal_um`` is ("Body diagonal", "µm")."""
    stem, _, unit = key.rpartition("_")
    if not stem or unit not in _UNITS:
        stem, unit = key, ""
    name = stem.replace("_", " ").replace("rms", "RMS")
    return name[:1].upper() + name[1:], _UNITS.get(unit, "")


def number(value: float | None) -> str:
    """Return a figure with as many digits as its size deserves, and a dash for one that is missing."""
    if value is None:
        return "–"
    size = abs(value)
    return f"{value:.0f}" if size >= 100 else f"{value:.1f}" if size >= 1 else f"{value:.2f}"
