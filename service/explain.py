"""Validation errors in words: where the mistake stands, what was expected, what the writer probably meant."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from typing import Any

from pydantic_core import ErrorDetails


def where(location: tuple[int | str, ...]) -> str:
    """Write a place in a document.

    Parameters
    ----------
    location : tuple
        Keys and indices from 0.

    Returns
    -------
    str
        E.g. ``schedule[1].cron``; indices count from 1, as people do.
    """
    text = ""
    for part in location:
        text += f"[{part + 1}]" if isinstance(part, int) else f".{part}" if text else part
    return text


def expected(error: ErrorDetails) -> str:
    """Say what was expected and what stands there instead.

    Parameters
    ----------
    error : ErrorDetails
        One of pydantic's errors.

    Returns
    -------
    str
        One line.
    """
    message = (
        error["msg"].removeprefix("Value error, ").replace("Input should be a valid", "expected a").replace("Input should be", "expected")
    )
    for noun in ("integer", "array", "object"):
        message = message.replace(f"expected a {noun}", f"expected an {noun}")
    if error["type"] == "value_error":
        return message  # our own validators say what they found
    return f"{message}, got {shown(error['input'])}"


def nearest(key: str, valid: Iterable[str]) -> str:
    """Suggest what to write in place of an unknown key.

    Parameters
    ----------
    key : str
        As the user wrote it.
    valid : iterable of str
        What could stand there.

    Returns
    -------
    str
        The nearest valid key, or all of them.
    """
    keys = sorted(valid)
    close = difflib.get_close_matches(key.lower(), keys, n=1, cutoff=0.5) or [one for one in keys if one.lower() == key.lower()]
    return f"did you mean {close[0]!r}?" if close else f"valid keys here: {', '.join(keys)}"


def shown(value: Any) -> str:
    """Write a value short enough for one line.

    Parameters
    ----------
    value : object
        Anything.

    Returns
    -------
    str
        At most about 60 characters.
    """
    text = " ".join(repr(value).split())
    return text if len(text) <= 60 else text[:57] + "..."
