"""A hidden effect, the changes that it causes in a run, and the registry of all effects."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from abbe.simulators.arrays import F
from abbe.simulators.hidden.track import Track

AXES = "XYZ"
UM, URAD, MS, MRAD, PPM = 1e-3, 1e-6, 1e-3, 1e-3, 1e-6
STREAM_WILD = 41


@dataclass(slots=True)
class Bend:
    """Changes that an effect causes in a run.

    ``drive`` (n, 3) mm: axis positions minus commanded ones. ``shift`` (3, n, 3) mm, ``angle`` (3, n, 3) rad: additional error motions of
    carriages X, Y, Z. ``reading`` (n,) mm: error of the instrument itself. ``beam``, ``tilt`` (2,) rad: misalignment of laser beam and
    mirror, in the two directions across the nominal beam.
    """

    drive: F
    shift: F
    angle: F
    reading: F
    beam: F
    tilt: F

    @classmethod
    def none(cls, n: int) -> "Bend":
        """Return a bend that changes none of n readings."""
        return cls(np.zeros((n, 3)), np.zeros((3, n, 3)), np.zeros((3, n, 3)), np.zeros(n), np.zeros(2), np.zeros(2))

    def add(self, other: "Bend") -> "Bend":
        """Return the sum of two bends."""
        return Bend(*(getattr(self, name) + getattr(other, name) for name in Bend.__slots__))


@dataclass(frozen=True)
class Hidden:
    """One effect of one machine.

    ``name`` and ``key`` as in the effect catalogue; ``parameters``: ``strength`` in the effect's unit, and any others that the effect
    needs; ``wild``: seed of its departures from the textbook form, 0: none; ``bent``: factor of their size, usually 1; ``stream``: seed of
    its other random values (phases, directions of a set-up).
    """

    name: str
    key: str = ""
    parameters: Mapping[str, float] = field(default_factory=dict)
    wild: int = 0
    bent: float = 1.0
    stream: int = 0

    @property
    def label(self) -> str:
        """``name:key``, or the name alone."""
        return f"{self.name}:{self.key}" if self.key else self.name

    def __getitem__(self, name: str) -> float:
        """Return the parameter of this name."""
        return float(self.parameters[name])

    @property
    def axis(self) -> int:
        """Index of the axis in the key: its last letter, as in X or EYX."""
        return AXES.index(self.key[-1])

    @property
    def component(self) -> int:
        """Index of the direction of deviation in a key such as EYX (Y), or of the axis of rotation in EAX (A)."""
        return "XYZ".index(self.key[1]) if self.key[1] in "XYZ" else "ABC".index(self.key[1])

    def rng(self, *stream: int) -> np.random.Generator:
        """Return a random generator for phases or directions of a set-up.

        ``stream``: numbers that distinguish the draws (quantity, run, set-up); equal numbers give equal sequences.
        """
        return np.random.default_rng([STREAM_WILD, self.stream, *stream])

    def freedom(self, low: float, high: float, which: int, *, signed: bool = False) -> float:
        """Return a departure from the textbook form: a random number between ``low`` and ``high``, times `bent`; 0 if `wild` is 0.

        ``which``: number of the departure, unique within the effect. ``signed``: the departure is negative in half of the cases.
        """
        if not self.wild:
            return 0.0
        rng = np.random.default_rng([STREAM_WILD + 1, self.wild, which])
        size = self.bent * float(rng.uniform(low, high))
        return -size if signed and rng.random() < 0.5 else size

    def bend(self, track: Track) -> Bend:
        """Return the changes that the effect causes in this run."""
        out = Bend.none(track.n)
        BOOK[self.name](self, track, out)
        return out

    def scaled(self, strength: float) -> "Hidden":
        """Return the same effect at another strength."""
        return replace(self, parameters={**self.parameters, "strength": strength})


Act = Callable[[Hidden, Track, Bend], None]
"""Writes what an effect changes in a run into a `Bend` of zeros."""
BOOK: dict[str, Act] = {}


def effect(name: str) -> Callable[[Act], Act]:
    """Register a function as the effect of this name."""

    def enter(act: Act) -> Act:
        BOOK[name] = act
        return act

    return enter


def effect_names() -> frozenset[str]:
    """Return the names of all registered effects."""
    return frozenset(BOOK)


def middle(track: Track, axis: int) -> F:
    """Return the position along the stroke, scaled to -1 to 1, (n,)."""
    low, high = track.low_mm[axis], track.high_mm[axis]
    return np.asarray((2.0 * track.q_mm[:, axis] - low - high) / (high - low))
