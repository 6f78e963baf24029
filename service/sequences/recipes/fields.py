"""Common fields of all recipe tests, with their limits and keys in a recipe file.

Programs and files (`abbe.service.sequences.recipes.recipe_file`) make the same recipe objects. The limits in the annotations apply to
files; programs may exceed them, as tests do.
"""

from __future__ import annotations

from dataclasses import KW_ONLY, Field, dataclass, field, fields
from typing import Annotated, Any

from pydantic import AfterValidator, BeforeValidator, ConfigDict
from pydantic import Field as Limits

from abbe.models.machine import AXES


def one_of(*choices: str) -> AfterValidator:
    """Validator that accepts only these values."""

    def check(value: str) -> str:
        if value not in choices:
            raise ValueError(f"expected {', '.join(map(repr, choices[:-1]))} or {choices[-1]!r}, got {value!r}")
        return value

    return AfterValidator(check)


def _axis(letter: object) -> int:
    if not isinstance(letter, str) or letter not in tuple(AXES):
        raise ValueError(f"expected 'X', 'Y' or 'Z', got {letter!r}")
    return AXES.index(letter)


def _rate(rate_hz: int) -> int:
    if 1000 % rate_hz:
        raise ValueError(f"expected a rate that divides 1000 Hz (1000, 500, 250, 200, 125, 100, 50 ...), got {rate_hz}")
    return rate_hz


Name = Annotated[str, Limits(min_length=1, max_length=80, pattern=r"^[^\s/\\](?:[^\n\r/\\]*[^\s/\\])?$")]
Feed = Annotated[float, Limits(gt=0.0, le=100_000.0)]
Coordinate = Annotated[float, Limits(ge=-1e5, le=1e5)]
Share = Annotated[float, Limits(ge=0.0, le=1.0)]
Settle = Annotated[float, Limits(ge=0.0, le=60.0)]
AxisIndex = Annotated[int, BeforeValidator(_axis)]
"""0, 1 or 2; in a file its letter."""
Rate = Annotated[int, Limits(ge=1, le=1000), AfterValidator(_rate)]
Flat = Annotated[str, one_of("XY", "YZ", "ZX")]
IN_FILE = "in_file"


def inner(default: Any) -> Any:
    """A field that no file sets: it follows from neighbouring tests, or belongs to a built-in campaign."""
    return field(default=default, metadata={IN_FILE: False})


@dataclass(frozen=True, slots=True)
class TestRecipe:
    """A test: its label, its set-up, and its role (identify or holdout).

    ``mount`` and ``unmount`` are false where consecutive tests share a set-up: the second does not mount, the first leaves the bar or the
    mirror.
    """

    __test__ = False  # not a pytest class
    __pydantic_config__ = ConfigDict(extra="forbid", allow_inf_nan=False)

    label: Name
    setup_id: Annotated[Name, Limits(alias="setup")]
    role: Annotated[str, one_of("identify", "holdout")]
    _: KW_ONLY
    mount: bool = inner(True)
    unmount: bool = inner(True)


def file_fields(kind: type[TestRecipe]) -> dict[str, Field[Any]]:
    """Fields of a recipe that a file sets, by key."""
    return {"setup" if f.name == "setup_id" else f.name: f for f in fields(kind) if f.metadata.get(IN_FILE, True)}


def file_table(recipe: TestRecipe) -> dict[str, Any]:
    """A recipe as a table of a file; omits empty values that equal the default."""
    found = {key: (getattr(recipe, f.name), f.default) for key, f in file_fields(type(recipe)).items()}
    kind = {"kind": found.pop("kind")[0]}
    shown = {key: value for key, (value, default) in found.items() if value or value != default}
    return kind | shown | ({"axis": AXES[shown["axis"]]} if "axis" in shown else {})
