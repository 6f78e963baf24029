"""Frames of the ball-bar's box from bytes, by the product and by what one would write first."""

from __future__ import annotations

import struct
import time
from binascii import crc_hqx

from abbe.drivers.api import BarSample
from abbe.drivers.ballbar.frames import Bad, FrameDecoder

BLOCK = 4096
"""Bytes per read, as a pty gives them."""
_TABLE = [0] * 256
for _byte in range(256):
    _crc = _byte << 8
    for _ in range(8):
        _crc = (_crc << 1) ^ 0x1021 if _crc & 0x8000 else _crc << 1
    _TABLE[_byte] = _crc & 0xFFFF


def stream(frames: int, *, noise_every: int = 0) -> bytes:
    """Samples one after the other; with noise, seven bytes of it before every n-th frame."""
    out = []
    for i in range(frames):
        body = struct.pack("<BBIQiH", 1, 18, i, 1000 * i, (i * 7919) % 400_000 - 200_000, 8)
        noise = b"\xa5\x5a\x01\x12\xff\x00\xa5" if noise_every and i % noise_every == 0 else b""
        out.append(noise + b"\xa5\x5a" + body + struct.pack("<H", crc_hqx(body, 0xFFFF)))
    return b"".join(out)


def ours(data: bytes) -> list[BarSample]:
    """The product's framer."""
    decoder, found = FrameDecoder(), []
    for at in range(0, len(data), BLOCK):
        found += [frame for frame in decoder.feed(data[at : at + BLOCK]) if not isinstance(frame, Bad)]
    return found


def per_frame(data: bytes) -> list[BarSample]:
    """A buffer from which one frame after the other is cut, with `struct` and the C check sum."""
    buffer, found = bytearray(), []
    for at in range(0, len(data), BLOCK):
        buffer += data[at : at + BLOCK]
        while True:
            begin = buffer.find(b"\xa5\x5a")
            if begin < 0:
                del buffer[:-1]
                break
            del buffer[:begin]
            if len(buffer) < 4 or (buffer[3] <= 32 and len(buffer) < buffer[3] + 6):
                break
            end = buffer[3] + 6
            if buffer[3] > 32 or crc_hqx(bytes(buffer[2 : end - 2]), 0xFFFF) != struct.unpack_from("<H", buffer, end - 2)[0]:
                del buffer[:2]
                continue
            if buffer[2] == 1:
                found.append(BarSample(*struct.unpack("<IQiH", buffer[4 : end - 2])))
            del buffer[:end]
    return found


def per_byte(data: bytes) -> list[BarSample]:
    """A state machine that looks at every byte, as in a microcontroller, with a table for the check sum."""
    found: list[BarSample] = []
    body, state, crc, size = bytearray(), 0, 0xFFFF, 0
    for byte in data:
        if state == 0:
            state = byte == 0xA5
        elif state == 1:
            state, body, crc, size = (2, bytearray(), 0xFFFF, 0) if byte == 0x5A else (int(byte == 0xA5), body, crc, size)
        elif state == 2:
            body.append(byte)
            crc = ((crc << 8) & 0xFFFF) ^ _TABLE[(crc >> 8) ^ byte]
            size = body[1] if len(body) == 2 else size
            state = 0 if size > 32 else 2 + (len(body) >= 2 and len(body) == size + 2)
        elif state == 3:
            low, state = byte, 4
        else:
            state = 0
            if low | byte << 8 == crc and body[0] == 1:
                found.append(BarSample(*struct.unpack("<IQiH", bytes(body[2:]))))
    return found


CONTESTANTS = {"ours": ours, "frame": per_frame, "byte": per_byte}


def framed(data: bytes) -> float:
    """Frames per second of the product's framer on one core."""
    began = time.process_time()
    found = ours(data)
    return len(found) / (time.process_time() - began)
