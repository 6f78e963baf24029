"""Content of a report as plain values, the source of PDF, HTML, CSV and JSON.

Values are in the printed unit (µm, µrad, °C); every ``u`` is a standard uncertainty (k = 1) in the figure's unit.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

from abbe.service.domain.machine import Issuer, Item
from abbe.service.rendering.numbers import COVERAGE

FORMAT = "abbe-report/1"
Kind = Literal["run", "campaign", "verification", "discovery", "push", "simulation", "cycle", "plan", "dry-run", "table-change", "papers"]
Sign = Literal["ok", "open", "bad"]

DECISION_RULE = (
    "ISO 14253-1, guard band U on both sides of a limit: a figure is within limits if value + U does not exceed the limit, out of limits "
    "if value - U exceeds it; in between the measurement cannot tell. A figure without a limit is reported and not judged."
)
UNCERTAINTY = (
    f"U is the expanded uncertainty, k = {COVERAGE:g}, about 95 % coverage for a normal distribution (GUM); value and U are rounded "
    "together. Where no U is given, it is unknown."
)
SIGNATURES = ("Measured by", "Checked by", "Approved by")


@dataclass(frozen=True, slots=True)
class ReportFigure:
    """One numeric result. ``symbol``: its symbol in the standard; ``method``: rule of evaluation; ``limit``, ``verdict``: if judged."""

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
    """An instrument of the measurement, with text about its certificate and uncertainty."""

    name: str
    certificate: str
    known: str


@dataclass(frozen=True, slots=True)
class Lines:
    """A list of sentences; ``numbered``: an ordered list."""

    items: Sequence[str]
    numbered: bool = False


@dataclass(frozen=True, slots=True)
class Facts:
    """Names and values as text."""

    items: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class TextTable:
    """A table of text and formatted numbers; columns of numbers only are aligned to the right.

    ``bold``: headings of the columns that a page or sheet prints in bold.
    """

    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    bold: Sequence[str] = ()


@dataclass(frozen=True, slots=True)
class PictureBlock:
    """``<svg>`` elements of `abbe.service.rendering.plots` under one caption.

    ``layout``: two side by side, one below the other at full width, or in two columns for pictures of different heights.
    """

    caption: str
    svgs: Sequence[str]
    layout: Literal["pair", "wide", "flow"] = "pair"


@dataclass(frozen=True, slots=True)
class Section:
    """A heading with its blocks; ``folded``: collapsed on a page until opened, open on paper."""

    title: str
    blocks: Sequence[Block]
    folded: bool = False


Block: TypeAlias = str | Lines | Facts | TextTable | PictureBlock | Section


@dataclass(frozen=True, slots=True, kw_only=True)
class Document:
    """A report. Mappings hold names and values as text, in printed order.

    ``verdict``: sign, word and sentence; ``remarks``: important notes at the top; ``sections``: main results, printed before the figures;
    ``not_observable``: errors that this measurement could not show, None without a measurement; ``appendix``: pictures and tables after the
    figures; ``provenance``: versions and hashes; ``signatures``: roles that sign, empty for a working paper; ``days``: first and last day
    of the measurement (ISO 8601), None if not on record; ``issuer``, ``item``, ``issued``: laboratory, machine and day of a certificate;
    ``lang``: language of page and PDF. The texts here are English; `abbe.service.rendering.phrases` translates them.
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
    days: tuple[str, str] | None = None
    issuer: Issuer | None = None
    item: Item | None = None
    issued: str = ""

    @property
    def pictures(self) -> list[PictureBlock]:
        """Every picture, in printed order."""
        return [block for _, block in blocks([*self.sections, *self.appendix]) if isinstance(block, PictureBlock)]


def blocks(sections: Sequence[Section]) -> Iterator[tuple[str, Block]]:
    """Every block with the title of its section, including nested sections."""
    for section in sections:
        for block in section.blocks:
            if isinstance(block, Section):
                yield from blocks([block])
            else:
                yield section.title, block
