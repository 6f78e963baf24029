"""Campaign recipes as TOML files: written by the planner or by hand, read by `abbe measure --recipe FILE.toml`.

Tests in a row with the same ``setup`` share what was mounted: the first of them mounts, the last clears away, a helix of another radius has
the bar changed at the standing cup.
"""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError
from pydantic_core import ErrorDetails

from abbe.service.errors import ConfigError
from abbe.service.explain import expected, nearest, where
from abbe.service.sequences.recipes import bar_tables, laser_tables
from abbe.service.sequences.recipes.bar_tables import CircleTable, HelixPointsTable, HelixTable, bar_table
from abbe.service.sequences.recipes.laser_tables import DiagonalTable, FaceTable, LineTable, laser_table
from abbe.service.sequences.recipes.recipe import BarRecipe, Recipe
from abbe.service.sequences.recipes.recipe_tables import RecipeTable, TestTable
from abbe.service.sequences.recipes.setups import shared_setups

FORMAT = "abbe-recipe/1"
AnyTest = Annotated[
    HelixTable | HelixPointsTable | CircleTable | DiagonalTable | FaceTable | LineTable,
    Field(discriminator="kind"),
]
KINDS: dict[str, type[TestTable]] = bar_tables.KINDS | laser_tables.KINDS


class RecipeFile(RecipeTable):
    """A whole recipe file."""

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
        lines += ["", "[[test]]", *(f"{key} = {_toml(value)}" for key, value in _table(recipe).items())]
    text = "\n".join(lines) + "\n"
    parse_recipe(text, f"recipe {name!r}")
    return text


def _table(recipe: Recipe) -> dict[str, Any]:
    own = bar_table(recipe) if isinstance(recipe, BarRecipe) else laser_table(recipe)
    return {"kind": own["kind"], "label": recipe.label, "setup": recipe.setup_id, "role": recipe.role} | own


def _toml(value: Any) -> str:
    """A TOML value: JSON's way of writing text, numbers and lists of numbers is TOML's as well, but for the ASCII DEL."""
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
