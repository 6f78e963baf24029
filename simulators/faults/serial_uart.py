"""What a serial receiver makes of bytes that were sent with another baud rate or parity: bits on a line, sampled at the wrong instants."""

from dataclasses import dataclass

PARITIES = ("none", "even", "odd")


@dataclass(frozen=True, slots=True)
class Uart:
    """Settings of one end of the line: 8 data bits, 1 stop bit."""

    baud: int
    parity: str = "none"


def heard(data: bytes, sender: Uart, receiver: Uart) -> bytes:
    """What the receiver reads when the bytes come one straight after the other; a frame without a stop bit reads as 0, as under Linux."""
    if sender == receiver:
        return data
    line = _bits(data, sender.parity)
    ratio = sender.baud / receiver.baud
    length = len(line) / ratio  # in bits of the receiver
    size = 10 + (receiver.parity != "none")
    out = bytearray()
    at = 0.0
    while at < length:
        if line[int(at * ratio)]:  # idle: look on in steps of a sixteenth of a bit, as receivers do
            at += 1.0 / 16.0
            continue
        taken = [_level(line, (at + k + 0.5) * ratio) for k in range(size)]
        out.append(sum(bit << k for k, bit in enumerate(taken[1:9])) if taken[-1] else 0)
        at += size - 0.5  # from the middle of the stop bit on, the next start bit may come
        while not taken[-1] and at < length and not line[int(at * ratio)]:
            at += 1.0 / 16.0  # a broken frame: the line has to be idle before the next one
    return bytes(out)


def _bits(data: bytes, parity: str) -> list[int]:
    bits: list[int] = []
    for byte in data:
        ones = [byte >> k & 1 for k in range(8)]
        check = [] if parity == "none" else [(sum(ones) + (parity == "odd")) % 2]
        bits += [0, *ones, *check, 1]
    return bits


def _level(line: list[int], at: float) -> int:
    return line[int(at)] if at < len(line) else 1
