"""What a hidden effect does to a run, and the book of all of them."""

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
    """How a run differs from the machine without the effect.

    ``drive`` (n, 3) mm: the axes stand elsewhere than commanded. ``shift`` (3, n, 3) mm, ``angle`` (3, n, 3) rad: additional error motions
    of carriages X, Y, Z. ``reading`` (n,) mm: of the instrument alone. ``beam`` and ``tilt`` (2,) rad: laser and mirror askew, across the
    nominal beam.
    """

    drive: F
    shift: F
    angle: F
    reading: F
    beam: F
    tilt: F

    @classmethod
    def none(cls, n: int) -> "Bend":
        """No difference at n readings."""
        return cls(np.zeros((n, 3)), np.zeros((3, n, 3)), np.zeros((3, n, 3)), np.zeros(n), np.zeros(2), np.zeros(2))

    def add(self, other: "Bend") -> "Bend":
        """Both together."""
        return Bend(*(getattr(self, name) + getattr(other, name) for name in Bend.__slots__))


@dataclass(frozen=True)
class Hidden:
    """One effect of one machine.

    ``name``, ``key`` as in the exchange files; ``parameters``: ``strength`` in the unit of the exchange files and what else it needs;
    ``wild``: seed of how it departs from the textbook, 0 for the textbook itself; ``bent``: how far, 1 is usual; ``stream``: seed of what
    is random about it anyway (phases, directions of a set-up).
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
        """One parameter."""
        return float(self.parameters[name])

    @property
    def axis(self) -> int:
        """Axis of a key such as X or (the moving axis) EYX."""
        return AXES.index(self.key[-1])

    @property
    def component(self) -> int:
        """Direction of the deviation of a key such as EYX, or the axis of rotation of EAX."""
        return "XYZ".index(self.key[1]) if self.key[1] in "XYZ" else "ABC".index(self.key[1])

    def rng(self, *stream: int) -> np.random.Generator:
        """Random generator of the effect: its phases, directions of a set-up.

        ``stream``: numbers that set apart what is drawn (which quantity, run, set-up); the same ones always give the same sequence.
        """
        return np.random.default_rng([STREAM_WILD, self.stream, *stream])

    def freedom(self, low: float, high: float, which: int, *, signed: bool = False) -> float:
        """A departure from the textbook, drawn between ``low`` and ``high`` times ``bent``; 0 for the textbook itself.

        ``which``: number of the departure, different for each of one effect. ``signed``: half of them are negative.
        """
        if not self.wild:
            return 0.0
        rng = np.random.default_rng([STREAM_WILD + 1, self.wild, which])
        size = self.bent * float(rng.uniform(low, high))
        return -size if signed and rng.random() < 0.5 else size

    def bend(self, track: Track) -> Bend:
        """What it does to a run."""
        out = Bend.none(track.n)
        BOOK[self.name](self, track, out)
        return out

    def scaled(self, strength: float) -> "Hidden":
        """The same effect at another strength."""
        return replace(self, parameters={**self.parameters, "strength": strength})


Act = Callable[[Hidden, Track, Bend], None]
"""Puts an effect into a `Bend`."""
BOOK: dict[str, Act] = {}


def effect(name: str) -> Callable[[Act], Act]:
    """Enter a function into the book of effects."""

    def enter(act: Act) -> Act:
        BOOK[name] = act
        return act

    return enter


def effect_names() -> frozenset[str]:
    """Names of all effects that were entered."""
    return frozenset(BOOK)


def middle(track: Track, axis: int) -> F:
    """Position along the stroke, -1 to 1, (n,)."""
    low, high = track.low_mm[axis], track.high_mm[axis]
    return np.asarray((2.0 * track.q_mm[:, axis] - low - high) / (high - low))
