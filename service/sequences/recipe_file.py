"""Campaign recipes as TOML files: written by the planner or by hand, read by `abbe measure --recipe FILE.toml`.

Tests in a row with the same ``setup`` share what was mounted: the first of them mounts, the last clears away, a helix of another radius has
the bar changed at the standing cup.
"""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator
from pydantic_core import ErrorDetails

from models.machine import AXES
from service.errors import ConfigError
from service.explain import expected, nearest, where
from service.sequences.recipes import RAPID_MM_MIN, Diagonal, Helix, Linear, Recipe
from service.sequences.setups import shared_setups

FORMAT = "abbe-recipe/1"
Name = Annotated[str, Field(min_length=1, max_length=80, pattern=r"^[^\s/\\](?:[^\n\r/\\]*[^\s/\\])?$")]
Feed = Annotated[float, Field(gt=0.0, le=100_000.0)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]
Role = Literal["identify", "holdout"]
Order = Literal["XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX"]


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True)


class HelixTable(_Table):
    """One ``[[test]]`` of kind helix."""

    kind: Literal["helix"]
    label: Name
    setup: Name
    role: Role = "identify"
    centre_mm: tuple[float, float, float]
    radius_mm: Annotated[float, Field(gt=0.0, le=2000.0)]
    turns: Annotated[float, Field(ge=3.0, le=50.0)] = 5.0
    law: Literal["area", "angle"] = "area"
    axis: Literal["X", "Y", "Z"] = "Z"
    opens: Literal[1, -1] = 1
    direction: Literal[1, -1] = 1
    feed_mm_min: Feed = 2000.0
    rate_hz: Annotated[int, Field(ge=1, le=1000)] = 100
    length_calibrated: bool = True
    u_length_mm: Annotated[float, Field(ge=0.0, le=1.0)] = 0.002

    @field_validator("rate_hz")
    @classmethod
    def _divides(cls, rate_hz: int) -> int:
        if 1000 % rate_hz:
            raise ValueError(f"expected a rate that divides 1000 Hz (1000, 500, 250, 200, 125, 100, 50 ...), got {rate_hz}")
        return rate_hz

    def recipe(self) -> Recipe:
        """The recipe, mounting and clearing away by itself."""
        return Helix(
            self.label,
            self.setup,
            self.role,
            self.centre_mm,
            self.radius_mm,
            turns=self.turns,
            law=self.law,
            axis=AXES.index(self.axis),
            feed_mm_min=self.feed_mm_min,
            direction=self.direction,
            rate_hz=self.rate_hz,
            opens=self.opens,
            length_calibrated=self.length_calibrated,
            u_length_mm=self.u_length_mm,
        )


class DiagonalTable(_Table):
    """One ``[[test]]`` of kind diagonal; without ``order`` the diagonal is run straight."""

    kind: Literal["diagonal"]
    label: Name
    setup: Name
    role: Role = "identify"
    diagonal: Literal["ppp", "npp", "pnp", "ppn"]
    order: Order | None = None
    steps: Annotated[int, Field(ge=1, le=500)] = 12
    feed_mm_min: Feed = RAPID_MM_MIN
    settle_s: Annotated[float, Field(ge=0.0, le=60.0)] = 0.3

    def recipe(self) -> Recipe:
        """The recipe, mounting and clearing away by itself."""
        return Diagonal(
            self.label,
            self.setup,
            self.role,
            self.diagonal,
            self.steps,
            self.order or "",
            feed_mm_min=self.feed_mm_min,
            settle_s=self.settle_s,
        )


class LineTable(_Table):
    """One ``[[test]]`` of kind line; ``at_share``: places of the two other axes in their strokes, 0 to 1, in the order X, Y, Z."""

    kind: Literal["line"]
    label: Name
    setup: Name
    role: Role = "identify"
    axis: Literal["X", "Y", "Z"]
    at_share: tuple[Share, Share]
    positions: Annotated[int, Field(ge=5, le=1000)] = 25
    feed_mm_min: Feed = RAPID_MM_MIN
    settle_s: Annotated[float, Field(ge=0.0, le=60.0)] = 0.3

    def recipe(self) -> Recipe:
        """The recipe, mounting and clearing away by itself."""
        return Linear(
            self.label,
            self.setup,
            self.role,
            AXES.index(self.axis),
            n=self.positions,
            at=self.at_share,
            feed_mm_min=self.feed_mm_min,
            settle_s=self.settle_s,
        )


TestTable = Annotated[HelixTable | DiagonalTable | LineTable, Field(discriminator="kind")]
KINDS: dict[str, type[_Table]] = {"helix": HelixTable, "diagonal": DiagonalTable, "line": LineTable}


class RecipeFile(_Table):
    """A whole recipe file."""

    format: Literal["abbe-recipe/1"]
    name: Annotated[str, Field(min_length=1, max_length=120)]
    note: str = ""
    test: Annotated[list[TestTable], Field(min_length=1)]


def read_recipe(path: Path) -> tuple[str, tuple[Recipe, ...]]:
    """Name and recipes of a campaign recipe file, in the order of measuring.

    Raises
    ------
    ConfigError
        File, key, what was expected; or which test cannot share its set-up with the one before.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise ConfigError(f"recipe file {path} does not exist", "`abbe plan MACHINE.toml --out FILE.toml` writes one") from None
    except OSError as error:
        raise ConfigError(f"recipe file {path} cannot be read: {error.strerror}", "give a readable TOML file") from None
    except UnicodeDecodeError:
        raise ConfigError(f"recipe file {path} is not UTF-8 text", "save it as UTF-8") from None
    return parse_recipe(text, str(path))


def parse_recipe(text: str, source: str) -> tuple[str, tuple[Recipe, ...]]:
    """The same from the file's text; ``source`` names it in errors."""
    try:
        content = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError, ValueError) as error:
        raise ConfigError(f"{source}: not valid TOML: {' '.join(str(error).split())[:200]}", "correct this line") from None
    try:
        # By way of JSON: there strict means that text is no number, while a list still is a tuple.
        found = RecipeFile.model_validate_json(json.dumps(content, default=str), strict=True)
    except ValidationError as error:
        raise _config_error(source, error.errors()) from None
    return found.name, shared_setups(tuple(t.recipe() for t in found.test), source)


def _config_error(source: str, errors: list[ErrorDetails]) -> ConfigError:
    first, more = min(errors, key=lambda one: one["type"] != "extra_forbidden"), len(errors) - 1
    tail = f" (and {more} more)" if more else ""
    place = tuple(p for p in first["loc"] if p not in KINDS)
    if first["type"] == "extra_forbidden":
        valid = KINDS[str(first["loc"][2])] if len(first["loc"]) > 3 else RecipeFile
        return ConfigError(f"{source}: unknown key {where(place)!r}{tail}", nearest(str(place[-1]), list(valid.model_fields)))
    if first["type"] == "union_tag_not_found":
        return ConfigError(f"{source}: key {where((*place, 'kind'))!r} is missing{tail}", f"add kind = {' or '.join(map(repr, KINDS))}")
    if first["type"] == "missing":
        return ConfigError(f"{source}: key {where(place)!r} is missing{tail}", f"add {place[-1]} = ...")
    return ConfigError(f"{source}: {where(place)}: {expected(first)}{tail}", "correct it; docs/how-to/plan.md describes every key")


def recipe_text(name: str, recipes: tuple[Recipe, ...], note: str = "") -> str:
    """A campaign recipe as TOML text; `parse_recipe` gives the same recipes back.

    Raises
    ------
    ConfigError
        A recipe says something that a file cannot hold (a label with a slash, say).
    """
    lines = [f"format = {_toml(FORMAT)}", f"name = {_toml(name)}"]
    if note:
        lines.append(f"note = {_toml(note)}")
    for recipe in recipes:
        lines += ["", "[[test]]", *(f"{key} = {_toml(value)}" for key, value in _table(recipe).items())]
    text = "\n".join(lines) + "\n"
    parse_recipe(text, f"recipe {name!r}")
    return text


def _table(recipe: Recipe) -> dict[str, Any]:
    common: dict[str, Any] = {"label": recipe.label, "setup": recipe.setup_id, "role": recipe.role}
    if isinstance(recipe, Helix):
        own = {"centre_mm": list(recipe.centre_mm), "radius_mm": recipe.radius_mm, "turns": recipe.turns, "law": recipe.law}
        own |= {"axis": AXES[recipe.axis], "direction": recipe.direction, "feed_mm_min": recipe.feed_mm_min, "rate_hz": recipe.rate_hz}
        own |= {"opens": recipe.opens, "length_calibrated": recipe.length_calibrated, "u_length_mm": recipe.u_length_mm}
        return {"kind": "helix", **common, **own}
    laser = {"feed_mm_min": recipe.feed_mm_min, "settle_s": recipe.settle_s}
    if isinstance(recipe, Diagonal):
        order = {"order": recipe.order} if recipe.order else {}
        return {"kind": "diagonal", **common, "diagonal": recipe.diagonal, **order, "steps": recipe.steps, **laser}
    at = [recipe.at] * 2 if isinstance(recipe.at, float) else list(recipe.at)
    return {"kind": "line", **common, "axis": AXES[recipe.axis], "at_share": at, "positions": recipe.n, **laser}


def _toml(value: Any) -> str:
    """A TOML value: JSON's way of writing text, numbers and lists of numbers is TOML's as well, but for the ASCII DEL."""
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
