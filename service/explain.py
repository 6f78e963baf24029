"""Validation errors as text: where the mistake is, what was expected, what the author probably meant."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from typing import Any

from pydantic_core import ErrorDetails


def location_text(location: tuple[int | str, ...]) -> str:
    """Return the location of an error as text, e.g. ``schedule[1].cron``. ``location`` counts indices from 0, the text from 1."""
    text = ""
    for part in location:
        text += f"[{part + 1}]" if isinstance(part, int) else f".{part}" if text else part
    return text


def expected(error: ErrorDetails) -> str:
    """Return one line: what was expected and what was found."""
    message = (
        error["msg"].removeprefix("Value error, ").replace("Input should be a valid", "expected a").replace("Input should be", "expected")
    )
    for noun in ("integer", "array", "object"):
        message = message.replace(f"expected a {noun}", f"expected an {noun}")
    if error["type"] == "value_error":
        return message  # our own validators already include the value
    return f"{message}, got {short_repr(error['input'])}"


def nearest(key: str, valid: Iterable[str]) -> str:
    """Return a hint for an unknown key: the nearest valid key, or all of them."""
    keys = sorted(valid)
    close = difflib.get_close_matches(key.lower(), keys, n=1, cutoff=0.5) or [one for one in keys if one.lower() == key.lower()]
    return f"did you mean {close[0]!r}?" if close else f"valid keys here: {', '.join(keys)}"


def short_repr(value: Any) -> str:
    """Return a value's ``repr`` on one line, at most 60 characters."""
    text = " ".join(repr(value).split())
    return text if len(text) <= 60 else text[:57] + "..."
