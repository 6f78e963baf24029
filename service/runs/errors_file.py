"""Read an errors file (``abbe-errors/1``) as error motions, with its stated uncertainty and limits."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel

from abbe.models.arrays import F2
from abbe.models.functions.axis_function import AxisFunction
from abbe.models.functions.bspline import BSpline
from abbe.models.functions.legendre import Legendre
from abbe.models.functions.motions import SQUARENESS, ErrorMotions
from abbe.models.functions.polynomial import Polynomial
from abbe.models.functions.table import Table
from abbe.models.geometry.propagation import checked_covariance
from abbe.service.domain import run_file as formats
from abbe.service.errors import FileFormatError, nearest, short_repr
from abbe.service.runs.checks import check, read_json

NOT_GIVEN = "no uncertainty given in the errors file"


@dataclass(frozen=True, slots=True)
class KnownErrors:
    """Content of an errors file.

    ``covariance``: parameter names as in `ErrorMotions.parameter_names`, and the matrix; ``uncertainty``: one line about its scope, or why
    it is missing; ``not_observable``: as in the file; ``unused``: one line for each unknown key.
    """

    motions: ErrorMotions
    covariance: tuple[tuple[str, ...], F2] | None
    uncertainty: str
    not_observable: list[dict[str, Any]]
    unused: list[str]

    def warnings(self) -> list[str]:
        """Return one line for each unused key, and for each combination of parameters that the measurement could not observe."""
        return [*self.unused, *(f"not observable: {_combination(one)}" for one in self.not_observable)]


def read_errors(path: Path) -> KnownErrors:
    """Read and check an errors file.

    Raises
    ------
    FileFormatError
        The file has a mistake; the message names the file and the first wrong key.
    """
    if not path.exists():
        raise FileFormatError(f"{path}: no such file", "give a file with error functions (abbe-errors/1)")
    found = check(path, read_json(path), formats.ErrorsFile)
    functions = {}
    for key, one in found.motions.items():
        try:
            functions[key] = axis_function(one)
        except ValueError as err:
            raise FileFormatError(
                f"{path}: motions.{key}: {err}", "correct the function; docs/how-to/errors.md describes the kinds"
            ) from None
    motions = ErrorMotions(functions, {name: getattr(found.squareness_rad, name) for name in SQUARENESS})
    covariance, text = _covariance(path, None if found.covariance is None else _further(found.covariance), motions)
    return KnownErrors(motions, covariance, text, [_further(one) for one in found.not_observable], _unused(path, found))


def _further(part: BaseModel) -> dict[str, Any]:
    """Return the keys of ``part`` that the format does not define."""
    return part.model_extra or {}


def axis_function(one: formats.ErrorFunction) -> AxisFunction:
    """Build the function that one entry of ``motions`` describes.

    Raises
    ------
    ValueError
        The function is impossible: positions that do not increase, decreasing knots, no coefficient.
    """
    if isinstance(one, formats.PolynomialObject):
        return Polynomial(np.array(one.coefficients), one.origin_mm)
    if isinstance(one, formats.LegendreSeries):
        return Legendre(np.array(one.coefficients), one.stroke_mm)
    if isinstance(one, formats.Spline):
        return BSpline(np.array(one.knots_mm), np.array(one.coefficients), one.degree)
    return Table(np.array(one.position_mm), np.array(one.value), one.interpolation)


def _covariance(path: Path, given: Mapping[str, Any] | None, motions: ErrorMotions) -> tuple[tuple[tuple[str, ...], F2] | None, str]:
    if given is None:
        return None, NOT_GIVEN
    names = _names(path, given.get("parameters"))
    matrix = _matrix(path, given.get("matrix"), len(names))
    known = set(motions.parameter_names())
    unknown = [name for name in names if name not in known]
    if unknown:
        more = f" and {len(unknown) - 1} more" if len(unknown) > 1 else ""
        return (
            None,
            f"no uncertainty: the covariance of the errors file names {unknown[0]!r}{more}, which is not a parameter of its functions",
        )
    return (names, matrix), _covered(names, motions)


def _names(path: Path, names: Any) -> tuple[str, ...]:
    if not isinstance(names, list) or not names or not all(isinstance(name, str) for name in names):
        raise FileFormatError(f"{path}: covariance.parameters: expected a list of names, got {short_repr(names)}", 'e.g. ["C0Y", "EXX.1"]')
    twice = next((name for name, count in Counter(names).items() if count > 1), None)
    if twice is not None:
        raise FileFormatError(f"{path}: covariance.parameters: {twice!r} appears twice", "name each parameter once")
    return tuple(names)


def _matrix(path: Path, rows: Any, size: int) -> F2:
    location = f"{path}: covariance.matrix"
    if not isinstance(rows, list) or not rows or not all(isinstance(row, list) for row in rows):
        raise FileFormatError(f"{location}: expected rows of finite numbers, got {short_repr(rows)}")
    invalid = [value for row in rows for value in row if isinstance(value, bool) or not isinstance(value, int | float)]
    if invalid or any(len(row) != len(rows[0]) for row in rows):
        raise FileFormatError(f"{location}: expected rows of numbers, all equally long, got {short_repr(invalid[0] if invalid else rows)}")
    if (len(rows), len(rows[0])) != (size, size):
        raise FileFormatError(f"{location}: expected {size} x {size} numbers, got {len(rows)} rows of {len(rows[0])}")
    try:
        return checked_covariance(np.array(rows, dtype=np.float64), size, location)
    except ValueError as err:
        raise FileFormatError(str(err), "correct the matrix, or leave the covariance out") from None


def _covered(names: tuple[str, ...], motions: ErrorMotions) -> str:
    certain = [name for name, value in motions.squareness_rad.items() if value != 0.0 and name not in names]
    named = set(names)
    for key, function in motions.functions.items():
        left = [k for k in np.flatnonzero(function.parameters).tolist() if f"{key}.{k}" not in named]
        whole = not any(f"{key}.{k}" in named for k in range(function.parameters.size))
        certain += ([key] if left else []) if whole else _runs(key, left)
    text = f"u from the covariance of the errors file ({len(names)} parameters)"
    return text + (f"; not in this covariance, so taken as exact: {', '.join(certain)}" if certain else "")


def _runs(key: str, indices: list[int]) -> list[str]:
    """Return names of parameters as text: ``EXX.1``, or ``EXX.1 to EXX.50`` for consecutive ones."""
    ends: list[list[int]] = []
    for k in indices:
        if ends and k == ends[-1][-1] + 1:
            ends[-1] = [ends[-1][0], k]
        else:
            ends.append([k])
    return [" to ".join(f"{key}.{k}" for k in run) for run in ends]


def _unused(path: Path, found: formats.ErrorsFile) -> list[str]:
    """Return one line for each unknown key, except below ``not_observable``."""
    parts: list[tuple[str, BaseModel, Iterable[str]]] = [("", found, type(found).model_fields)]
    parts.append(("squareness_rad.", found.squareness_rad, SQUARENESS))
    parts += [(f"motions.{key}.", one, type(one).model_fields) for key, one in found.motions.items()]
    parts += [] if found.covariance is None else [("covariance.", found.covariance, ("parameters", "matrix"))]
    return [
        f"{path}: key '{place}{key}' is not used ({nearest(key, valid)})"
        for place, part, valid in parts
        for key in _further(part)
        if key not in valid
    ]


def _combination(one: Mapping[str, Any]) -> str:
    parts = one.get("combination")
    text = short_repr(parts)
    if isinstance(parts, dict) and parts and all(isinstance(factor, int | float) for factor in parts.values()):
        text = " + ".join(name if factor == 1 else f"{factor:g} {name}" for name, factor in parts.items()).replace("+ -", "- ")
    return f"{text} ({one['why']})" if one.get("why") else text
