"""What a report says, as plain values: one of them becomes PDF, HTML, CSV and JSON.

Values stand in the unit that people read (µm, µrad, °C); every ``u`` is a standard uncertainty (k = 1) in the figure's unit.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

from abbe.service.rendering.numbers import COVERAGE

FORMAT = "abbe-report/1"
Kind = Literal["run", "campaign", "verification", "discovery", "push", "simulation", "cycle", "plan", "dry-run", "table-change"]
Sign = Literal["ok", "open", "bad"]

DECISION_RULE = (
    "ISO 14253-1, guard band U on both sides of a limit: within limits is stated where value + U does not exceed the limit, out of limits "
    "where value - U exceeds it; in between the measurement cannot tell. A figure without a limit is reported and not judged."
)
UNCERTAINTY = (
    f"U is the expanded uncertainty, k = {COVERAGE:g}, about 95 % coverage for a normal distribution (GUM); value and U are rounded "
    "together. Where no U is given, it is unknown."
)
SIGNATURES = ("Measured by", "Checked by", "Approved by")


@dataclass(frozen=True, slots=True)
class ReportFigure:
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
class Lines:
    """Sentences, one below the other; ``numbered``: their order counts."""

    items: Sequence[str]
    numbered: bool = False


@dataclass(frozen=True, slots=True)
class Facts:
    """Names and values in words."""

    items: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class TextTable:
    """A table of words and ready-made numbers; columns that hold only numbers are set to the right."""

    head: Sequence[str]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True, slots=True)
class Picture:
    """``<svg>`` elements of `abbe.service.rendering.plots` under one caption.

    ``layout``: two beside each other, one below the other over the whole width, or in two columns that pictures of unlike heights fill.
    """

    caption: str
    svgs: Sequence[str]
    layout: Literal["pair", "wide", "flow"] = "pair"


@dataclass(frozen=True, slots=True)
class Section:
    """A heading and what stands below it; ``folded``: shut on a page until the reader opens it, open on paper."""

    title: str
    blocks: Sequence[Block]
    folded: bool = False


Block: TypeAlias = str | Lines | Facts | TextTable | Picture | Section


@dataclass(frozen=True, slots=True, kw_only=True)
class Document:
    """A report. Mappings are name and value in words, in the order in which they are printed.

    ``verdict``: sign, word and sentence; ``remarks``: what the reader has to know first; ``sections``: what the reader came for, before the
    figures; ``not_observable``: what this measurement could not show, None where nothing was measured; ``appendix``: pictures and tables
    behind the figures; ``provenance``: versions and hashes; ``signatures``: who signs, empty for a working paper.
    """

    kind: Kind
    title: str
    about: Mapping[str, str] = field(default_factory=dict)
    verdict: tuple[Sign, str, str] | None = None
    remarks: Sequence[str] = ()
    sections: Sequence[Section] = ()
    figures: Sequence[ReportFigure] = ()
    statements: Sequence[str] = ()
    not_observable: Sequence[str] | None = None
    instruments: Sequence[Instrument] = ()
    conditions: Mapping[str, str] = field(default_factory=dict)
    appendix: Sequence[Section] = ()
    provenance: Mapping[str, str] = field(default_factory=dict)
    signatures: Sequence[str] = SIGNATURES
    lang: str = "en"

    @property
    def pictures(self) -> list[Picture]:
        """Every picture, in the order of the paper."""
        return [block for _, block in blocks([*self.sections, *self.appendix]) if isinstance(block, Picture)]


def blocks(sections: Sequence[Section]) -> Iterator[tuple[str, Block]]:
    """Every block with the title of its own section, sections within sections opened."""
    for section in sections:
        for block in section.blocks:
            if isinstance(block, Section):
                yield from blocks([block])
            else:
                yield section.title, block
