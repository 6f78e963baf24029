"""A controller that can be read and does nothing any more: the way back ends, says so, and is gone when it listens again."""

from __future__ import annotations

import itertools
from typing import Any

import pytest

from tests.push.loading import real
from tests.push.world import Case, World

MOST = 300


class Deafening(World):
    """Goes deaf when the given question is asked."""

    def __init__(self, question: str, *words: Any) -> None:
        super().__init__(*words)
        self.question, self.ops = question, itertools.count()

    async def execute(self, op: Any, journal: Any) -> Any:
        assert next(self.ops) < MOST, "it does not come to an end"
        if op.kind.name == self.question:
            self.ctl.deaf = True
        return await super().execute(op, journal)


@pytest.mark.parametrize("question", ["PROBE", "VERIFY"])
@pytest.mark.parametrize("owner", ["ours", "nobody"])
def test_the_way_back_ends_pending_and_goes_on_when_it_listens(question: str, owner: str) -> None:
    case = Case("goes back", verify=False, machine_sign=-1 if question == "PROBE" else 1)
    world = Deafening(question, real(), case, {})
    ended = world.live(world.p.execute.push(world, world, world.order()))
    assert (str(ended.state), ended.settled) == ("ROLLBACK_PENDING", False)
    assert world.ctl.in_force == world.candidate
    if owner == "nobody":
        world.ctl.owner = 0
    world.ops = itertools.count()
    again = world.live(world.p.execute.recover(world, world))  # still deaf: it ends again
    assert str(again.state) == "ROLLBACK_PENDING"
    world.ctl.deaf, world.ops = False, itertools.count()
    assert str(world.live(world.p.execute.recover(world, world)).state) == "ROLLED_BACK"
    assert world.ctl.in_force == world.base


def test_a_table_that_was_exchanged_and_put_back_while_it_was_verified_is_not_kept() -> None:
    class Exchanged(World):
        def _verified(self) -> Any:
            answer = super()._verified()
            self.ctl.gen += 2
            return answer

    world = Exchanged(real(), Case("kept"), {})
    world.live(world.p.execute.push(world, world, world.order()))
    assert str(world.journal[-1].state) == "ROLLED_BACK"
    assert world.ctl.in_force == world.base
