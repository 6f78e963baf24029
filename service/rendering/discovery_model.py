"""What the page of a discovery says, as plain values. Lengths in µm, positions in mm; every ``u`` is a standard uncertainty (k = 1)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class RunGap:
    """One run: rms of measured minus simulated before and after, None for a sealed run, and the noise that no model takes out."""

    label: str
    test: str
    role: str
    readings: int
    before_um: float | None
    after_um: float | None
    floor_um: float


@dataclass(frozen=True, slots=True, eq=False)
class Trace:
    """Measured minus simulated along one run, before and after. All three of shape (n,); ``why`` this one is shown."""

    label: str
    x_label: str
    x: Array
    before_um: Array
    after_um: Array
    noise_um: float
    why: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class PlaceMap:
    """Where in one plane of the volume the gap lives.

    ``x_mm``, ``y_mm``: centres of cells that were measured, shape (n,); ``times_noise``: rms of the gap there over its noise; ``spot``:
    what was located, centre and radius.
    """

    x_axis: str
    y_axis: str
    x_mm: Array
    y_mm: Array
    times_noise: Array
    spot: tuple[float, float, float] | None = None


@dataclass(frozen=True, slots=True)
class EffectCard:
    """One named effect in words. ``size``: value, U (k = 2), unit; ``facts``: further parameters and evidence; the rest are sentences."""

    name: str
    size: tuple[str, str, str]
    facts: Mapping[str, str]
    where: str
    do: str
    remedy: str
    signature: str
    rivals: Sequence[str]
    source: str


@dataclass(frozen=True, slots=True)
class GapRow:
    """The gap of all runs of a role: rms before, after, floor; ``closed``: share of what is above the floor that is gone, None: no gap."""

    role: str
    meaning: str
    before_um: float | None
    after_um: float | None
    floor_um: float | None
    closed: float | None


@dataclass(frozen=True, slots=True, eq=False)
class DiscoveryPage:
    """All that the page says.

    ``verdict``: sign ("ok", "open", "bad"), word and text; ``tests``: kind, value, statistic and p of each test of where the gap lives;
    ``states``: state and why; ``found``: what the gap after is with, empty where before and after are one; the
    other texts are lines, ``changed``: what has changed since the last solution.
    """

    title: str
    facts: Mapping[str, str]
    verdict: tuple[str, str, str]
    effects: Sequence[EffectCard]
    located: Sequence[str]
    gaps: Sequence[GapRow]
    runs: Sequence[RunGap]
    traces: Sequence[Trace]
    places: Sequence[PlaceMap]
    tests: Sequence[tuple[str, str, str, str]]
    next_test: Sequence[str]
    rejected: Sequence[tuple[str, str]]
    flags: Sequence[str]
    states: Sequence[tuple[str, str]]
    provenance: Mapping[str, str]
    found: str = "what was found"
    changed: Sequence[str] = ()
    lang: str = "en"
