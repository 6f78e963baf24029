"""Which tests of a campaign share what is mounted: where a person mounts, changes the bar, and clears away."""

from __future__ import annotations

from dataclasses import replace
from itertools import groupby, pairwise

from service.errors import ConfigError
from service.sequences.recipes import Diagonal, Helix, Recipe


def shared_setups(recipes: tuple[Recipe, ...], source: str) -> tuple[Recipe, ...]:
    """The same recipes, mounting only where a set-up begins and clearing away only where it ends.

    Tests in a row with the same ``setup_id`` share a set-up; ``source`` names the file in errors.

    Raises
    ------
    ConfigError
        Labels twice, a set-up taken down and used again, or two tests that cannot share what is mounted.
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
    trouble = ""
    if isinstance(before, Helix) and isinstance(after, Helix):
        if before.centre_mm != after.centre_mm or (before.axis, before.opens) != (after.axis, after.opens):
            trouble = "another centre or axis needs another cup"
        elif before.radius_mm == after.radius_mm and before.direction == after.direction:
            trouble = "with the same bar the second helix must run back (direction): the bar cannot follow a move through its sphere"
    elif isinstance(before, Diagonal) and isinstance(after, Diagonal):
        if before.diagonal != after.diagonal:
            trouble = "another diagonal needs another alignment"
    else:
        trouble = "only helices about one cup and step orders on one diagonal share a set-up"
    if trouble:
        raise ConfigError(
            f"{source}: tests {before.label!r} and {after.label!r} cannot share set-up {after.setup_id!r}: {trouble}",
            "correct the second test, or name a new set-up",
        )


def _mounting(group: list[Recipe], k: int) -> Recipe:
    recipe, before = group[k], group[k - 1] if k else None
    shared = replace(recipe, mount=before is None, unmount=k == len(group) - 1)
    if isinstance(shared, Helix) and isinstance(before, Helix):
        return replace(shared, change_bar=shared.radius_mm != before.radius_mm)
    return shared
