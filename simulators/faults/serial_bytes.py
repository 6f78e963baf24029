"""Effects of a bad line on bytes and frames of the ball-bar's box: pure functions; random values come from the caller's generator."""

import random
import struct
from collections.abc import Iterator
from dataclasses import dataclass

from abbe.simulators.ballbar.wire import SAMPLE, SYNC_BYTES, encode

_SAMPLE = struct.Struct("<IQiH")
_OVERHEAD = 6


@dataclass(frozen=True, slots=True)
class Sample:
    """Content of a SAMPLE frame."""

    seq: int
    device_us: int
    reading_nm: int
    status: int

    def frame(self) -> bytes:
        """Return the sample as the bytes of a frame."""
        return encode(SAMPLE, _SAMPLE.pack(self.seq & 0xFFFFFFFF, self.device_us, self.reading_nm, self.status))


def sample_of(frame: bytes) -> Sample | None:
    """Return the content of a whole frame; None if it is not a SAMPLE."""
    return Sample(*_SAMPLE.unpack_from(frame, 4)) if frame[2] == SAMPLE else None


def cut(data: bytes) -> list[bytes]:
    """Split undamaged bytes into frames, as the box writes them."""
    found, at = [], 0
    while at < len(data):
        end = at + data[at + 3] + _OVERHEAD
        found.append(data[at:end])
        at = end
    return found


def garbage(kind: str, size: int, draw: random.Random) -> bytes:
    """Return ``size`` bytes that are not a frame: ``random``, all ``ones``, ``sync`` bytes or a ``header`` with payload length 255."""
    if kind == "random":
        return draw.randbytes(size)
    if kind == "ones":
        return b"\xff" * size
    if kind == "sync":
        return (SYNC_BYTES * (size // 2 + 1))[:size]
    return (SYNC_BYTES + b"\x01\xff" + draw.randbytes(size))[:size]


def flipped(frame: bytes, *bits: int) -> bytes:
    """Return the frame with these bits flipped (bit 0 is the lowest of the first byte)."""
    damaged = bytearray(frame)
    for bit in bits:
        damaged[bit // 8] ^= 1 << bit % 8
    return bytes(damaged)


def burst(frame: bytes, draw: random.Random) -> bytes:
    """Return the frame after an electric burst: two to six bytes in a row are changed."""
    size = draw.randint(2, 6)
    at = draw.randrange(len(frame) - size)
    other = bytes(byte ^ draw.randint(1, 255) for byte in frame[at : at + size])
    return frame[:at] + other + frame[at + size :]


def every_nth(frames: list[bytes], n: int, draw: random.Random) -> Iterator[bytes]:
    """Yield all frames; a burst hits every n-th of them (the n-th, the 2n-th ...)."""
    for number, frame in enumerate(frames, 1):
        yield burst(frame, draw) if number % n == 0 else frame


def repeated(frames: list[bytes], at: int, count: int) -> list[bytes]:
    """Send the ``count`` frames before frame ``at`` twice; return all frames in the new order."""
    return frames[:at] + frames[max(0, at - count) : at] + frames[at:]


def delayed(frames: list[bytes], at: int, by: int) -> list[bytes]:
    """Return the frames with frame ``at`` moved ``by`` places back."""
    rest = frames[:at] + frames[at + 1 :]
    return [*rest[: at + by], frames[at], *rest[at + by :]]


def swapped(frames: list[bytes], at: int, distance: int) -> list[bytes]:
    """Return the frames with frames ``at`` and ``at + distance`` swapped."""
    out = list(frames)
    out[at], out[at + distance] = out[at + distance], out[at]
    return out


def sliced(data: bytes, size: int) -> Iterator[bytes]:
    """Yield the bytes in pieces of ``size``."""
    for at in range(0, len(data), size):
        yield data[at : at + size]
