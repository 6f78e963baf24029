"""Where every sequence number of a run ended: stored as valid, stored with a flag, or in an explicit gap. Pure bookkeeping."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from abbe.drivers.api import BarSample
from abbe.drivers.flags import bar_is_valid, bar_reasons


@dataclass(frozen=True, slots=True)
class SampleGap:
    """Samples that are missing, and all that is known about it.

    Parameters
    ----------
    stream : int
        Which stream of the run, from 0.
    first, last : int
        Sequence numbers; ``last`` is None when nobody knows how many would have come.
    cause : str
        In words.
    before_us, after_us : int or None
        Device clock of the last sample before and the first one after.
    """

    stream: int
    first: int
    last: int | None
    cause: str
    before_us: int | None
    after_us: int | None

    @property
    def missing(self) -> int:
        """How many; 0 where nobody knows."""
        return 0 if self.last is None else self.last - self.first + 1

    def doc(self) -> dict[str, Any]:
        """As JSON object."""
        return asdict(self)

    @staticmethod
    def of(doc: dict[str, Any]) -> SampleGap:
        """From a JSON object."""
        return SampleGap(*(doc[name] for name in SampleGap.__dataclass_fields__))


@dataclass(slots=True)
class Ledger:
    """Account of one run's sequence numbers. Samples and gaps come in any order; `unaccounted` says what no entry covers."""

    flagged: dict[str, int] = field(default_factory=dict)
    gaps: list[SampleGap] = field(default_factory=list)
    invalid: int = 0
    _stored: dict[int, list[list[int]]] = field(default_factory=dict)

    def add_samples(self, stream: int, samples: Sequence[BarSample]) -> None:
        """Book samples that are stored; in one call without a gap between them."""
        self.add_span(stream, samples[0].seq, samples[-1].seq)
        for sample in samples:
            if not bar_is_valid(sample.status):  # the sample is kept all the same
                self.invalid += 1
                for reason in bar_reasons(sample.status):
                    self.flagged[reason] = self.flagged.get(reason, 0) + 1

    def add_span(self, stream: int, first: int, last: int) -> None:
        """Book samples that are stored without a flag, from their first and last number."""
        spans = self._stored.setdefault(stream, [])
        if spans and spans[-1][1] + 1 == first:
            spans[-1][1] = last
        else:
            spans.append([first, last])

    def add_gap(self, gap: SampleGap) -> None:
        """Book samples that are missing."""
        self.gaps.append(gap)

    @property
    def stored(self) -> int:
        """Samples stored, with and without flag."""
        return sum(last - first + 1 for spans in self._stored.values() for first, last in spans)

    def stored_spans(self, stream: int = 0) -> list[tuple[int, int]]:
        """First and last number of every unbroken piece of a stream."""
        return [(first, last) for first, last in sorted(self._stored.get(stream, []))]

    def unaccounted(self) -> list[tuple[int, int, int]]:
        """Stream, first and last of what neither a sample nor a gap covers, up to the highest number known."""
        found = []
        for stream in sorted({*self._stored, *(gap.stream for gap in self.gaps)}):
            at = 0
            for first, last in self._covered(stream):
                if first > at:
                    found.append((stream, at, first - 1))
                at = max(at, last + 1)
        return found

    def ends(self) -> dict[int, int]:
        """For each stream the number behind the highest known one."""
        streams = sorted({*self._stored, *(gap.stream for gap in self.gaps)})
        return {stream: max((last + 1 for _, last in self._covered(stream)), default=0) for stream in streams}

    def twice(self) -> int:
        """How many numbers have more than one entry."""
        count = 0
        for stream in sorted({*self._stored, *(gap.stream for gap in self.gaps)}):
            at = 0
            for first, last in self._covered(stream):
                count += max(0, min(at, last + 1) - first)
                at = max(at, last + 1)
        return count

    def doc(self) -> dict[str, Any]:
        """Sums, as JSON object."""
        return {
            "stored_valid": self.stored - self.invalid,
            "stored_flagged": self.invalid,
            "flags": dict(self.flagged),
            "in_gaps": sum(gap.missing for gap in self.gaps),
            "gaps": len(self.gaps),
            "unaccounted": sum(last - first + 1 for _, first, last in self.unaccounted()),
        }

    def _covered(self, stream: int) -> list[tuple[int, int]]:
        spans = [(first, last) for first, last in self._stored.get(stream, [])]
        return sorted(spans + [(g.first, g.last) for g in self.gaps if g.stream == stream and g.last is not None])
