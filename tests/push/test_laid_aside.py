"""A control that only lays a new table aside for its next start: it is made to forget it, for nobody could have verified it."""

from __future__ import annotations

import pytest

from tests.push.controller import STAGED
from tests.push.loading import real
from tests.push.world import Case, World

CASE = Case("laid aside", stages=True)


def activation(world: World) -> int:
    """Number of the operation that asks for the activation."""
    world.run()
    told = [n for n, kind in enumerate(world.kinds) if kind == "command"]
    return told[2]  # lease, seal, activate


def test_it_is_forgotten_and_the_old_table_acts_also_after_a_start() -> None:
    world = World(real(), CASE, {})
    assert world.run() == []
    assert str(world.journal[-1].state) == "ABORTED"
    assert "only after its next start" in world.journal[-1].doc["why"]
    assert STAGED not in world.ctl.states
    world.ctl.reboot("keep")
    assert world.ctl.in_force == world.base


@pytest.mark.parametrize("fault", ["crash_before", "crash_after", "lost_reply", "lost_request", "duplicate", "estop", "foreign_lease"])
@pytest.mark.parametrize("later", range(8))
def test_whatever_comes_between(fault: str, later: int) -> None:
    at = activation(World(real(), CASE, {}))
    world = World(real(), CASE, {at + later: fault})
    assert world.run() == []
    assert str(world.journal[-1].state) == "ABORTED"
    world.ctl.reboot("keep")
    assert world.ctl.in_force == world.base


def test_a_start_before_it_was_forgotten_takes_it_back_as_far_as_the_control_lets_it() -> None:
    at = activation(World(real(), CASE, {}))
    world = World(real(), CASE, {at + 1: "crash_before"})
    world.live(world.p.execute.push(world, world, world.order()))
    world.ctl.reboot("keep")
    assert world.ctl.in_force == world.candidate
    world.plan = {}
    ended = world.live(world.p.execute.recover(world, world))
    assert str(ended.state) == "ROLLBACK_PENDING"  # the old one is laid aside now
    world.ctl.reboot("keep")
    ended = world.live(world.p.execute.recover(world, world))
    assert (str(ended.state), world.ctl.in_force) == ("ROLLED_BACK", world.base)


def test_what_does_not_forget_is_a_persons_matter() -> None:
    world = World(real(), Case("laid aside for good", stages=True, forgets=False), {})
    world.live(world.p.execute.push(world, world, world.order()))
    assert str(world.journal[-1].state) == "OPERATOR"
    assert "does not discard" in world.journal[-1].doc["why"]


def test_what_somebody_else_has_laid_aside_is_left_alone() -> None:
    world = World(real(), Case("theirs"), {})
    world.ctl.banks[1] = world.candidate
    world.ctl.states[1], world.ctl.crc[1] = STAGED, 7
    world.live(world.p.execute.push(world, world, world.order()))
    assert str(world.journal[-1].state) == "ABORTED"
    assert not [event for event in world.events if event[0] == "write"]


def test_one_lost_write_is_no_reason_to_call_a_person() -> None:
    at = activation(World(real(), CASE, {}))
    plain = World(real(), CASE, {})
    plain.run()
    write = next(n for n, kind in enumerate(plain.kinds) if kind == "write" and n > at)
    world = World(real(), CASE, {write: "lost_request"})
    assert world.run() == []
    assert str(world.journal[-1].state) == "ABORTED"
    assert STAGED not in world.ctl.states
