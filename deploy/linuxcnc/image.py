"""Convert compensation images (docs/protocols/cnc.md, "Banks") to the forms that this control supports: network curves and one-axis files.

No image is approximated: the control refuses, at sealing, an image that it cannot reproduce.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass, field
from itertools import product

from network import AXES, LEVERS, POINTS, SHIFTS, Network, Vertices

LSB_NM = 100
HEADER_WORDS = 24
BANK_WORDS = 4800
FILE_POINTS = 256  # entries of a COMP_FILE
GRID_TOLERANCE_LSB = 1.5  # a grid of rounded values meets its own smooth parts to this
_LSB_MM = LSB_NM * 1e-6
_HEADER = struct.Struct(">4HI2H3HH3i3i")


class ImageError(ValueError):
    """The words are not an image, or this control cannot reproduce the image."""


@dataclass(frozen=True)
class Plan:
    """Form in which the control receives a table.

    Attributes
    ----------
    kind : int
        Kind of the image: 0 no correction, 1 one-axis tables, 2 grid.
    network : Network
        Content of the network that acts at once.
    files : dict
        Axis -> vertices of its COMP_FILE (position mm, correction mm), which takes effect at the control's start. Missing: no file.
    worst_lsb : float
        Largest difference, LSB, between a node of the image and the correction by the curves there.
    """

    kind: int
    network: Network
    files: dict[str, Vertices] = field(default_factory=dict)
    worst_lsb: float = 0.0


@dataclass(frozen=True)
class _Table:
    kind: int
    counts: tuple[int, ...]
    start: tuple[int, ...]
    step: tuple[int, ...]
    values: tuple[int, ...]

    def places_mm(self, axis: int) -> list[float]:
        return [(self.start[axis] + n * self.step[axis]) / 100_000 for n in range(self.counts[axis])]


def empty() -> list[int]:
    """Words of the image that corrects nothing."""
    return list(struct.unpack(">24H", _HEADER.pack(0xABBE, 1, 0, HEADER_WORDS, 0, LSB_NM, 0, 0, 0, 0, 0, 0, 0, 0, 1, 1, 1)))


def data_of(words: list[int]) -> bytes:
    """Return words as big-endian bytes, over which the CRC is computed."""
    return struct.pack(f">{len(words)}H", *words)


def words_of(data: bytes) -> list[int]:
    """Return big-endian bytes as words."""
    return list(struct.unpack(f">{len(data) // 2}H", data))


def length_of(words: list[int]) -> int:
    """Number of words that the image states in its header."""
    return words[3]


def checksum(words: list[int]) -> int:
    """CRC-32 of the image at the beginning of a bank."""
    return zlib.crc32(data_of(words[: length_of(words)]))


def plan(words: list[int]) -> Plan:
    """Read a bank's words and decide whether each curve goes into the network or a file.

    Raises
    ------
    ImageError
        The words are not an image, or 16-point curves and 256-point one-axis files cannot reproduce the image.
    """
    table = _parse(words)
    if table.kind == 0:
        return Plan(0, Network())
    ends = {axis: (table.places_mm(n)[0], table.places_mm(n)[-1]) for n, axis in enumerate(AXES)}
    return _one_axis(table, ends) if table.kind == 1 else _grid(table, ends)


def _parse(words: list[int]) -> _Table:
    if len(words) < HEADER_WORDS:
        raise ImageError("the image is shorter than its header")
    magic, layout, kind, length, _, lsb, spare, *rest = _HEADER.unpack(data_of(words[:HEADER_WORDS]))
    counts, spare_too, start, step = tuple(rest[:3]), rest[3], tuple(rest[4:7]), tuple(rest[7:])
    if (magic, layout, lsb, spare, spare_too) != (0xABBE, 1, LSB_NM, 0, 0):
        raise ImageError("the header has another magic number, format, unit or reserved words than docs/protocols/cnc.md")
    sizes = {0: 0, 1: 3 * sum(counts), 2: 3 * counts[0] * counts[1] * counts[2]}
    if kind not in sizes:
        raise ImageError(f"kind {kind} is unknown")
    if length != HEADER_WORDS + sizes[kind] or length > min(len(words), BANK_WORDS):
        raise ImageError(f"length {length} does not fit kind {kind} with {counts} points")
    if any(counts) if kind == 0 else min(counts) < 2 or min(step) <= 0:
        raise ImageError("the grid does not fit the kind")
    body = struct.unpack(f">{length - HEADER_WORDS}h", data_of(words[HEADER_WORDS:length]))
    return _Table(kind, counts, start, step, body)


# ---- kind 1: nine one-axis tables ---------------------------------------------------------------------------------------------------


def _one_axis(table: _Table, ends: dict[str, tuple[float, float]]) -> Plan:
    shifts: dict[tuple[str, str], Vertices] = {}
    files: dict[str, Vertices] = {}
    first = 0
    for n, (a, i) in enumerate(SHIFTS):
        count = table.counts[n // 3]
        vertices = _vertices(table.places_mm(n // 3), table.values[first : first + count])
        first += count
        if len(vertices) <= POINTS:
            shifts[a, i] = vertices
        elif a == i and len(vertices) <= FILE_POINTS:
            files[a] = vertices
        else:
            raise ImageError(f"correction of {i} by {a} has {len(vertices)} corners, more than {FILE_POINTS if a == i else POINTS}")
    return Plan(1, Network(shifts=shifts, ends_mm=ends), files)


def _vertices(places_mm: list[float], values: tuple[int, ...]) -> Vertices:
    """Return the corners of a polyline with equal pitch; leave out points on the straight line between their neighbours."""
    last = len(values) - 1
    corner = [n for n in range(len(values)) if n in (0, last) or values[n] - values[n - 1] != values[n + 1] - values[n]]
    return tuple((places_mm[n], values[n] * _LSB_MM) for n in corner)


# ---- kind 2: a grid -----------------------------------------------------------------------------------------------------------------


def _grid(table: _Table, ends: dict[str, tuple[float, float]]) -> Plan:
    if max(table.counts) > POINTS:
        raise ImageError(f"a grid of {table.counts} points: the control's curves have {POINTS}")
    shifts: dict[tuple[str, str], Vertices] = {}
    levers: dict[tuple[str, str, str], Vertices] = {}
    worst = 0.0
    for i in AXES:
        parts = _Parts(table, i)
        worst = max(worst, parts.worst())
        shifts |= {(a, i): parts.vertices(a, parts.shift(a)) for a in AXES}
        levers |= {(a, k, i): parts.vertices(a, values) for (a, k), values in parts.levers.items()}
    if worst > GRID_TOLERANCE_LSB:
        raise ImageError(f"the grid is not a sum of shifts and of angles times lever arms: {worst:.1f} units are left at a node")
    return Plan(2, Network(shifts, levers, ends), worst_lsb=worst)


class _Parts:
    """Least-squares parts of one output of a grid: a mean, a function of each axis, and functions times a lever arm.

    Lever arms are measured from the middle of the grid, which makes the parts orthogonal, so that each is a projection. Only the product of
    two coordinates fits two parts; the first part keeps it.
    """

    def __init__(self, table: _Table, output: str) -> None:
        self.table = table
        nx, ny, nz = table.counts
        offset = AXES.index(output)
        nodes = product(range(nx), range(ny), range(nz))
        self.nodes = {(x, y, z): table.values[3 * ((z * ny + y) * nx + x) + offset] for x, y, z in nodes}
        self.mean = sum(self.nodes.values()) / len(self.nodes)
        middle = [sum(table.places_mm(n)) / table.counts[n] for n in range(3)]
        self.middle = dict(zip(AXES, middle, strict=True))
        self.arm = {a: [p - self.middle[a] for p in table.places_mm(n)] for n, a in enumerate(AXES)}
        self.base = {a: [v - self.mean for v in self._project(a)] for a in AXES}
        self.levers: dict[tuple[str, str], list[float]] = {}
        for a, k in ((a, k) for a, k, i in LEVERS if i == output):
            raw = self._project(a, k)
            level = sum(raw) / len(raw)
            self.levers[a, k] = self._without_product(a, k, [v - level for v in raw])

    def _project(self, a: str, k: str = "") -> list[float]:
        """Return the mean over the other axes at each position of axis ``a`` or, with ``k``, the slope along the lever arm ``k``."""
        n, m = AXES.index(a), AXES.index(k) if k else 0
        total = [0.0] * self.table.counts[n]
        for node, value in self.nodes.items():
            total[node[n]] += value * self.arm[k][node[m]] if k else value
        weight = len(self.nodes) / self.table.counts[n]
        if k:
            weight *= sum(u * u for u in self.arm[k]) / self.table.counts[m]
        return [t / weight for t in total]

    def _without_product(self, a: str, k: str, values: list[float]) -> list[float]:
        if (k, a) not in self.levers:
            return values
        arm = self.arm[a]
        slope = sum(v * u for v, u in zip(values, arm, strict=True)) / sum(u * u for u in arm)
        return [v - slope * u for v, u in zip(values, arm, strict=True)]

    def shift(self, a: str) -> list[float]:
        """Return the function of one axis, in LSB, for lever arms that are measured from the machine's zero."""
        total = [v + (self.mean if a == AXES[0] else 0.0) for v in self.base[a]]
        for (b, k), values in self.levers.items():
            if b == a:
                total = [t - self.middle[k] * v for t, v in zip(total, values, strict=True)]
        return total

    def vertices(self, a: str, values: list[float]) -> Vertices:
        """Convert values at the grid positions of an axis from LSB to mm (or mm per mm)."""
        return tuple((p, v * _LSB_MM) for p, v in zip(self.table.places_mm(AXES.index(a)), values, strict=True))

    def worst(self) -> float:
        """Return the largest difference between the grid and the sum of the parts at a node, LSB."""
        largest = 0.0
        for node, value in self.nodes.items():
            at = dict(zip(AXES, node, strict=True))
            model = self.mean + sum(self.base[a][at[a]] for a in AXES)
            model += sum(values[at[a]] * self.arm[k][at[k]] for (a, k), values in self.levers.items())
            largest = max(largest, abs(value - model))
        return largest
