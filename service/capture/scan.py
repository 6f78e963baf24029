"""Reads a segment that may have been cut, torn or damaged: every good record, and where something is wrong. Pure."""

from __future__ import annotations

from dataclasses import dataclass, field

from abbe.service.capture.records import CLOSE, MAGIC, NO_HASH, Record, decode_at, digest


@dataclass(frozen=True, slots=True)
class Damage:
    """Bytes between good records that are no record: bits that flipped, or a sector that was lost."""

    offset: int
    length: int
    before: int
    """How many good records stand before it."""


@dataclass(frozen=True, slots=True)
class Scan:
    """What a segment holds.

    Parameters
    ----------
    records : list of Record
        Every undamaged one, in order.
    damaged : list of Damage
        Damage with good records behind it.
    good_bytes : int
        Where the last good record ends; what follows was never acknowledged and may be cut off.
    tail_bytes : int
        How much that is.
    broken_links : list of int
        Records that do not follow on the one before them: something was taken out, put in or changed on purpose.
    head : bytes
        SHA-256 of the last good record.
    """

    records: list[Record] = field(default_factory=list)
    damaged: list[Damage] = field(default_factory=list)
    good_bytes: int = 0
    tail_bytes: int = 0
    broken_links: list[int] = field(default_factory=list)
    head: bytes = NO_HASH

    @property
    def closed(self) -> bool:
        """True when the run was ended, not cut off."""
        return bool(self.records) and self.records[-1].kind == CLOSE

    @property
    def whole(self) -> bool:
        """True when every byte is part of one unbroken chain."""
        return not (self.damaged or self.tail_bytes or self.broken_links)


def scan(data: bytes | memoryview) -> Scan:
    """Find every good record of a segment.

    A bad record ends the search only if no good one follows: a torn tail is told from damage in the middle; neither costs a good record.
    """
    records: list[Record] = []
    damaged: list[Damage] = []
    broken: list[int] = []
    at, expected = 0, NO_HASH
    while True:
        found = decode_at(data, at)
        start = at
        if found is None:
            start = _next_good(data, at + 1)
            if start < 0:
                return Scan(records, damaged, at, len(data) - at, broken, expected)
            damaged.append(Damage(at, start - at, len(records)))
            found = decode_at(data, start)
            assert found is not None
        record, end = found
        if start == at and record.previous != expected:
            broken.append(len(records))
        records.append(record)
        expected, at = digest(data[start:end]), end


def _next_good(data: bytes | memoryview, at: int) -> int:
    """Where the next undamaged record begins, or -1."""
    rest = bytes(data[at:])
    found = rest.find(MAGIC)
    while found >= 0:
        if decode_at(rest, found) is not None:
            return at + found
        found = rest.find(MAGIC, found + 1)
    return -1
