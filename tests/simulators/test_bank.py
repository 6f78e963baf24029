"""Compensation images, written here by hand from docs/protocols/cnc.md."""

import struct
import zlib

import numpy as np
import pytest

from abbe.simulators.cnc.bank import ImageError, checksum, empty_image, parse


def image(kind: int, counts, start, step, body, *, length: int | None = None, magic=0xABBE, fmt=1, lsb=100) -> list[int]:
    size = 24 + len(body) if length is None else length
    data = struct.pack(">4HIHH3HH", magic, fmt, kind, size, 77, lsb, 0, *counts, 0) + struct.pack(">3i3i", *start, *step)
    data += struct.pack(f">{len(body)}h", *body)
    return list(struct.unpack(f">{len(data) // 2}H", data))


AXIS_BODY = [
    *(10, 20, 30), *(1, 2, 3), *(0, 0, -5),  # X: outputs X, Y, Z at 3 points
    *(100, 200), *(0, 0), *(0, 0),  # Y at 2 points
    *(0, 0), *(0, 0), *(7, -7),  # Z at 2 points
]  # fmt: skip


def test_kind_1_adds_nine_tables() -> None:
    kind, correction = parse(image(1, (3, 2, 2), (0, 0, -1_000_000), (10_000_000, 50_000_000, 1_000_000), AXIS_BODY))
    assert kind == 1
    command = np.array([[0.0, 0.0, -10.0], [150.0, 250.0, -5.0], [900.0, 900.0, 900.0], [-5.0, -5.0, -50.0]])
    um = correction(command) * 1000.0
    expected = [
        [1.0 + 10.0, 0.1, 0.7],
        [2.5 + 15.0, 0.25, -0.25 + 0.0],
        [3.0 + 20.0, 0.3, -0.5 - 0.7],  # end values held
        [1.0 + 10.0, 0.1, 0.7],
    ]
    np.testing.assert_allclose(um, expected, atol=1e-9)


def test_kind_2_is_trilinear() -> None:
    nx, ny, nz = 3, 2, 2
    nodes = np.random.default_rng(3).integers(-500, 500, (nz, ny, nx, 3))
    body = [0] * (3 * nx * ny * nz)
    for iz, iy, ix, i in np.ndindex(nodes.shape):
        body[3 * ((iz * ny + iy) * nx + ix) + i] = int(nodes[iz, iy, ix, i])
    kind, correction = parse(image(2, (nx, ny, nz), (0, 0, 0), (30_000_000, 50_000_000, 45_000_000), body))
    assert kind == 2
    middle = correction(np.array([[150.0, 250.0, 225.0]]))[0]
    np.testing.assert_allclose(middle, nodes[:, :, :2].mean(axis=(0, 1, 2)) * 1e-4, atol=1e-12)
    corner = correction(np.array([[600.0, 500.0, 0.0], [700.0, 800.0, -9.0]]))
    np.testing.assert_allclose(corner, np.tile(nodes[0, 1, 2] * 1e-4, (2, 1)), atol=1e-12)


def test_kind_0_and_its_crc() -> None:
    words = empty_image()
    kind, correction = parse(words)
    assert kind == 0
    assert not correction(np.ones((2, 3))).any()
    assert checksum([*words, 9, 9]) == zlib.crc32(struct.pack(">24H", *words))


@pytest.mark.parametrize(
    "bad",
    [
        {"magic": 0xABBF},
        {"fmt": 2},
        {"lsb": 1000},
        {"kind": 3},
        {"length": 44},
        {"counts": (3, 2, 1)},
        {"step": (10, 0, 10)},
        {"step": (10, -5, 10)},
    ],
)
def test_invalid_images(bad: dict) -> None:
    good = {"kind": 1, "counts": (3, 2, 2), "start": (0, 0, 0), "step": (10, 10, 10), "body": AXIS_BODY}
    parse(image(**good))
    with pytest.raises(ImageError):
        parse(image(**{**good, **bad}))


def test_a_body_cut_short_is_invalid() -> None:
    with pytest.raises(ImageError):
        parse(image(1, (3, 2, 2), (0, 0, 0), (10, 10, 10), AXIS_BODY)[:-1])
    with pytest.raises(ImageError):
        parse([0xABBE])
