"""Protections that the sweep of single faults cannot tell apart, because a second one stands behind them or two faults have to meet."""

from __future__ import annotations

import pytest

from tests.push import controller as c
from tests.push.loading import real
from tests.push.world import FOREIGN, Case, NoAnswer, World

KEPT, BACK = Case("kept"), Case("goes back", verify=False)
GOING_BACK = {"ROLLBACK", "RESTAGING", "ACTIVATING_BACK", "ROLLBACK_PENDING"}


def states(world: World) -> list[str]:
    return [str(entry.state) for entry in world.journal]


def issued(world: World, *kinds: str) -> list[str]:
    """State of the journal at every operation of these kinds."""
    return [str(event[3]) for event in world.events if event[0] == "issue" and event[1] in kinds]


class Noting(World):
    """Notes which operation of the plan each step of the protocol began at."""

    def __init__(self, case: Case, plan: dict[int, str]) -> None:
        super().__init__(real(), case, plan)
        self.began: list[tuple[str, str, int]] = []

    async def execute(self, op, journal):
        self.began.append((str(self.journal[-1].state) if self.journal else "", op.kind.name, self.n))
        return await super().execute(op, journal)


def place(case: Case, state: str, kind: str, plan: dict[int, str] | None = None) -> int:
    """Number of the first operation with which this step begins, in a run with the given faults."""
    world = Noting(case, dict(plan or {}))
    world.run()
    return next(n for was, what, n in world.began if (was, what) == (state, kind))


@pytest.mark.parametrize(("lease_ms", "end"), [(5000, "KEEP"), (4999, "ABORTED"), (1, "ABORTED")])
def test_a_lease_that_is_about_to_end_is_no_time_to_activate(lease_ms: int, end: str) -> None:
    world = World(real(), Case("lease", lease_ms=lease_ms, end=end), {})
    assert world.run() == []
    assert states(world)[-1] == end
    if end == "ABORTED":
        assert world.journal[-1].doc["why"] == "the lease is about to end"
        assert issued(world, "ACTIVATE") == []


@pytest.mark.parametrize(("still_s", "end"), [(1.0, "KEEP"), (0.99, "ABORTED"), (0.0, "ABORTED")])
def test_axes_that_have_only_just_come_to_rest_are_not_pushed_into(still_s: float, end: str) -> None:
    world = World(real(), Case("still", still_s=still_s, end=end), {})
    assert world.run() == []
    assert states(world)[-1] == end
    if end == "ABORTED":
        assert "not stood still long enough" in world.journal[-1].doc["why"]
        assert issued(world, "WRITE", "SEAL", "ACTIVATE") == []


def test_a_fence_whose_answer_is_lost_is_no_fence() -> None:
    """The release is lost and the activation is still on its way when the push is called aborted: by then it has to be shut out."""

    class Late(World):
        held = None

        def request(self, kind, do, garble=None):
            if self.n == asked:
                self.step(kind)
                self.held = do
                raise NoAnswer("timeout")
            return super().request(kind, do, garble)

        async def append(self, journal, state, doc):
            entry = await super().append(journal, state, doc)
            if str(state) == "ABORTED" and self.held is not None:
                self.held()
            return entry

    asked = place(KEPT, "ACTIVATING", "ACTIVATE") + 1  # its number is asked first
    fence = place(KEPT, "ACTIVATING", "RELEASE", {asked: "lost_request"}) + 1
    world = Late(real(), KEPT, {fence: "lost_request"})
    assert world.run() == []
    assert (states(world)[-1], world.ctl.in_force) == ("ABORTED", world.base)


@pytest.mark.parametrize("owner", [0, FOREIGN])
def test_without_its_lease_a_push_writes_nothing(owner: int) -> None:
    class Lost(World):
        async def append(self, journal, state, doc):
            entry = await super().append(journal, state, doc)
            if str(state) == "LEASED":
                self.ctl.owner = owner
            return entry

    world = Lost(real(), KEPT, {})
    assert world.run() == []
    assert states(world)[-1] == "ABORTED"
    assert world.journal[-1].doc["why"] == "the lease is lost"
    assert issued(world, "WRITE", "SEAL", "ACTIVATE") == []


def test_a_lease_that_another_took_while_it_was_staged_is_seen_before_the_activation_is_sent() -> None:
    class Taken(World):
        async def append(self, journal, state, doc):
            entry = await super().append(journal, state, doc)
            if str(state) == "STAGED":
                self.ctl.owner = FOREIGN
            return entry

    world = Taken(real(), KEPT, {})
    assert world.run() == []
    assert (states(world)[-1], world.journal[-1].doc["why"]) == ("ABORTED", "the lease is lost")
    assert issued(world, "ACTIVATE") == []


@pytest.mark.parametrize("fault", ["lost_request", "later_request"])
def test_a_table_that_is_not_active_is_not_on_probation(fault: str) -> None:
    """Its bank holds the right bytes all the same: they prove nothing while the other bank acts."""
    asked = place(KEPT, "ACTIVATING", "ACTIVATE") + 1
    world = World(real(), KEPT, {asked: fault})
    assert world.run() == []
    assert "PROBATION" not in states(world)
    assert world.ctl.in_force == world.base


def test_while_the_e_stop_is_pressed_the_way_back_sends_nothing() -> None:
    class Pressed(World):
        def _verified(self):
            self.ctl.estop = True
            return super()._verified()

    world = Pressed(real(), BACK, {})
    ended = world.live(world.p.execute.push(world, world, world.order()))
    assert (str(ended.state), ended.settled) == ("ROLLBACK_PENDING", False)
    assert world.journal[-1].doc["pending"] == "not safe now: the e-stop is pressed"
    entries = len(world.journal)
    for _ in range(3):  # the service asks every half minute, and each time it is another process that has no lease
        world.live(world.p.execute.recover(world, world))
    assert not GOING_BACK & set(issued(world, "LEASE", "RELEASE", "WRITE", "SEAL", "ACTIVATE"))
    assert len(world.journal) == entries
    world.ctl.estop = False
    assert str(world.live(world.p.execute.recover(world, world)).state) == "ROLLED_BACK"


@pytest.mark.parametrize("persons", [True, False])
def test_restoring_the_old_table_is_begun_again_over_our_own_words_and_never_over_a_persons(persons: bool) -> None:
    """The control lost the old table, we died while we restored it, and a person may have put a table of theirs into that bank."""
    lost = place(BACK, "PROBATION", "PROBE")
    died = place(BACK, "RESTAGING", "READ_CHUNK", {lost: "reboot_inactive"})
    world = World(real(), BACK, {lost: "reboot_inactive", died: "crash_before"})
    world.live(world.p.execute.push(world, world, world.order()))
    assert states(world)[-1] == "RESTAGING"
    world.plan, bank = {}, 1 - world.ctl.active
    if persons:
        theirs = bytearray(world.base)
        theirs[-1] ^= 4
        world.ctl.banks[bank] = bytes(theirs) + world.ctl.banks[bank][len(theirs) :]
        world.ctl.states[bank], world.ctl.crc[bank] = c.SEALED, c.zlib.crc32(world.ctl.content(bank))
        world.ctl.gen += 1
    before = world.ctl.content(bank)
    ended = world.live(world.p.execute.recover(world, world))
    assert str(ended.state) == ("OPERATOR" if persons else "ROLLED_BACK")
    assert world.ctl.banks[bank].startswith(before if persons else world.base)
