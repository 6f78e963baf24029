"""What every test of a recipe has in common: fields with the limits that a file has to keep, and how the file names them.

A recipe is the same object whether a program makes it or a file holds it (`abbe.service.sequences.recipes.recipe_file`). The limits in the
annotations are those of a file; programs may go beyond, as tests do.
"""

from __future__ import annotations

from dataclasses import KW_ONLY, Field, dataclass, field, fields
from typing import Annotated, Any

from pydantic import AfterValidator, BeforeValidator, ConfigDict
from pydantic import Field as Limits

from abbe.models.machine import AXES


def one_of(*words: str) -> AfterValidator:
    """Only these words."""

    def check(word: str) -> str:
        if word not in words:
            raise ValueError(f"expected {', '.join(map(repr, words[:-1]))} or {words[-1]!r}, got {word!r}")
        return word

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
    """A field that no file sets: it follows from the tests around it, or belongs to a built-in campaign."""
    return field(default=default, metadata={IN_FILE: False})


@dataclass(frozen=True, slots=True)
class TestRecipe:
    """A test: what it is called, its set-up, and whether it identifies or is held out.

    ``mount`` and ``unmount`` are false where two tests in a row share one set-up: the second does not mount, the first leaves the bar or
    the mirror.
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
    """Fields of a recipe that a file sets, by their keys."""
    return {"setup" if f.name == "setup_id" else f.name: f for f in fields(kind) if f.metadata.get(IN_FILE, True)}


def file_table(recipe: TestRecipe) -> dict[str, Any]:
    """A recipe as it stands in a file: empty values are left out where that means the same."""
    found = {key: (getattr(recipe, f.name), f.default) for key, f in file_fields(type(recipe)).items()}
    kind = {"kind": found.pop("kind")[0]}
    shown = {key: value for key, (value, default) in found.items() if value or value != default}
    return kind | shown | ({"axis": AXES[shown["axis"]]} if "axis" in shown else {})
