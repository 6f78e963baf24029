"""Strict reading of JSON text: what Python's reader accepts silently, or ends with another exception, raises a FileFormatError."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NoReturn

from abbe.service.errors import FileFormatError

MAX_DIGITS = 308
"""Longer integers exceed float64 (and Python refuses to read more than 4300 digits)."""


def refuse_duplicates(pairs: Iterable[tuple[str, Any]]) -> dict[str, Any]:
    """``object_pairs_hook`` of ``json.loads`` for objects with distinct keys.

    Raises
    ------
    ValueError
        A key occurs twice; Python would silently keep only the last value.
    """
    found: dict[str, Any] = {}
    for key, value in pairs:
        if key in found:
            raise ValueError(f"key {key!r} stands twice in one object")
        found[key] = value
    return found


def strict_json(text: str, path: Path, *, finite: bool = True) -> Any:
    """Value of a JSON text; ``path`` is named in errors.

    ``finite``: refuse ``NaN``, ``Infinity`` and numbers beyond float64 such as ``1e999``. Callers that check numbers themselves, and can
    name their place in the document, pass False.

    Raises
    ------
    FileFormatError
        The text is no JSON, repeats a key in one object, is nested too deeply, has an integer of more than 308 digits, or (``finite``) a
        number that is not finite.
    """
    strict: dict[str, Any] = {"parse_constant": _refuse, "parse_float": _finite} if finite else {}
    try:
        return json.loads(text, object_pairs_hook=refuse_duplicates, parse_int=_integer, **strict)
    except json.JSONDecodeError as err:
        raise FileFormatError(f"{path}: line {err.lineno}, column {err.colno}: not JSON: {err.msg}", "correct the file") from None
    except RecursionError:
        raise FileFormatError(f"{path}: nested too deeply", "correct the file") from None
    except ValueError as err:
        raise FileFormatError(f"{path}: {err}", "correct the file") from None


def _integer(digits: str) -> int:
    if len(digits.lstrip("-")) > MAX_DIGITS:
        raise ValueError(f"an integer of {len(digits.lstrip('-'))} digits ({digits[:12]}...), expected at most {MAX_DIGITS}")
    return int(digits)


def _finite(digits: str) -> float:
    value = float(digits)
    if not math.isfinite(value):
        _refuse(digits)
    return value


def _refuse(word: str) -> NoReturn:
    raise ValueError(f"expected finite numbers, got {word[:30]}")
