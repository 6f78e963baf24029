"""Every single and every double fault, enumerated: plans for `World`, and the count of what did not hold."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from types import SimpleNamespace

from tests.push.one_bank import OneBankWorld
from tests.push.world import FAULTS, Case, World

CASES = (
    Case("kept"),
    Case("goes back", verify=False, end="ROLLED_BACK"),
    Case("bank 1", base_bank=1),
    Case("attended, no compare-and-swap needed", level=2, attended=True),
    Case("wrong sign on the machine", machine_sign=-1, end="ROLLED_BACK"),
    Case("rejected", reasons=("too large",), end="REJECTED"),
    Case("not approved", approved="no", end="REJECTED"),
    Case("another table approved", approved="another table", end="REJECTED"),
    Case("another base approved", approved="another base", end="REJECTED"),
    Case("approval ends early", approval_s=0.1, end="ABORTED"),
    Case("lease about to end", lease_ms=4999, end="ABORTED"),
    Case("axes just come to rest", still_s=0.99, end="ABORTED"),
    Case("unattended at level 2", level=2, end="REJECTED"),
)
PAIRED = CASES[:2]
"""Cases whose double faults are swept: the whole way forward, and forward and back."""

Plan = dict[int, str]


@dataclass
class Count:
    """What a sweep found."""

    combinations: int = 0
    violated: Counter[str] = field(default_factory=Counter)
    ends: Counter[str] = field(default_factory=Counter)
    examples: list[str] = field(default_factory=list)

    def add(self, case: Case, plan: Plan, world: World, violations: list[str]) -> None:
        self.combinations += 1
        self.ends[str(world.journal[-1].state) if world.journal else "nothing begun"] += 1
        self.violated.update(violations)
        if violations and len(self.examples) < 20:
            self.examples.append(f"{case.name}: {plan} violates {' '.join(violations)}")

    def merge(self, other: Count) -> None:
        self.combinations += other.combinations
        self.violated += other.violated
        self.ends += other.ends
        self.examples = (self.examples + other.examples)[:20]


def faults_of(kinds: list[str], first: int) -> Iterator[tuple[int, str]]:
    """Every fault that fits an operation, from the given operation on."""
    for n in range(first, len(kinds)):
        for fault in FAULTS[kinds[n]]:
            yield n, fault


def world_of(protocol: SimpleNamespace, case: Case, plan: Plan) -> World:
    """The world of a case: one with one table at level 1, else one with two banks."""
    return OneBankWorld(protocol, case, plan) if case.level == 1 else World(protocol, case, plan)


_KINDS: dict[tuple[str, Case, tuple[tuple[int, str], ...]], list[str]] = {}
"""Kinds of all operations of the runs with one fault at most, by protocol, case and fault: every run of a plan is the same."""


def run(protocol: SimpleNamespace, case: Case, plan: Plan, count: Count) -> World:
    world = world_of(protocol, case, plan)
    count.add(case, plan, world, [*world.run(), *_expected(case, plan, world)])
    if len(plan) < 2:
        _KINDS[_key(protocol, case, plan)] = world.kinds[: world.n_before_judging]
    return world


def _key(protocol: SimpleNamespace, case: Case, plan: Plan) -> tuple[str, Case, tuple[tuple[int, str], ...]]:
    return str(protocol.execute.__name__), case, tuple(plan.items())


def _kinds(protocol: SimpleNamespace, case: Case, plan: Plan) -> list[str]:
    """`World.kinds_of_run`, known from the sweep over single faults if it has gone before."""
    return _KINDS.get(_key(protocol, case, plan)) or world_of(protocol, case, plan).kinds_of_run()


def _expected(case: Case, plan: Plan, world: World) -> list[str]:
    """Without a fault it ends as it should; one bit that flips on the way is written or read again, and changes nothing."""
    harmless = all(fault.startswith("flip") for fault in plan.values()) and len(plan) < 2
    # The one table of a control has no generation that tells our own spoilt word from a person's: nobody overwrites it.
    ends = {case.end, "OPERATOR"} if case.level == 1 and "flip_write" in plan.values() else {case.end}
    return ["END"] if harmless and (not world.journal or str(world.journal[-1].state) not in ends) else []


def singles(protocol: SimpleNamespace, cases: tuple[Case, ...] = CASES, *, until: frozenset[str] = frozenset()) -> Count:
    """No fault, and every single one; ``until`` all of these are violated, if any are given."""
    count = Count()
    for case in cases:
        kinds = run(protocol, case, {}, count).kinds
        for n, fault in faults_of(kinds, 0):
            run(protocol, case, {n: fault}, count)
            if until and until <= count.violated.keys():
                return count
    return count


def doubles(
    protocol: SimpleNamespace,
    case: Case,
    *,
    every: int = 1,
    part: tuple[int, int] = (0, 1),
    progress: Callable[[int, Count], None] = lambda done, count: None,
) -> Count:
    """Every second fault after every first one, also in the recovery that the first one made necessary.

    ``every`` k: each k-th pair. ``part`` (a, b): only first faults a, a + b, ... to share the work.
    """
    count, pair = Count(), 0
    kinds = _kinds(protocol, case, {})
    for number, (n, fault) in enumerate(faults_of(kinds, 0)):
        if number % part[1] != part[0]:
            continue
        seconds = _kinds(protocol, case, {n: fault})
        for m, second in faults_of(seconds, n + 1):
            pair += 1
            if pair % every == 0:
                run(protocol, case, {n: fault, m: second}, count)
        progress(number, count)
    return count


def first_violation(protocol: SimpleNamespace, cases: tuple[Case, ...] = CASES) -> str:
    """The first thing that a sweep over single faults of all cases finds; empty if it finds nothing. Coarse first, then in full."""
    for case in cases:
        found = _look(protocol, case, 0, 9)
        if found:
            return found
    return next((found for rest in range(1, 9) for case in cases if (found := _look(protocol, case, rest, 9))), "")


def _look(protocol: SimpleNamespace, case: Case, rest: int, step: int) -> str:
    count = Count()
    plans: list[Plan] = [{}] if rest == 0 else []
    kinds = world_of(protocol, case, {}).kinds_of_run()
    plans += [{n: fault} for k, (n, fault) in enumerate(faults_of(kinds, 0)) if k % step == rest]
    for plan in plans:
        run(protocol, case, plan, count)
        if count.violated:
            return " ".join(count.violated)
    return ""
