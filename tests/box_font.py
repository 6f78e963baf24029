"""A font whose every character is the same box, made of bytes here: with it a page is laid out alike on machines with other fonts."""

from __future__ import annotations

import struct

EM, WIDE, HIGH, LOW = 1000, 500, 800, -200
BOX, EMPTY = 1, 2


def _cmap() -> bytes:
    """Format 13: ranges of characters with one glyph each."""
    groups = [(0x20, 0x20, EMPTY), (0x21, 0x9F, BOX), (0xA0, 0xA0, EMPTY), (0xA1, 0x10FFFF, BOX)]
    body = struct.pack(">HHIII", 13, 0, 16 + 12 * len(groups), 0, len(groups)) + b"".join(struct.pack(">III", *one) for one in groups)
    return struct.pack(">HHHHI", 0, 1, 3, 10, 12) + body


def _glyph() -> bytes:
    """A rectangle from the line up to 0.7 em, 0.4 em wide."""
    x, y = (50, 0, 400, 0), (0, 700, 0, -700)
    head = struct.pack(">hhhhhHH", 1, 50, 0, 450, 700, 3, 0)
    return head + bytes([1] * 4) + struct.pack(">4h", *x) + struct.pack(">4h", *y)


def _names() -> bytes:
    texts = {1: "Box", 2: "Regular", 3: "Box", 4: "Box", 6: "Box"}
    records, data = b"", b""
    for key, text in texts.items():
        raw = text.encode("utf-16-be")
        records += struct.pack(">HHHHHH", 3, 1, 0x409, key, len(raw), len(data))
        data += raw
    return struct.pack(">HHH", 0, len(texts), 6 + len(records)) + records + data


def box_font() -> bytes:
    """The font as a TrueType file."""
    glyph = _glyph()
    os2 = struct.pack(">HhHHHhhhhhhhhhhh", 4, WIDE, 400, 5, 0, *[0] * 10, 0) + bytes(10) + struct.pack(">4I", 0, 0, 0, 0) + b"NONE"
    os2 += struct.pack(">HHHhhhHHIIhhHHH", 0x40, 0x20, 0xFFFF, HIGH, LOW, 0, HIGH, -LOW, 1, 0, 500, 700, 0, 0x20, 0)
    tables = {
        b"OS/2": os2,
        b"cmap": _cmap(),
        b"glyf": glyph,
        b"head": struct.pack(">IIIIHHqqhhhhHHhhh", 0x10000, 0x10000, 0, 0x5F0F3CF5, 0, EM, 0, 0, 50, 0, 450, 700, 0, 8, 2, 1, 0),
        b"hhea": struct.pack(">IhhhHhhhhhhhhhhhH", 0x10000, HIGH, LOW, 0, WIDE, 0, 0, 450, 1, 0, 0, 0, 0, 0, 0, 0, 1),
        b"hmtx": struct.pack(">Hhhh", WIDE, 0, 50, 0),
        b"loca": struct.pack(">4I", 0, 0, len(glyph), len(glyph)),
        b"maxp": struct.pack(">IHHHHHHHHHHHHHH", 0x10000, 3, 4, 1, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0),
        b"name": _names(),
        b"post": struct.pack(">IIhhIIIII", 0x30000, 0, -100, 50, 0, 0, 0, 0, 0),
    }
    head, data, offset = b"", b"", 12 + 16 * len(tables)
    for tag, table in tables.items():
        padded = table + bytes(-len(table) % 4)
        head += struct.pack(">4sIII", tag, sum(struct.unpack(f">{len(padded) // 4}I", padded)) & 0xFFFFFFFF, offset + len(data), len(table))
        data += padded
    return struct.pack(">IHHHH", 0x10000, len(tables), 128, 3, 16 * len(tables) - 128) + head + data
