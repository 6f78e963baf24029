"""The recipe of the helix refuses what math.md 4.5 forbids: fewer than three turns."""

import numpy as np
import pytest

from abbe.models.machine import Machine
from abbe.service.errors import ConfigError
from abbe.service.sequences.recipes.recipe import Helix

MACHINE = Machine("w-b-X-Y-Z-t", np.array([[0.0, 600.0], [0.0, 500.0], [0.0, 450.0]]))


@pytest.mark.parametrize("turns", [0.0, 1.0, 2.0, 2.99, -5.0, float("nan"), float("inf")])
def test_fewer_than_three_turns_are_refused_before_anything_moves(turns):
    with pytest.raises(ConfigError, match="a helix needs 3 or more"):
        Helix("h", "A", "identify", (300.0, 250.0, 100.0), 150.0, turns=turns).plan(MACHINE)


def test_three_turns_are_planned():
    plan = Helix("h", "A", "identify", (300.0, 250.0, 100.0), 150.0, turns=3).plan(MACHINE)
    assert plan.bar.turns == 3
