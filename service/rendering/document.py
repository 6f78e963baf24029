"""What a signed report says, as plain values: one of them becomes PDF, HTML, CSV and JSON.

Values stand in the unit that people read (µm, µrad, °C); every ``u`` is a standard uncertainty (k = 1) in the figure's unit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from abbe.service.rendering.numbers import COVERAGE

FORMAT = "abbe-report/1"
Kind = Literal["run", "campaign", "verification", "discovery", "push"]
Sign = Literal["ok", "open", "bad"]

DECISION_RULE = (
    "ISO 14253-1, guard band U on both sides of a limit: within limits is stated where value + U does not exceed the limit, out of limits "
    "where value - U exceeds it; in between the measurement cannot tell. A figure without a limit is reported and not judged."
)
UNCERTAINTY = (
    f"U is the expanded uncertainty, k = {COVERAGE:g}, about 95 % coverage for a normal distribution (GUM); value and U are rounded "
    "together. Where no U is given nobody knows it."
)
SIGNATURES = ("Measured by", "Checked by", "Approved by")


@dataclass(frozen=True, slots=True)
class Figure:
    """One figure. ``symbol``: as the standard has it; ``method``: by which rule; ``limit`` and ``verdict``: where it was judged."""

    group: str
    symbol: str
    name: str
    value: float | None
    u: float | None
    unit: str
    method: str = ""
    limit: float | None = None
    verdict: str = ""


@dataclass(frozen=True, slots=True)
class Instrument:
    """An instrument of the measurement: what is known of its certificate and uncertainty, in words."""

    name: str
    certificate: str
    known: str


@dataclass(frozen=True, slots=True)
class TextTable:
    """A table of words and ready-made numbers."""

    title: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True, slots=True)
class Picture:
    """One ``<svg>`` element of `abbe.service.rendering.plots` with its caption; ``wide``: over the whole width of the paper."""

    caption: str
    svg: str
    wide: bool = False


@dataclass(frozen=True, slots=True)
class Document:
    """A report. Mappings are name and value in words, in the order in which they are printed.

    ``verdict``: sign, word and sentence; ``not_observable``: what this measurement could not show; ``remarks``: what the reader has to
    know before he signs; ``provenance``: versions and hashes.
    """

    kind: Kind
    title: str
    about: Mapping[str, str]
    verdict: tuple[Sign, str, str]
    figures: Sequence[Figure]
    instruments: Sequence[Instrument]
    conditions: Mapping[str, str]
    not_observable: Sequence[str]
    remarks: Sequence[str]
    provenance: Mapping[str, str]
    tables: Sequence[TextTable] = ()
    pictures: Sequence[Picture] = ()
    statements: Sequence[str] = ()
    signatures: Sequence[str] = SIGNATURES
    lang: str = "en"
