"""Checks of exchange files. Every mistake raises a FileFormatError with file, key, row, and the expected value."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NoReturn, TypeVar

from pydantic import BaseModel, ValidationError

from abbe.service.domain.artefact import ARTEFACT_TEST, ArtefactRunFile, ArtefactSetupObject, PointColumns
from abbe.service.domain.document import Doc
from abbe.service.domain.run_file import ColumnsObject, RunFile, SetupObject
from abbe.service.errors import FileFormatError, and_more, location_text, mistakes, short_repr
from abbe.service.files import NotPlainError, read_plain

MAX_DIGITS = 308
"""Longer integers exceed float64 (and Python refuses to read more than 4300 digits)."""


def refuse_duplicates(pairs: Iterable[tuple[str, Any]]) -> dict[str, Any]:
    """Build an object with distinct keys, as ``object_pairs_hook`` of ``json.loads``.

    Raises
    ------
    ValueError
        A key occurs twice; Python would silently keep only the last value.
    """
    found: dict[str, Any] = {}
    for key, value in pairs:
        if key in found:
            raise ValueError(f"key {key!r} appears twice in one object")
        found[key] = value
    return found


def strict_json(text: str, path: Path, *, finite: bool = True) -> Any:
    """Parse a JSON text; ``path`` is named in errors.

    ``finite``: refuse ``NaN``, ``Infinity`` and numbers beyond float64 such as ``1e999``. Callers that check numbers themselves pass
    False, and can then name the key in the document.

    Raises
    ------
    FileFormatError
        The text is not JSON, repeats a key in one object, is nested too deeply, has an integer of more than 308 digits, or (``finite``) a
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


_OF_MOTION = ("mm", "um", "nm", "m", "rad", "urad", "mrad", "deg", "s", "ms", "us", "h", "mm_min", "mm_s", "rpm", "Hz", "kHz")
_OF_OTHERS = ("C", "K", "Pa", "hPa", "N", "kN", "Nm", "V", "mV", "A", "W", "kW", "percent", "permille", "ppm", "bits")
UNITS = frozenset({*_OF_MOTION, *_OF_OTHERS})
PLAIN = frozenset(("seq", "count", "no", "index", "id", "flag", "ratio", "status", "quality", "valid"))
"""Suffixes of columns without a unit."""
Parsed = TypeVar("Parsed", bound=BaseModel)
MAX_BYTES = 512 * 2**20


def read_json(path: Path) -> Doc:
    """Read a JSON object from a file, keys in order.

    Raises
    ------
    FileFormatError
        The file is missing, not a plain file, too large, not UTF-8, or not JSON (`abbe.service.runs.checks.strict_json`).
    """
    try:
        text = read_plain(path, MAX_BYTES).decode("utf-8")
        value = strict_json(text, path, finite=False)  # `check` reports the place of a NaN
    except FileNotFoundError:
        raise FileFormatError(f"{path}: no such file", "give a folder with campaign.json and its run files") from None
    except NotPlainError as err:
        raise FileFormatError(f"{path}: {err.strerror}", "put the run or campaign file itself there") from None
    except OSError as err:
        raise FileFormatError(f"{path}: cannot be read: {err.strerror}", "check its access rights") from None
    except UnicodeDecodeError as err:
        raise FileFormatError(f"{path}: byte {err.start} is not UTF-8", "save the file as UTF-8") from None
    if not isinstance(value, dict):
        raise FileFormatError(f"{path}: expected a JSON object, got {short_repr(value)}", "see docs/schemas")
    return value


def check(path: Path, document: Doc, model: type[Parsed]) -> Parsed:
    """Parse a document as a model of `abbe.service.domain.run_file`; ``path`` is named in errors.

    Raises
    ------
    FileFormatError
        The document has a mistake; the first one is reported.
    """
    try:
        # Through JSON, so that a list counts as a tuple, as in the file; json.dumps passes NaN, which the model refuses.
        found = model.model_validate_json(json.dumps(document))
    except ValidationError as err:
        raise _format_error(path, err) from None
    try:
        json.dumps(document, allow_nan=False)
    except ValueError:
        _check_finite(path, document)  # the NaN is in a key outside the format
    return found


def check_run(path: Path, document: Doc) -> RunFile | ArtefactRunFile:
    """Parse a run file after checking its columns row by row; ``path`` is named in errors.

    Raises
    ------
    FileFormatError
        The document has a mistake; the first one is reported.
    """
    points = document.get("test") == ARTEFACT_TEST
    models: tuple[type[BaseModel], ...] = (ArtefactSetupObject, PointColumns) if points else (SetupObject, ColumnsObject)
    for part, model in zip(("setup", "columns"), models, strict=True):
        keys = document.get(part)
        for key in keys if isinstance(keys, dict) else ():
            _check_unit(path, f"{part}.{key}", key, model, units_needed=part == "columns")
    found: RunFile | ArtefactRunFile = check(path, document, ArtefactRunFile) if points else check(path, document, RunFile)
    columns = {key: values for key, values in document["columns"].items() if values is not None}
    length = len(columns["t_s"])
    for key, values in columns.items():
        if len(values) != length:
            raise FileFormatError(f"{path}: columns.{key}: expected {length} rows as in t_s, got {len(values)}", "correct the file")
    times = columns["t_s"]
    for row in range(1, length):
        if times[row] < times[row - 1]:
            raise FileFormatError(
                f"{path}: columns.t_s, row {row + 1}: expected at least {times[row - 1]}, got {times[row]}",
                "write the rows in order of time",
            )
    return found


def _check_unit(path: Path, place: str, key: str, model: type[BaseModel], *, units_needed: bool) -> None:
    if key in model.model_fields:
        return
    for known in model.model_fields:
        stem = _stem(known)
        if stem != known and (key == stem or (key.startswith(stem + "_") and _is_unit_like(key[len(stem) + 1 :]))):
            raise FileFormatError(
                f"{path}: {place}: unknown unit suffix in {key!r}, expected {known!r}", "convert the values and rename the key"
            )
    last = key.rpartition("_")[2]
    if units_needed and last not in UNITS | PLAIN and not key.endswith("_mm_min"):
        raise FileFormatError(
            f"{path}: {place}: unknown unit suffix {last!r}, expected a unit, e.g. _mm, _s, _C, _Pa, _percent", "rename the column"
        )


def _stem(key: str) -> str:
    for unit in sorted(UNITS, key=len, reverse=True):
        if key.endswith("_" + unit):
            return key.removesuffix("_" + unit)
    return key


def _is_unit_like(text: str) -> bool:
    return text in UNITS or ("_" not in text and len(text) <= 6 and text not in PLAIN)


def _check_finite(path: Path, value: object, location: tuple[int | str, ...] = ()) -> None:
    if isinstance(value, float) and not math.isfinite(value):
        raise FileFormatError(f"{path}: {location_text(location)}: expected a finite number, got {value}", "correct the file")
    if isinstance(value, dict):
        for key, inner in value.items():
            _check_finite(path, inner, (*location, key))
    if isinstance(value, list):
        for index, inner in enumerate(value):
            _check_finite(path, inner, (*location, index))


def _format_error(path: Path, err: ValidationError) -> FileFormatError:
    errors = mistakes(err.errors())
    # Of a union ("a list or null") pydantic reports every branch; the deepest one is what the author meant.
    first = max((one for one in errors if one.place[:2] == errors[0].place[:2]), key=lambda one: len(one.place))
    location = tuple(
        part for part in first.place if not (isinstance(part, str) and (part.startswith(("list[", "tuple[")) or part in _TYPE_TAGS))
    )
    tail = and_more(errors)
    if first.kind == "missing":
        return FileFormatError(f"{path}: key {location_text(location)!r} is missing{tail}", "see docs/schemas")
    place = location_text(location)
    if location[:1] == ("columns",) and len(location) == 3 and isinstance(location[2], int):
        place = f"columns.{location[1]}, row {location[2] + 1}"
    prefix = f"{path}: {place}: " if place else f"{path}: "
    return FileFormatError(prefix + first.expected + tail, "correct the file")


_TYPE_TAGS = frozenset({"float", "int", "str", "polynomial", "table", "function-after[check_interval(), tuple[float, float]]"})
