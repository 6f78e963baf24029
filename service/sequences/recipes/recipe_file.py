"""Campaign recipes as TOML files: written by the planner or by hand, read by `abbe measure --recipe FILE.toml`.

Consecutive tests with the same ``setup`` share it: the first mounts, the last clears away, and a helix of another radius changes the bar at
the same cup.
"""

from __future__ import annotations

import json
import tomllib
from dataclasses import replace
from itertools import groupby, pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from abbe.service.domain.artefact import ArtefactObject
from abbe.service.errors import ConfigError, Mistake, and_more, location_text, mistakes, nearest
from abbe.service.sequences.recipes.approach import LOW_SHARE, Cup, TestRecipe, file_fields, file_table, pole_of
from abbe.service.sequences.recipes.artefact import ArtefactTest
from abbe.service.sequences.recipes.recipe import BarRecipe, Circle, Diagonal, FaceDiagonal, Helix, HelixPoints, Linear, Recipe


def shared_setups(recipes: tuple[Recipe, ...], source: str) -> tuple[Recipe, ...]:
    """Return the same recipes, mounting only where a set-up begins and clearing away only where it ends.

    Consecutive tests with the same ``setup_id`` share a set-up; ``source`` names the file in errors.

    Raises
    ------
    ConfigError
        Two tests have one label, a set-up is used again after its end, or two tests cannot share their set-up.
    """
    labels = [r.label for r in recipes]
    twice = sorted({label for label in labels if labels.count(label) > 1})
    if twice:
        raise ConfigError(f"{source}: two tests are labelled {twice[0]!r}", "give every test its own label")
    out: list[Recipe] = []
    setups: set[str] = set()
    for setup, members in groupby(recipes, key=lambda r: r.setup_id):
        group = list(members)
        if setup in setups:
            raise ConfigError(
                f"{source}: test {group[0].label!r} uses set-up {setup!r}, which was taken down before",
                "put its tests in a row, or name a new set-up",
            )
        setups.add(setup)
        for before, after in pairwise(group):
            _check_shared(before, after, source)
        out += [_mounting(group, k) for k in range(len(group))]
    return tuple(out)


def _check_shared(before: Recipe, after: Recipe, source: str) -> None:
    if isinstance(before, BarRecipe) and isinstance(after, BarRecipe):
        trouble = _on_one_cup(before, after)
    elif isinstance(before, Diagonal) and isinstance(after, Diagonal):
        trouble = "" if before.diagonal == after.diagonal else "another diagonal needs another alignment"
    elif isinstance(before, FaceDiagonal) and isinstance(after, FaceDiagonal):
        same = (before.plane, before.diagonal, before.at_share) == (after.plane, after.diagonal, after.at_share)
        trouble = "" if same else "another diagonal needs another alignment"
    elif isinstance(before, Linear) and isinstance(after, Linear):
        trouble = "" if (before.axis, before.at_share) == (after.axis, after.at_share) else "another line needs another alignment"
    else:
        trouble = "only ball-bar tests about one cup and laser tests on one line share a set-up"
    if trouble:
        raise ConfigError(
            f"{source}: tests {before.label!r} and {after.label!r} cannot share set-up {after.setup_id!r}: {trouble}",
            "correct the second test, or name a new set-up",
        )


def _on_one_cup(before: BarRecipe, after: BarRecipe) -> str:
    if before.centre_mm != after.centre_mm or (before.axis, before.opens) != (after.axis, after.opens):
        return "another centre or axis needs another cup"
    if before.radius_mm == after.radius_mm:
        return ""
    ends = ((before, before.path()[0][-1]), (after, after.path()[0][0]))
    if min(Cup(np.array(r.centre_mm), r.radius_mm, pole_of(r)[1]).lowest([p]) for r, p in ends) < -LOW_SHARE:
        return "the bar would be changed below the cup, and the machine would then move through the cup"
    return ""


def _mounting(group: list[Recipe], k: int) -> Recipe:
    recipe, before = group[k], group[k - 1] if k else None
    shared = replace(recipe, mount=before is None, unmount=k == len(group) - 1)
    if isinstance(shared, BarRecipe) and isinstance(before, BarRecipe):
        other = shared.radius_mm != before.radius_mm
        return replace(shared, change_bar=other, link_mm=before.path()[0][-1])
    return shared


FORMAT = "abbe-recipe/1"
KINDS: dict[str, type[TestRecipe]] = {
    "helix": Helix, "helix_points": HelixPoints, "circle": Circle, "diagonal": Diagonal, "face": FaceDiagonal, "line": Linear,
    "artefact": ArtefactTest,
}  # fmt: skip


def _consistent(recipe: Recipe) -> Recipe:
    if isinstance(recipe, Diagonal) and recipe.order and recipe.overrun_mm:
        raise ValueError("expected order or overrun_mm, not both: a step diagonal has no overrun")
    return recipe


AnyTest = Annotated[
    Helix | HelixPoints | Circle | Diagonal | FaceDiagonal | Linear | ArtefactTest, Field(discriminator="kind"), AfterValidator(_consistent)
]


class RecipeFile(BaseModel):
    """Content of a recipe file; ``test``: its tests in the order of measuring; ``artefact``: what is probed, by name."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True, defer_build=True)

    format: Literal["abbe-recipe/1"]
    name: Annotated[str, Field(min_length=1, max_length=120)]
    note: str = ""
    test: Annotated[list[AnyTest], Field(min_length=1)]
    artefact: dict[str, ArtefactObject] = Field(default_factory=dict)

    def recipes(self) -> tuple[Recipe, ...]:
        """Return the tests; each test of an artefact gets the description of its artefact."""
        return tuple(replace(t, plate=self.artefact.get(t.artefact)) if isinstance(t, ArtefactTest) else t for t in self.test)


def read_recipe(path: Path) -> tuple[str, tuple[Recipe, ...]]:
    """Return name and recipes of a campaign recipe file, in the order of measuring.

    Raises
    ------
    ConfigError
        A key is missing, unknown or wrong, or two tests cannot share a set-up.
    """
    return parse_recipe(recipe_source(path), str(path))


def recipe_source(path: Path) -> str:
    """Read the text of a campaign recipe file. Raises ConfigError if that fails."""
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise ConfigError(f"recipe file {path} does not exist", "`abbe plan -m MACHINE.toml --out FILE.toml` writes one") from None
    except OSError as error:
        raise ConfigError(f"recipe file {path} cannot be read: {error.strerror}", "give a readable TOML file") from None
    except UnicodeDecodeError:
        raise ConfigError(f"recipe file {path} is not UTF-8 text", "save it as UTF-8") from None


def parse_recipe(text: str, source: str) -> tuple[str, tuple[Recipe, ...]]:
    """Return name and recipes as `read_recipe`, from the file's text; ``source`` names the file in errors."""
    try:
        content = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError, ValueError) as error:
        raise ConfigError(f"{source}: not valid TOML: {' '.join(str(error).split())[:200]}", "correct this line") from None
    _check_keys(content, source)
    try:
        # Through JSON: strict mode then refuses text for a number, but takes a list for a tuple.
        found = RecipeFile.model_validate_json(json.dumps(content, default=str), strict=True)
    except ValidationError as error:
        raise _config_error(source, mistakes(error.errors())) from None
    return found.name, shared_setups(found.recipes(), source)


def _check_keys(content: dict[str, Any], source: str) -> None:
    """Refuse each test with a key that its kind of test does not have, and set the default role."""
    tests = content.get("test")
    for k, table in enumerate(tests if isinstance(tests, list) else []):
        kind = KINDS.get(str(table.get("kind"))) if isinstance(table, dict) else None
        keys = [] if kind is None else list(file_fields(kind))
        for key in table if keys else ():
            if key not in keys:
                raise ConfigError(f"{source}: unknown key {location_text(('test', k, key))!r}", nearest(key, keys))
        if isinstance(table, dict):
            table.setdefault("role", "identify")


def _config_error(source: str, errors: list[Mistake]) -> ConfigError:
    first, tail = errors[0], and_more(errors)
    place = tuple(p for p in first.place if p not in KINDS)
    if first.unknown_key:
        return ConfigError(f"{source}: unknown key {location_text(place)!r}{tail}", nearest(str(place[-1]), list(RecipeFile.model_fields)))
    if first.kind == "union_tag_not_found":
        return ConfigError(
            f"{source}: key {location_text((*place, 'kind'))!r} is missing{tail}", f"add kind = {' or '.join(map(repr, KINDS))}"
        )
    if first.kind == "missing":
        return ConfigError(f"{source}: key {location_text(place)!r} is missing{tail}", f"add {place[-1]} = ...")
    return ConfigError(
        f"{source}: {location_text(place)}: {first.expected}{tail}", "correct it; docs/reference/recipe-file.md has all keys"
    )


def recipe_text(name: str, recipes: tuple[Recipe, ...], note: str = "") -> str:
    """Return a campaign recipe as TOML text; `parse_recipe` restores the same recipes.

    Raises
    ------
    ConfigError
        A value is not valid in a file (a label with a slash, for instance).
    """
    lines = [f"format = {_toml(FORMAT)}", f"name = {_toml(name)}"]
    if note:
        lines.append(f"note = {_toml(note)}")
    for recipe in recipes:
        lines += ["", "[[test]]", *(f"{key} = {_toml(value)}" for key, value in file_table(recipe).items())]
    plates = {r.artefact: r.plate for r in recipes if isinstance(r, ArtefactTest) and r.plate is not None}
    for artefact, plate in plates.items():
        known = plate.model_dump(by_alias=True, exclude_none=True)
        lines += ["", f"[artefact.{_toml(artefact)}]", *(f"{key} = {_toml(value)}" for key, value in known.items())]
    text = "\n".join(lines) + "\n"
    parse_recipe(text, f"recipe {name!r}")
    return text


def _toml(value: Any) -> str:
    """Format a TOML value. Text, numbers and their lists are JSON, which is TOML except for the ASCII DEL; a list of tables has one
    table on each line."""
    if isinstance(value, BaseModel):
        value = value.model_dump(by_alias=True, exclude_none=True)
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {_toml(one)}" for key, one in value.items()) + " }"
    if isinstance(value, list | tuple) and value and isinstance(value[0], dict):
        return "[\n" + "".join(f"  {_toml(one)},\n" for one in value) + "]"
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
