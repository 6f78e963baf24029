"""Two processes that push into one controller at the same time, judged by what the simulated controller saw.

A write to a bank names nobody. It is told by its content, which differs between the two in every chunk, and by who held the lease.
"""

from __future__ import annotations

import random
import re
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

from tests.push.bench import Bench, Zygote, image

DATABASES = {"one database": ("abbe", "abbe"), "two databases": ("first", "second")}
SPREAD_S = 0.35
"""About as long as a push takes: the later of the two begins somewhere in the other one's, in half of the races at the same moment."""
CHANGES = ("write", "seal", "activate")
FORTH = {"KEEP": 1, "ROLLED_BACK": 2}
"""Activations of a push that came into force: forth, or forth and back."""
NOTHING_WRITTEN = {None, "REJECTED", "ABORTED"}


class Access(NamedTuple):
    """As of the fixture's op `tables` (docs/protocols/fixture.md)."""

    time_s: float
    kind: str
    bank: int
    first: int
    words: list[int]
    by: int
    taken: bool
    owner: int
    active: int
    gen: int


@dataclass
class Racer:
    """One of the two: its process, what it pushes, what it said in the end."""

    bench: Bench
    height: int
    better: bool
    delay_s: float
    owner: int = 0
    said: dict[str, Any] = field(default_factory=dict)

    def begin(self) -> None:
        self.bench.begin("push", height=self.height, better=self.better, delay_s=self.delay_s)
        self.owner = self.bench.owner

    def end(self) -> None:
        answer = self.bench.answer()
        self.said = answer["said"] or {"state": "died", "why": f"status {answer['status']}"}

    @property
    def state(self) -> str | None:
        return self.said["state"]

    @property
    def line(self) -> str:
        """What a person reads who did not get through."""
        return str(self.said.get("refused") or self.said.get("why") or "")

    def wrote(self, access: Access) -> bool:
        data, at = b"".join(w.to_bytes(2, "big") for w in access.words), 2 * access.first
        return bytes.fromhex(image(self.height))[at : at + len(data)] == data

    def held(self, access: Access) -> bool:
        return access.owner >> 16 == self.owner


@dataclass
class Races:
    """What was counted. ``met``: races in which both were under way at once: changing the controller, or one stopped the other."""

    races: int = 0
    met: int = 0
    numbers_lost: int = 0
    writes: int = 0
    ends: Counter[str] = field(default_factory=Counter)
    lines: Counter[str] = field(default_factory=Counter)
    violations: list[str] = field(default_factory=list)

    def losers(self) -> Counter[str]:
        """What those read who came to nothing, without the numbers in it."""
        found: Counter[str] = Counter()
        for line, n in self.lines.items():
            found[re.sub(r"modbus\S+ |(?<=push )\d+", "", line)] += n
        return found

    def text(self) -> str:
        ends = ", ".join(f"{n} {state}" for state, n in sorted(self.ends.items()))
        return (
            f"{self.races} races, in {self.met} both were under way at once ({self.numbers_lost} commands came too late for their "
            f"number); {self.writes} writes to banks; {len(self.violations)} violations; ends: {ends}"
        )


def race(found: Races, two: tuple[Racer, Racer], accesses: Callable[[], list[Access]], base: str) -> str:
    """One race and its judgement; gives the table that is in force afterwards, in hex."""
    for racer in two:
        racer.begin()
    for racer in two:
        racer.end()
    log = accesses()
    found.races += 1
    found.ends.update(str(racer.state) for racer in two)
    found.numbers_lost += sum(a.kind == "stale" for a in log)
    found.writes += sum(a.kind == "write" for a in log)
    found.met += _met(two, log) or not all(racer.state in FORTH for racer in two)
    said = [*_interleaved(two, log), *_outcomes(two, log, base)]
    found.violations += [f"race {found.races} ({two[0].state}, {two[1].state}): {text}" for text in said]
    for racer in two:
        if racer.state != "KEEP":
            found.lines[f"{racer.state}: {racer.line}"] += 1
    kept = [r for r in two if r.state == "KEEP"]
    if len(kept) == 2:  # one after the other: the later one is in force
        kept.sort(key=lambda r: max(k for k, a in enumerate(log) if a.kind == "activate" and a.taken and r.held(a)))
    return image(kept[-1].height) if kept else base


def _met(two: tuple[Racer, Racer], log: list[Access]) -> bool:
    """Whether one asked for the lease, or for more, between the other's first and last access."""
    spans = [[k for k, a in enumerate(log) if a.by >> 16 == r.owner or (a.kind == "write" and r.wrote(a))] for r in two]
    return all(spans) and min(spans[0]) < max(spans[1]) and min(spans[1]) < max(spans[0])


def _interleaved(two: tuple[Racer, Racer], log: list[Access]) -> list[str]:
    """Whether changes of one stand among those of the other, or were done without the lease."""
    wrong, authors = [], []
    for access in log:
        if access.kind not in CHANGES:
            continue
        write = access.kind == "write"
        by = [r for r in two if (r.wrote(access) if write else access.by >> 16 == r.owner)]
        if len(by) != 1:
            wrong.append(f"a {access.kind} that is nobody's, or both's")
            continue
        if not by[0].held(access):
            wrong.append(f"{by[0].height}: {access.kind} without the lease{'' if access.taken else ' (refused)'}")
        if access.taken:
            authors.append(by[0].height)
    runs = [author for author, _ in groupby(authors)]
    return wrong + ([f"changes are interleaved: {runs}"] if len(runs) != len(set(runs)) else [])


def _outcomes(two: tuple[Racer, Racer], log: list[Access], base: str) -> list[str]:
    """Whether what each says of itself is what the controller saw."""
    wrong = []
    for racer in two:
        writes = [a for a in log if a.kind == "write" and racer.wrote(a)]
        acted = [a for a in log if a.kind == "activate" and a.taken and a.by >> 16 == racer.owner]
        name = f"{racer.height} ({racer.state}: {racer.line})"
        if racer.state in ("died", "OPERATOR", "ROLLBACK_PENDING") or not racer.said.get("settled"):
            wrong.append(f"{name}: did not come to an end")
        if racer.state in NOTHING_WRITTEN and acted:
            wrong.append(f"{name}: activated, and says that nothing was brought into force")
        if racer.state in NOTHING_WRITTEN and not racer.line:
            wrong.append(f"{name}: lost without a word")
        if racer.state in NOTHING_WRITTEN and writes:
            wrong.append(f"{name}: had the lease and wrote {len(writes)} chunks, and came to nothing")
        if racer.state in FORTH and (len(acted) != FORTH[racer.state] or racer.better != (racer.state == "KEEP")):
            wrong.append(f"{name}: {len(acted)} activations")
    if not any(r.state in FORTH for r in two):
        wrong.append("nobody got through: " + "; ".join(f"{r.state}: {r.line}" for r in two))
    return wrong


def races(
    cnc: str,
    ask: Callable[..., dict[str, Any]],
    folder: Path,
    databases: tuple[str, str],
    count: int,
    seed: int,
    *,
    zygotes: tuple[Zygote | None, Zygote | None] = (None, None),
) -> Races:
    """Let two processes race ``count`` times, with the journal in these databases: one service's, or of two that do not know each other."""
    benches = tuple(Bench(cnc, folder, database=name, number=k + 1, zygote=zygotes[k]) for k, name in enumerate(databases))
    try:
        return _races(benches, ask, count, seed)
    finally:
        for bench in benches:
            bench.close()


def _races(benches: tuple[Bench, ...], ask: Callable[..., dict[str, Any]], count: int, seed: int) -> Races:
    rng, found = random.Random(seed), Races()
    benches[0].do("push", height=99)
    seen, base = len(ask("tables")["accesses"]), image(99)

    def accesses() -> list[Access]:
        nonlocal seen
        new = [Access(*a) for a in ask("tables", since=seen)["accesses"]]
        seen += len(new)
        return new

    for number in range(count):
        late_s = 0.0 if number % 2 else rng.uniform(0.0, SPREAD_S)
        delays = (late_s, 0.0) if rng.random() < 0.5 else (0.0, late_s)
        one, other = (Racer(bench, 100 + 2 * number + k, rng.random() < 0.75, delays[k]) for k, bench in enumerate(benches))
        base = race(found, (one, other), accesses, base)
        in_force = benches[number % 2].do("recover")["said"]
        if in_force is None or in_force.get("active") != base or in_force["lease"]:
            found.violations.append(f"race {found.races}: afterwards the controller holds another table or a lease: {in_force}")
            base = in_force["active"] if in_force and "active" in in_force else base
    return found
