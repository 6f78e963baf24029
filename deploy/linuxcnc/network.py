"""The compensation network, made of the control's standard real-time components: its names, HAL text and parameters.

Each of the two banks has its own network, and one bit (``abbe-bank``) selects the active one. So a new table is written and read back
while the old one is active, and then takes over within one servo period. Per bank and corrected axis ``i``::

    correction_i = sum over a of F_ai(q_a) + sum over pairs a != k, k != i of G_aki(q_a) q_k

F are shifts (positioning, straightness, squareness) in mm; G are angles, in mm per mm, which the lever arm q_k multiplies. A machine that
consists of rigid carriages needs no other terms. Every F and G is one ``lincurve`` of at most 16 points: linear between them, constant
beyond the ends.

Run as a program, this file prints ``volumetric.hal``.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise

AXES = "xyz"
POINTS = 16
RAMP_MM_S = 5.0  # how fast the acting correction may change when the bank is switched
SHIFTS = tuple((a, i) for a in AXES for i in AXES)
LEVERS = tuple((a, k, i) for i in AXES for a in AXES for k in AXES if k not in (a, i))
_PAD_MM = 1.0

Vertices = tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class Network:
    """Content of the network of one bank.

    Attributes
    ----------
    shifts : dict
        (a, i) -> vertices (position of a in mm, mm added to the command of i). Missing: zero.
    levers : dict
        (a, k, i) -> vertices (position of a in mm, mm added to i per mm of k). Missing: zero.
    ends_mm : dict
        Axis -> (low, high): a position beyond an end counts as this end.
    """

    shifts: dict[tuple[str, str], Vertices] = field(default_factory=dict)
    levers: dict[tuple[str, str, str], Vertices] = field(default_factory=dict)
    ends_mm: dict[str, tuple[float, float]] = field(default_factory=dict)


def parameters(bank: int, network: Network) -> Iterator[tuple[str, float]]:
    """Return every HAL item of a bank's network with its value.

    Raises
    ------
    ValueError
        A curve has more points than the component allows, or its positions do not rise.
    """
    for axis in AXES:
        low, high = network.ends_mm.get(axis, (-1e6, 1e6))
        yield f"abbe{bank}-{axis}.min", low
        yield f"abbe{bank}-{axis}.max", high
    for key in SHIFTS:
        yield from _curve(f"abbe{bank}-f{''.join(key)}", network.shifts.get(key, ((0.0, 0.0),)))
    for lever in LEVERS:
        yield from _curve(f"abbe{bank}-g{''.join(lever)}", network.levers.get(lever, ((0.0, 0.0),)))


def _curve(name: str, vertices: Vertices) -> Iterator[tuple[str, float]]:
    if not 1 <= len(vertices) <= POINTS:
        raise ValueError(f"{name}: {len(vertices)} points, the component has {POINTS}")
    if any(b[0] <= a[0] for a, b in pairwise(vertices)):
        raise ValueError(f"{name}: the positions do not rise")
    last_mm, held = vertices[-1]
    padded = [*vertices, *((last_mm + _PAD_MM * n, held) for n in range(1, POINTS - len(vertices) + 1))]
    for number, (position_mm, value) in enumerate(padded):
        yield f"{name}.x-val-{number:02d}", position_mm
        yield f"{name}.y-val-{number:02d}", value


def hal_text() -> str:
    """Return the network as a HAL file. Its inputs are the joint commands, its outputs ``drive-x..z``; the drives' feedback goes to
    ``abbe-fb-x..z.in0``."""
    banks = [_Bank(bank) for bank in (0, 1)]
    lines = [
        "# Written by network.py: do not edit, run it again. Two networks of correction curves, one per bank, and the switch between them.",
        _load("limit1", [n for b in banks for n in b.limits]),
        _load("lincurve", [n for b in banks for n in b.curves], personality=POINTS),
        _load("mult2", [n for b in banks for n in b.products]),
        _load("sum2", [*(n for b in banks for n in b.sums), *(f"abbe-{d}-{a}" for d in ("out", "fb") for a in AXES)]),
        _load("mux2", [f"abbe-mux-{a}" for a in AXES]),
        _load("limit2", [f"abbe-ramp-{a}" for a in AXES]),
        *(f"net abbe-cmd-{a} joint.{n}.pos-cmd => " + " ".join(f"abbe{b}-{a}.in" for b in (0, 1)) for n, a in enumerate(AXES)),
        *(line for b in banks for line in b.nets()),
        "net abbe-bank => " + " ".join(f"abbe-mux-{a}.sel" for a in AXES),
    ]
    for n, a in enumerate(AXES):
        lines += [
            f"net abbe-want-{a} abbe-mux-{a}.out => abbe-ramp-{a}.in",
            f"setp abbe-ramp-{a}.maxv {RAMP_MM_S:g}",
            f"net abbe-corr-{a} abbe-ramp-{a}.out => abbe-out-{a}.in1 abbe-fb-{a}.in1",
            f"net abbe-motor-{a} joint.{n}.motor-pos-cmd => abbe-out-{a}.in0",
            f"net drive-{a} <= abbe-out-{a}.out",
            f"setp abbe-fb-{a}.gain1 -1",
            f"net abbe-motor-fb-{a} abbe-fb-{a}.out => joint.{n}.motor-pos-fb",
        ]
    order = [*(f"abbe-fb-{a}" for a in AXES), "motion-command-handler", "motion-controller"]
    order += [n for b in banks for n in (*b.limits, *b.curves, *b.products, *b.sums)]
    order += [f"abbe-{what}-{a}" for what in ("mux", "ramp", "out") for a in AXES]
    return "\n".join([*lines, *(f"addf {name} servo-thread" for name in order)]) + "\n"


class _Bank:
    def __init__(self, bank: int) -> None:
        self.prefix = f"abbe{bank}-"
        self.bank = bank
        self.limits = [self.prefix + a for a in AXES]
        self.curves = [self.prefix + "f" + "".join(key) for key in SHIFTS] + [self.prefix + "g" + "".join(key) for key in LEVERS]
        self.products = [self.prefix + "p" + "".join(key) for key in LEVERS]
        self.sums = [name for i in AXES for name in self._sums(i)]

    def _terms(self, i: str) -> list[str]:
        shifts = [f"{self.prefix}f{a}{i}" for a in AXES]
        return shifts + [f"{self.prefix}p{''.join(key)}" for key in LEVERS if key[2] == i]

    def _sums(self, i: str) -> list[str]:
        return [f"{self.prefix}s{i}{n}" for n in range(len(self._terms(i)) - 1)]

    def nets(self) -> Iterator[str]:
        p = self.prefix
        for a in AXES:
            users = [f"{p}f{b}{i}.in" for b, i in SHIFTS if b == a]
            users += [f"{p}g{b}{k}{i}.in" for b, k, i in LEVERS if b == a]
            users += [f"{p}p{b}{k}{i}.in1" for b, k, i in LEVERS if k == a]
            yield f"net {p}at-{a} {p}{a}.out => " + " ".join(users)
        for key in LEVERS:
            name = "".join(key)
            yield f"net {p}angle-{name} {p}g{name}.out => {p}p{name}.in0"
        for i in AXES:
            yield from self._chain(i)

    def _chain(self, i: str) -> Iterator[str]:
        terms, sums = self._terms(i), self._sums(i)
        total = terms[0]
        for term, name in zip(terms[1:], sums, strict=True):
            yield f"net {total}-out {total}.out => {name}.in0"
            yield f"net {term}-out {term}.out => {name}.in1"
            total = name
        yield f"net {total}-out {total}.out => abbe-mux-{i}.in{self.bank}"


def _load(component: str, names: list[str], personality: int = 0) -> str:
    line = f"loadrt {component} names={','.join(names)}"
    return line + (f" personality={','.join([str(personality)] * len(names))}" if personality else "")


if __name__ == "__main__":
    sys.stdout.write(hal_text())
