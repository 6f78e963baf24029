"""Pushes, crashes, hand edits, restarts and recoveries in any order, on one controller with one journal after the other: never a violation.

Every day 2000 steps, with ABBE_TEST_LONG=1 twice as many; the examples are the same in every run.
"""

from __future__ import annotations

import os
from typing import Any, ClassVar

from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, rule

from tests.push.loading import real
from tests.push.sweep import CASES
from tests.push.world import FAULTS, Case, World

LONG = os.environ.get("ABBE_TEST_LONG") == "1"
P = real()
ALL = sorted({fault for faults in FAULTS.values() for fault in faults})
PLANS = st.dictionaries(st.integers(0, 70), st.sampled_from(ALL), max_size=3)


class Pushing(RuleBasedStateMachine):
    """One world after the other; what a world left in its controller is where the next one begins."""

    steps: ClassVar[list[int]] = [0]

    @initialize()
    def begin(self) -> None:
        self.controller: Any = None

    @rule(plan=PLANS, case=st.sampled_from(CASES))
    def push(self, plan: dict[int, str], case: Case) -> None:
        world = World(P, case, plan)
        self.carry_over(world)
        assert world.run() == []
        self.controller = world.ctl
        self.steps[0] += 1

    @rule(what=st.sampled_from(("keep", "inactive", "factory")))
    def restart(self, what: str) -> None:
        if self.controller is not None:
            self.controller.reboot(what)
        self.steps[0] += 1

    @rule(active=st.booleans(), sealed=st.booleans())
    def hand_edit(self, active: bool, sealed: bool) -> None:
        if self.controller is not None:
            bank = self.controller.active if active else 1 - self.controller.active
            self.controller.hand_edit(bank, sealed=sealed)
        self.steps[0] += 1

    def carry_over(self, world: World) -> None:
        """What the last world left in the banks is what this one finds; its base is whatever is in force now."""
        old = self.controller
        if old is None or old.in_force == world.candidate:
            return  # the same table again would be no push
        new = world.ctl
        new.banks, new.states, new.crc, new.active = list(old.banks), list(old.states), list(old.crc), old.active
        new.gen, new.boot, new.ack = old.gen, old.boot, old.ack
        world.allowed.add(new.in_force)
        world.base = new.in_force


Test = Pushing.TestCase
Test.settings = settings(
    max_examples=125 if LONG else 60,
    stateful_step_count=50,
    deadline=None,
    suppress_health_check=list(HealthCheck),
)


def teardown_module() -> None:
    assert Pushing.steps[0] >= (5000 if LONG else 2000), Pushing.steps
