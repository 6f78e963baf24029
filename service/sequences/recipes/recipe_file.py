"""Campaign recipes as TOML files: written by the planner or by hand, read by `abbe measure --recipe FILE.toml`.

Tests in a row with the same ``setup`` share what was mounted: the first of them mounts, the last clears away, a helix of another radius has
the bar changed at the standing cup.
"""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError
from pydantic_core import ErrorDetails

from abbe.service.errors import ConfigError
from abbe.service.explain import expected, nearest, where
from abbe.service.sequences.recipes.fields import TestRecipe, file_fields, file_table
from abbe.service.sequences.recipes.recipe import Circle, Diagonal, FaceDiagonal, Helix, HelixPoints, Linear, Recipe
from abbe.service.sequences.recipes.setups import shared_setups

FORMAT = "abbe-recipe/1"
KINDS: dict[str, type[TestRecipe]] = {
    "helix": Helix, "helix_points": HelixPoints, "circle": Circle, "diagonal": Diagonal, "face": FaceDiagonal, "line": Linear,
}  # fmt: skip


def _consistent(recipe: Recipe) -> Recipe:
    if isinstance(recipe, Diagonal) and recipe.order and recipe.overrun_mm:
        raise ValueError("expected no overrun_mm beside order: a step diagonal turns where it stands")
    return recipe


AnyTest = Annotated[
    Helix | HelixPoints | Circle | Diagonal | FaceDiagonal | Linear, Field(discriminator="kind"), AfterValidator(_consistent)
]


class RecipeFile(BaseModel):
    """A whole recipe file."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True)

    format: Literal["abbe-recipe/1"]
    name: Annotated[str, Field(min_length=1, max_length=120)]
    note: str = ""
    test: Annotated[list[AnyTest], Field(min_length=1)]


def read_recipe(path: Path) -> tuple[str, tuple[Recipe, ...]]:
    """Name and recipes of a campaign recipe file, in the order of measuring.

    Raises
    ------
    ConfigError
        File, key, what was expected; or which test cannot share its set-up with the one before.
    """
    return parse_recipe(recipe_source(path), str(path))


def recipe_source(path: Path) -> str:
    """The text of a campaign recipe file.

    Raises
    ------
    ConfigError
        It is not there or cannot be read.
    """
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise ConfigError(f"recipe file {path} does not exist", "`abbe plan MACHINE.toml --out FILE.toml` writes one") from None
    except OSError as error:
        raise ConfigError(f"recipe file {path} cannot be read: {error.strerror}", "give a readable TOML file") from None
    except UnicodeDecodeError:
        raise ConfigError(f"recipe file {path} is not UTF-8 text", "save it as UTF-8") from None


def parse_recipe(text: str, source: str) -> tuple[str, tuple[Recipe, ...]]:
    """The same from the file's text; ``source`` names it in errors."""
    try:
        content = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError, ValueError) as error:
        raise ConfigError(f"{source}: not valid TOML: {' '.join(str(error).split())[:200]}", "correct this line") from None
    _check_keys(content, source)
    try:
        # By way of JSON: there strict means that text is no number, while a list still is a tuple.
        found = RecipeFile.model_validate_json(json.dumps(content, default=str), strict=True)
    except ValidationError as error:
        raise _config_error(source, error.errors()) from None
    return found.name, shared_setups(tuple(found.test), source)


def _check_keys(content: dict[str, Any], source: str) -> None:
    """Refuse a key that no test of its kind has: the recipes have fields which are none of a file's. A test without a role identifies."""
    tests = content.get("test")
    for k, table in enumerate(tests if isinstance(tests, list) else []):
        kind = KINDS.get(str(table.get("kind"))) if isinstance(table, dict) else None
        keys = [] if kind is None else list(file_fields(kind))
        for key in table if keys else ():
            if key not in keys:
                raise ConfigError(f"{source}: unknown key {where(('test', k, key))!r}", nearest(key, keys))
        if isinstance(table, dict):
            table.setdefault("role", "identify")


def _config_error(source: str, errors: list[ErrorDetails]) -> ConfigError:
    first, more = min(errors, key=lambda one: one["type"] != "extra_forbidden"), len(errors) - 1
    tail = f" (and {more} more)" if more else ""
    place = tuple(p for p in first["loc"] if p not in KINDS)
    if first["type"] == "extra_forbidden":
        return ConfigError(f"{source}: unknown key {where(place)!r}{tail}", nearest(str(place[-1]), list(RecipeFile.model_fields)))
    if first["type"] == "union_tag_not_found":
        return ConfigError(f"{source}: key {where((*place, 'kind'))!r} is missing{tail}", f"add kind = {' or '.join(map(repr, KINDS))}")
    if first["type"] == "missing":
        return ConfigError(f"{source}: key {where(place)!r} is missing{tail}", f"add {place[-1]} = ...")
    return ConfigError(f"{source}: {where(place)}: {expected(first)}{tail}", "correct it; docs/reference/recipe-file.md has all keys")


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
        lines += ["", "[[test]]", *(f"{key} = {_toml(value)}" for key, value in file_table(recipe).items())]
    text = "\n".join(lines) + "\n"
    parse_recipe(text, f"recipe {name!r}")
    return text


def _toml(value: Any) -> str:
    """A TOML value: JSON's way of writing text, numbers and lists of numbers is TOML's as well, but for the ASCII DEL."""
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
