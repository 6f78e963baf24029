"""A second, independent decoder of compensation images, for the read-back before activation.

Written from docs/protocols/cnc.md independently of ``tables.py`` and deliberately in another way (register by register, plain arithmetic,
no struct, no zlib): a mistake in sign, unit or order in one decoder shows as a difference between the two.
"""

from __future__ import annotations

AXES = ("X", "Y", "Z")
_FIRST_BODY_REGISTER = 24

AxisTables = dict[tuple[str, str], list[tuple[float, float]]]


class UnreadableImage(ValueError):  # noqa: N818 - reads as what it is
    """The bytes are not an image as docs/protocols/cnc.md defines it."""


def read_axis_tables(data: bytes) -> AxisTables:
    """Read the nine one-axis tables of an image.

    Returns
    -------
    dict
        (input axis, corrected axis) -> list of (position in mm, correction in mm added to the command). Empty for kind 0 (no correction).

    Raises
    ------
    UnreadableImage
        Not an image of kind 0 or 1.
    """
    kind = _header(data)
    if kind == 0:
        return {}
    if kind != 1:
        raise UnreadableImage(f"register 2 says kind {kind}, not one-axis tables")
    tables: AxisTables = {}
    register = _FIRST_BODY_REGISTER
    for axis, name_in in enumerate(AXES):
        for name_out in AXES:
            tables[name_in, name_out] = [(_grid_mm(data, axis, i), _correction_mm(data, register + i)) for i in range(_points(data, axis))]
            register += _points(data, axis)
    _ends_at(data, register)
    return tables


def read_grid(data: bytes) -> dict[tuple[float, float, float], tuple[float, float, float]]:
    """Read the 3-D grid of an image of kind 2.

    Returns
    -------
    dict
        (x, y, z) of a node in mm -> correction (x, y, z) in mm added to the command.

    Raises
    ------
    UnreadableImage
        Not an image of kind 2.
    """
    kind = _header(data)
    if kind != 2:
        raise UnreadableImage(f"register 2 says kind {kind}, not a grid")
    nodes = {}
    register = _FIRST_BODY_REGISTER
    for iz in range(_points(data, 2)):
        for iy in range(_points(data, 1)):
            for ix in range(_points(data, 0)):
                node = (_grid_mm(data, 0, ix), _grid_mm(data, 1, iy), _grid_mm(data, 2, iz))
                nodes[node] = (_correction_mm(data, register), _correction_mm(data, register + 1), _correction_mm(data, register + 2))
                register += 3
    _ends_at(data, register)
    return nodes


def plain_crc32(data: bytes) -> int:
    """Compute the CRC-32 of the image bit by bit."""
    crc = 0xFFFFFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc // 2 ^ 0xEDB88320 if crc % 2 else crc // 2
    return 0xFFFFFFFF - crc


def _register(data: bytes, number: int) -> int:
    if 2 * number + 1 >= len(data):
        raise UnreadableImage(f"register {number} is beyond the end of the image")
    return data[2 * number] * 256 + data[2 * number + 1]


def _signed_32(data: bytes, number: int) -> int:
    value = _register(data, number) * 65536 + _register(data, number + 1)
    return value - 4294967296 if value >= 2147483648 else value


def _points(data: bytes, axis: int) -> int:
    return _register(data, 8 + axis)


def _grid_mm(data: bytes, axis: int, index: int) -> float:
    return (_signed_32(data, 12 + 2 * axis) + index * _signed_32(data, 18 + 2 * axis)) * 10 / 1_000_000


def _correction_mm(data: bytes, number: int) -> float:
    value = _register(data, number)
    if value >= 32768:
        value -= 65536
    return value * _register(data, 6) / 1_000_000


def _header(data: bytes) -> int:
    if _register(data, 0) != 0xABBE or _register(data, 1) != 1:
        raise UnreadableImage("registers 0 and 1 do not hold ABBE (hexadecimal) and 1, the mark of an image")
    if _register(data, 3) * 2 != len(data):
        raise UnreadableImage(f"register 3 says {_register(data, 3)} registers, there are {len(data) / 2:g}")
    kind = _register(data, 2)
    for axis in range(3):
        if kind != 0 and (_points(data, axis) < 2 or _signed_32(data, 18 + 2 * axis) <= 0):
            raise UnreadableImage(f"the grid of {AXES[axis]} has no extent")
    _register(data, _FIRST_BODY_REGISTER - 1)
    return kind


def _ends_at(data: bytes, register: int) -> None:
    if 2 * register != len(data):
        raise UnreadableImage(f"the tables end at register {register}, the image at {len(data) // 2}")
