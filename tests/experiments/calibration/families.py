"""Families of machines: the fifteen of the practice set, one of curves that somebody measured, and three that nobody else has."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import permutations

import numpy as np

from tests.experiments.calibration import curves
from tests.experiments.calibration.curves import Rng, Shape, Sizes
from tests.experiments.calibration.kinematics import Curve, Drift, F, Play, TrueMachine
from tests.experiments.calibration.measured import foreign
from tests.experiments.calibration.readings import Noise

CHAINS = tuple("-".join(("w", *order[:k], "b", *order[k:], "t")) for order in permutations("XYZ") for k in range(4))
PRACTICE: dict[str, tuple[float, F]] = {
    "w-b-X-Y-Z-t": (600.0, np.tile([0.0, 320.0, 260.0], (3, 1))),
    "w-X-Y-b-Z-t": (800.0, np.array([[400.0, 250.0, -230.0], [400.0, 250.0, -150.0], [0.0, 320.0, 260.0]])),
    "w-Y-b-X-Z-t": (700.0, np.array([[0.0, 320.0, 260.0], [350.0, 250.0, -150.0], [0.0, 320.0, 260.0]])),
    "w-X-b-Y-Z-t": (700.0, np.array([[350.0, 250.0, -150.0], [0.0, 0.0, 260.0], [0.0, 0.0, 260.0]])),
}
"""Stroke of X and pivots of the machines of the practice set; Y 500 mm, Z 450 mm."""
OWN_CHAIN = 0.4
"""Share of machines with any of the 24 chains, other strokes and pivots."""
NOISES = ((0.25, 0.15), (0.4, 0.24), (0.6, 0.34))
SQUARENESS_URAD = 20.0
GP = Sizes(25.0, 13.0, (3.0, 2.2, 5.0))


@dataclass(frozen=True)
class Family:
    """How a family's machines and readings differ from smooth ones of 10 to 20 µm.

    ``factor``: range of a machine's size; ``noise``: changes the drawn noise; ``waves_um``: amplitude, period mm of every screw.
    """

    shape: Shape = curves.smooth
    sizes: Sizes = GP
    factor: tuple[float, float] = (0.8, 1.25)
    waves_um: tuple[tuple[float, float], ...] = ()
    play: bool = False
    drift: bool = False
    noise: Callable[[Noise], Noise] = field(default=lambda n: n)


POLY = Family(curves.polynomial, Sizes(30.0, 13.0, (5.0, 6.0, 12.0)))
FAMILIES: dict[str, Family] = {
    "gp": Family(),
    "poly": POLY,
    "polyw": replace(POLY, noise=lambda n: replace(n, kind="white", bar_step_um=0.0, laser_step_um=0.0)),
    "big": Family(factor=(4.0, 7.0)),
    "small": Family(factor=(0.06, 0.2)),
    "outlier": Family(noise=lambda n: replace(n, outliers=0.05)),
    "drift": Family(drift=True),
    "pink": Family(noise=lambda n: replace(n, bar_um=1.0, laser_um=0.6, kind="pink", bar_step_um=0.0, laser_step_um=0.0)),
    "unequal": Family(noise=lambda n: replace(n, bar_um=0.8, laser_um=0.8, spread=15.0, bar_step_um=0.0, laser_step_um=0.0)),
    "coarse": Family(noise=lambda n: replace(n, bar_step_um=1.0, laser_step_um=1.0)),
    "play": Family(play=True),
    "cusp": Family(curves.kinked, Sizes(25.0, 7.0, (3.5, 3.5, 5.0))),
    "fourier": Family(curves.bumpy, Sizes(25.0, 5.0, (2.5, 2.5, 4.0))),
    "walk": Family(curves.walking, Sizes(20.0, 8.0, (1.5, 1.3, 2.6))),
    "pitch": Family(waves_um=((2.0, 10.0), (1.0, 40.0 / 3.0))),
    "series": Family(curves.fading, Sizes(25.0, 13.0, (3.5, 3.0, 8.0))),
    "step": Family(curves.stepped, Sizes(25.0, 10.0, (3.0, 2.0, 4.0))),
    "mixed": Family(
        curves.walking,
        Sizes(25.0, 10.0, (0.6, 0.6, 1.2)),
        waves_um=((1.2, 5.0), (0.8, 16.0)),
        play=True,
        noise=lambda n: replace(n, outliers=0.01),
    ),
    "measured": Family(foreign, Sizes(25.0, 10.0, (3.0, 2.2, 4.5))),
}


def draw_machine(family: str, rng: Rng) -> tuple[TrueMachine, Noise]:
    """A machine of a family and the noise of the instruments that measure it."""
    kind = FAMILIES[family]
    chain, stroke, pivots = _geometry(rng)
    factor = float(np.exp(rng.uniform(*np.log(kind.factor))))
    motions = curves.draw(rng, stroke, kind.sizes, kind.shape, factor)
    if kind.waves_um:
        motions = tuple(_with_screw(rng, six, j, kind.waves_um) for j, six in enumerate(motions))
    play = tuple(_draw_play(rng, float(np.ptp(s)), j) for j, s in enumerate(stroke)) if kind.play else ()
    square = factor * 1e-6 * SQUARENESS_URAD * rng.standard_normal(3)
    drift = Drift(12.0, rng.uniform(1500.0, 3600.0), int(rng.integers(3)), 1.5 * 11.5, rng.uniform(1500.0, 5000.0)) if kind.drift else None
    noise = kind.noise(Noise(*NOISES[int(rng.integers(3))]))
    return TrueMachine(chain, stroke, pivots, motions, square, play, drift), noise


def _geometry(rng: Rng) -> tuple[str, F, F]:
    """Chain, strokes and pivots: one of the practice set's machines, or any."""
    if rng.random() >= OWN_CHAIN:
        chain = str(rng.choice(list(PRACTICE)))
        x, pivots = PRACTICE[chain]
        return chain, np.array([[0.0, x], [0.0, 500.0], [0.0, 450.0]]), pivots
    stroke = np.zeros((3, 2))
    stroke[:, 1] = np.round(rng.uniform((450.0, 400.0, 400.0), (1000.0, 800.0, 700.0)), -1)
    return str(rng.choice(CHAINS)), stroke, np.round(rng.uniform(-350.0, 350.0, (3, 3)))


def _with_screw(rng: Rng, six: tuple[Curve, ...], axis: int, waves_um: tuple[tuple[float, float], ...]) -> tuple[Curve, ...]:
    return (*six[:axis], curves.screw(rng, six[axis], waves_um), *six[axis + 1 :])


def _draw_play(rng: Rng, length_mm: float, axis: int) -> Play:
    """Lost motion of 2 to 5 µm that changes by half over the stroke, and 2 µm sideways."""
    size, waves, phase = rng.uniform(2.0, 5.0), rng.uniform(0.5, 1.5), rng.uniform(0.0, 2.0 * np.pi)
    sideways = 2.0 * rng.standard_normal(3)
    sideways[axis] = 0.0
    return Play(lambda x: size * (1.0 + 0.5 * np.sin(2.0 * np.pi * waves * x / length_mm + phase)), sideways)
