"""Clearance of a touch probe on its whole way: its ball, shaft and body against the balls of an artefact and the obstacles beside it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from abbe.service.domain.artefact import Obstacle
from abbe.service.domain.machine import Point
from abbe.service.errors import ConfigError
from abbe.service.sequences.recipes.approach import Array
from abbe.service.sequences.steps import TouchFeature

STEP_MM = 1.0
"""Largest distance between the places of a way that are checked."""
LONG_MM = 200.0
"""Assumed length of a shaft without a stated length, and of the probe's body above it."""
ROUNDS = 28
"""Steps of the ternary search for the nearest place on a part: they find it to 1/80,000 of the part's length."""


@dataclass(frozen=True, slots=True)
class ProbePart:
    """A cylinder with round ends about the stylus, or its ball; the axis runs from ``from_mm`` to ``to_mm`` above the ball's centre."""

    name: str
    radius_mm: float
    from_mm: float
    to_mm: float


def probe_parts(ball_mm: float, shaft_mm: float | None, length_mm: float | None, body_mm: float) -> tuple[ProbePart, ...]:
    """Return the parts of a probe from the radii of ball, shaft and body and the stylus' length (centre of the ball to the body), mm.

    A shaft whose radius is not stated is as thick as the ball. Without a length the body is not known, and not checked.
    """
    parts = [ProbePart("the stylus", ball_mm, 0.0, 0.0)]
    parts.append(ProbePart("the shaft of the stylus", ball_mm if shaft_mm is None else shaft_mm, 0.0, length_mm or LONG_MM))
    if length_mm is not None:
        parts.append(ProbePart("the body of the probe", body_mm, length_mm, length_mm + LONG_MM))
    return tuple(parts)


class Solids(Protocol):
    """Bodies that the probe must not meet."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the bodies."""
        ...

    def gaps_mm(self, places_mm: Array, up: Array, part: ProbePart) -> Array:
        """Return the least gap, mm, between a part of the probe and each body over these places of the probe's ball, shape (bodies,)."""
        ...


@dataclass(frozen=True)
class Balls:
    """Balls: centres in machine axes, (n, 3), and radii, (n,), mm."""

    names: tuple[str, ...]
    centre_mm: Array
    radius_mm: Array

    def gaps_mm(self, places_mm: Array, up: Array, part: ProbePart) -> Array:
        """As `Solids`."""
        away = self.centre_mm - places_mm[:, None]
        if part.to_mm == 0.0:
            found: Array = np.linalg.norm(away, axis=2).min(axis=0) - self.radius_mm - part.radius_mm
            return found
        along = away @ up
        beside = np.maximum(np.linalg.norm(away - along[..., None] * up, axis=2) - part.radius_mm, 0.0)
        beyond = np.maximum(np.maximum(part.from_mm - along, along - part.to_mm), 0.0)
        return np.asarray(np.hypot(beside, beyond).min(axis=0) - self.radius_mm)


@dataclass(frozen=True)
class Boxes:
    """Boxes along the axes of an artefact: lowest and highest corner, (n, 3) mm each, and the artefact's pose."""

    names: tuple[str, ...]
    low_mm: Array
    high_mm: Array
    origin_mm: Array
    matrix: Array

    @classmethod
    def of(cls, obstacles: Iterable[Obstacle], origin_mm: Point, matrix: Array) -> Boxes:
        """The obstacles of an artefact in a pose."""
        known = list(obstacles)
        low, high = (np.array([getattr(one, end) for one in known]).reshape(-1, 3) for end in ("low_mm", "high_mm"))
        return cls(tuple(one.id for one in known), low, high, np.array(origin_mm), matrix)

    def gaps_mm(self, places_mm: Array, up: Array, part: ProbePart) -> Array:
        """Return the gaps as `Solids` does; the part is taken as round at both ends, so a flat end may seem nearer than it is."""
        return self._rod(places_mm, up, part.from_mm, part.to_mm) - part.radius_mm

    def _rod(self, places_mm: Array, up: Array, from_mm: float, to_mm: float) -> Array:
        """Return the least distance of each body from lines that begin above these places, (bodies,), by ternary search: the distance
        is convex along a line."""
        own, along = ((places_mm - self.origin_mm) @ self.matrix)[:, None], up @ self.matrix
        shape = (len(places_mm), len(self.names))
        low, high = np.full(shape, from_mm), np.full(shape, to_mm)
        for _ in range(ROUNDS if to_mm > from_mm else 0):
            one, two = low + (high - low) / 3.0, high - (high - low) / 3.0
            nearer = self._distance(own + one[..., None] * along) < self._distance(own + two[..., None] * along)
            low, high = np.where(nearer, low, one), np.where(nearer, two, high)
        return np.asarray(self._distance(own + 0.5 * (low + high)[..., None] * along).min(axis=0))

    def _distance(self, own_mm: NDArray[np.float64]) -> Array:
        beyond = np.maximum(np.maximum(self.low_mm - own_mm, own_mm - self.high_mm), 0.0)
        return np.asarray(np.linalg.norm(beyond, axis=-1))


def check_clear(
    artefact: str,
    touches: Iterable[TouchFeature],
    start_mm: Point,
    parts: tuple[ProbePart, ...],
    solids: tuple[Solids, ...],
    margin_mm: float,
) -> None:
    """Check all ways of a pose, in order from ``start_mm`` on: every part of the probe keeps ``margin_mm`` to every body.

    Ball and shaft may come near the ball that they touch; the body may not.

    Raises
    ------
    ConfigError
        A part comes nearer; feature and body are named.
    """
    here, solids = start_mm, tuple(some for some in solids if some.names)
    for one in touches if solids else ():
        places, up = np.concatenate([_along(way) for way in _ways(here, one)]), np.array(one.up)
        here = one.above_mm
        for part in parts:
            for some in solids:
                gaps = some.gaps_mm(places, up, part)
                meant = np.array([isinstance(some, Balls) and part.from_mm == 0.0 and n == one.feature for n in some.names], dtype=bool)
                gaps = np.where(meant, np.inf, gaps)
                if gaps.min() < margin_mm:
                    raise ConfigError(
                        f"artefact {artefact}, feature {one.feature}: {part.name} comes within {gaps.min():.1f} mm of "
                        f"{some.names[int(np.argmin(gaps))]} on the way there",
                        "raise clear_mm, use a smaller or longer stylus or a smaller search_mm, move the clamp, or leave the feature out",
                    )


def _ways(here: Point, one: TouchFeature) -> Iterator[tuple[Point, ...]]:
    """Yield the ways to a feature and inside it."""
    yield here, one.above_mm
    if one.inside:
        yield one.above_mm, one.centre_mm
    for side in one.sides:
        begin = (one.centre_mm,) if one.inside else (one.above_mm, one.over_mm(side))
        yield *begin, one.before_mm(side), one.beyond_mm(side)


def _along(way: tuple[Point, ...]) -> Array:
    """Return places along a way, shape (n, 3)."""
    out = [np.array(way[:1])]
    for a, b in pairwise(np.array(way)):
        share = np.linspace(0.0, 1.0, max(int(np.ceil(np.linalg.norm(b - a) / STEP_MM)), 1) + 1)[1:, None]
        out.append(a + share * (b - a))
    return np.concatenate(out)
