"""SIGKILL from outside at random instants of a push, and of the recovery after it, and what holds afterwards."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field

from tests.push.bench import FIRST, OTHER, Bench, image

LIMIT_S = 5.0
AT_REST = {None, "REJECTED", "ABORTED", "ROLLED_BACK", "KEEP", "OPERATOR"}
CALIBRATIONS = 3


@dataclass
class Kills:
    """What was counted. ``slowest_s``: longest time from the start of a process to the end of its recovery."""

    killed: int = 0
    killed_again: int = 0
    too_late: int = 0
    slowest_s: float = 0.0
    ends: Counter[str] = field(default_factory=Counter)
    violations: list[str] = field(default_factory=list)

    def text(self) -> str:
        ends = ", ".join(f"{n} {state}" for state, n in sorted(self.ends.items()))
        return (
            f"{self.killed} pushes killed, {self.killed_again} of their recoveries killed too, {self.too_late} had ended before; "
            f"{len(self.violations)} violations; slowest recovery {self.slowest_s:.2f} s; ends: {ends}"
        )


def kills(bench: Bench, count: int, seed: int, told: Callable[[str], None] = lambda text: None) -> Kills:
    """Kill ``count`` pushes, uniformly over their duration; each second one's recovery as well.

    Every other push is one that is kept, the rest are found worse and go back. A push that had ended before it was killed counts as none.
    """
    rng, found = random.Random(seed), Kills()
    bench.do("push", height=FIRST)
    base, height = image(FIRST), OTHER
    usual_s = max(bench.do("push", height=height, better=False)["took_s"] for _ in range(CALIBRATIONS))
    back_s: list[float] = []
    while found.killed < count and found.too_late < count:
        better = bool(found.killed % 2)
        died = bench.do("push", height=height, better=better, kill_s=rng.uniform(0.0, usual_s))
        if died["said"] is None:
            found.killed += 1
        else:
            found.too_late += 1
        if died["said"] is None and found.killed % 4 < 2:
            again = bench.do("recover", kill_s=rng.uniform(0.0, max(back_s, default=0.1)))
            found.killed_again += again["said"] is None
        base, took_s = _recovered(bench, found, base, image(height))
        back_s = [*back_s[-9:], took_s]
        height = OTHER if base == image(FIRST) else FIRST
        if found.killed % 25 == 0:
            told(found.text())
    return found


def _recovered(bench: Bench, found: Kills, base: str, candidate: str) -> tuple[str, float]:
    """Recover to the end and judge; gives what is in force then, and how long it took."""
    after = bench.do("recover")
    found.slowest_s = max(found.slowest_s, after["took_s"])
    said, name = after["said"], f"kill {found.killed}"
    if said is None:
        found.violations.append(f"{name}: the recovery died with status {after['status']}")
        return base, after["took_s"]
    state = said["state"]
    found.ends[str(state)] += 1
    kept = state == "KEEP" and said["active"] == candidate
    for wrong, text in (
        (after["took_s"] >= LIMIT_S, f"recovery took {after['took_s']:.1f} s"),
        ("refused" in said, str(said.get("refused"))),
        (not said["settled"] or state not in AT_REST, f"not settled: {state} {said['why']}"),
        (state != "OPERATOR" and said.get("active") not in (base, candidate), f"{state}: a table in force that nobody pushed"),
        (not kept and said.get("active") != base, f"{state}: an unverified table is in force"),
        (said.get("lease") != 0, f"{state}: the lease was left"),
    ):
        if wrong:
            found.violations.append(f"{name}: {text}")
    again = bench.do("recover")["said"]
    if (
        again is None
        or (again["state"], again["active"]) != (state, said["active"])
        or any(n.startswith("journal") for n in again["names"])
    ):
        found.violations.append(f"{name}: a second recovery did something")
    return str(said["active"]), after["took_s"]
