"""Which tests of a campaign share a set-up: where a person mounts, changes the bar, and clears away."""

from __future__ import annotations

from dataclasses import replace
from itertools import groupby, pairwise

import numpy as np

from abbe.service.errors import ConfigError
from abbe.service.sequences.recipes.approach import LOW_SHARE, Cup, pole_of
from abbe.service.sequences.recipes.recipe import BarRecipe, Diagonal, FaceDiagonal, Linear, Recipe


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
    seen: set[str] = set()
    for setup, members in groupby(recipes, key=lambda r: r.setup_id):
        group = list(members)
        if setup in seen:
            raise ConfigError(
                f"{source}: test {group[0].label!r} uses set-up {setup!r}, which was taken down before",
                "put its tests in a row, or name a new set-up",
            )
        seen.add(setup)
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
        return "the bar is changed below the cup: from there the machine would move through it"
    return ""


def _mounting(group: list[Recipe], k: int) -> Recipe:
    recipe, before = group[k], group[k - 1] if k else None
    shared = replace(recipe, mount=before is None, unmount=k == len(group) - 1)
    if isinstance(shared, BarRecipe) and isinstance(before, BarRecipe):
        other = shared.radius_mm != before.radius_mm
        return replace(shared, change_bar=other, link_mm=before.path()[0][-1])
    return shared
