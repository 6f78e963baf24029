"""A small campaign with a fault every 12 s of device time ends with the same solution, within its uncertainty, as the undisturbed one.

The full one (the planner's hour, speed 60, a fault every 20 s) is ``python -m tests.experiments.campaigns.disturbed``.
"""

from __future__ import annotations

import pytest

from abbe.service.sequences.recipes.recipe import Diagonal, Helix, Linear
from abbe.service.sequences.recipes.recipe_file import shared_setups
from abbe.service.sequences.steps import CampaignPlan
from tests.experiments.campaigns.disturbed import MACHINE, both, summary

SPEED, EVERY_S, SEED = 100.0, 12.0, 5


def campaign() -> CampaignPlan:
    """Helices with two bars on one cup, a line along each axis, a step diagonal: some minutes of machine time."""
    centre = (300.0, 250.0, 100.0)
    recipes = (
        *shared_setups(
            (
                Helix("helix", "B1", "identify", centre, 100.0, turns=3.0, chord_mm=3.0, feed_mm_min=6000.0, rate_hz=100),
                Helix("back", "B1", "identify", centre, 60.0, turns=3.0, chord_mm=3.0, feed_mm_min=6000.0, rate_hz=100, direction=-1),
            ),
            "test",
        ),
        *(Linear(f"line{axis}", f"L{axis}", "identify", axis, positions=5, at_share=(0.15, 0.15)) for axis in range(3)),
        Diagonal("diag", "D1", "identify", "ppp", 3, "XYZ"),
    )
    return CampaignPlan("small", tuple(r.plan(MACHINE) for r in recipes))


@pytest.mark.timeout(300)
async def test_the_solution_is_the_same(tmp_path, capsys):
    found, tally = await both(tmp_path, campaign(), speed=SPEED, every_s=EVERY_S, seed=SEED, say=lambda _: None)
    with capsys.disabled():
        print("\n" + summary(found, tally))  # noqa: T201
    assert sum(tally.faults.values()) >= 5
    assert len(found.in_u) > 20
    assert abs(found.worst[1]) <= 4.0
    assert found.within_2 >= 0.9
