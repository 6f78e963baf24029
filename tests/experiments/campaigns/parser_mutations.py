"""Frames spoilt in every way we know, fed to the parsers, and what must hold afterwards. Seeded: the same seed spoils the same frames.

Parsers: the ball-bar's framer, replies on Modbus TCP and RTU (our comparison, then the library's framer), and the register maps of laser
and controller.
"""

from __future__ import annotations

import random
import struct
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field

from abbe.drivers.ballbar.frames import Bad, FrameDecoder
from abbe.drivers.cnc import registers as cnc
from abbe.drivers.laser import driver as laser
from abbe.drivers.links.words import RegisterBlock, words_of
from abbe.simulators.ballbar.device import Settings
from abbe.simulators.ballbar.wire import encode_ack, encode_info, encode_settings
from abbe.simulators.faults.serial_bytes import Sample, flipped
from tests.faults.modbus_bytes import COUNT, reply, request, taken
from tests.faults.rows_serial import MBAP_CHECKED

SHARES = {"ball-bar": 0.7, "rtu": 0.1, "mbap": 0.1, "registers": 0.1}
BEHIND = 3
"""Honest frames behind every spoilt one. A false frame that passes its check sum by chance (1 in 65,536) swallows up to two of them; the
third must be there."""
BLOCKS = tuple(block for module in (laser, cnc) for block in vars(module).values() if isinstance(block, RegisterBlock))


@dataclass
class Tally:
    """What was seen.

    ``swallowed``: the first honest frame behind was not delivered (a false one passed its check sum and took it along);
    ``false``: frames taken that nobody sent (several wrong bits that a check sum cannot see, and on TCP every change of a register);
    ``slowest_s``: CPU seconds of one spoilt frame with those behind it. The others have to stay at zero.
    """

    frames: int = 0
    false: int = 0
    crashes: int = 0
    not_resynchronised: int = 0
    single_bit_accepted: int = 0
    kept_too_much: int = 0
    swallowed: int = 0
    slowest_s: float = 0.0
    ways: Counter[str] = field(default_factory=Counter)
    first_crash: str = ""

    def good(self) -> bool:
        """No crash, every stream resynchronised, no single-bit error accepted."""
        return not (self.crashes or self.not_resynchronised or self.single_bit_accepted or self.kept_too_much)


def _one_bit(draw: random.Random, frame: bytes, other: bytes) -> bytes:
    return flipped(frame, draw.randrange(8 * len(frame)))


def _bits(draw: random.Random, frame: bytes, other: bytes) -> bytes:
    return flipped(frame, *{draw.randrange(8 * len(frame)) for _ in range(draw.randint(2, 5))})


def _cut(draw: random.Random, frame: bytes, other: bytes) -> bytes:
    return frame[: draw.randrange(len(frame))]


def _headless(draw: random.Random, frame: bytes, other: bytes) -> bytes:
    return frame[draw.randrange(1, len(frame)) :]


def _inserted(draw: random.Random, frame: bytes, other: bytes) -> bytes:
    at = draw.randrange(len(frame))
    return frame[:at] + draw.randbytes(draw.choice((1, 2, 7, 40))) + frame[at:]


def _burst(draw: random.Random, frame: bytes, other: bytes) -> bytes:
    at = draw.randrange(len(frame) - 1)
    return frame[:at] + draw.randbytes(draw.randint(2, 6)) + frame[at + 4 :]


def _spliced(draw: random.Random, frame: bytes, other: bytes) -> bytes:
    at = draw.randrange(1, len(frame))
    return frame[:at] + other[min(at, len(other) - 1) :]


def _false_head(draw: random.Random, frame: bytes, other: bytes) -> bytes:
    return frame[:2] + bytes((draw.randrange(256), draw.randrange(256))) + draw.randbytes(draw.randrange(40)) + frame


def _noise(draw: random.Random, frame: bytes, other: bytes) -> bytes:
    return draw.randbytes(draw.randrange(1, 60))


def _sync_rain(draw: random.Random, frame: bytes, other: bytes) -> bytes:
    return frame[:2] * draw.randint(1, 30) + draw.randbytes(1)


Way = Callable[[random.Random, bytes, bytes], bytes]
WAYS: tuple[Way, ...] = (_one_bit, _bits, _cut, _headless, _inserted, _burst, _spliced, _false_head, _noise, _sync_rain)


def spoil(count: int, seed: int, progress: Callable[[int], None] = lambda done: None) -> dict[str, Tally]:
    """Spoil ``count`` frames in all and say, per parser, what came of it."""
    found: dict[str, Tally] = {}
    done = 0
    for name, share in SHARES.items():
        draw, tally = random.Random(f"{name} {seed}"), Tally()
        one = PLAYERS[name](draw)
        for _ in range(round(count * share)):
            began = time.thread_time()
            try:
                one(draw, tally)
            except Exception as error:  # noqa: BLE001 - any exception of a parser is what is looked for
                tally.crashes += 1
                tally.first_crash = tally.first_crash or repr(error)
            tally.slowest_s = max(tally.slowest_s, time.thread_time() - began)
            tally.frames += 1
            done += 1
            if not done % 10_000:
                progress(done)
        found[name] = tally
    return found


def _ballbar(draw: random.Random) -> Callable[[random.Random, Tally], None]:
    samples = [Sample(i, 1000 * i, draw.randint(-(10**6), 10**6), draw.randrange(1 << 16)).frame() for i in range(400)]
    others = [encode_info(i, draw.getrandbits(32), 1000) for i in range(40)] + [encode_ack(i, 0x82, i % 3) for i in range(40)]
    pool = samples + others + [encode_settings(i, Settings(i + 1)) for i in range(20)]
    behind = samples[:BEHIND]
    true = FrameDecoder().feed(b"".join(behind))
    tail = b"".join(behind)
    honest = set(FrameDecoder().feed(b"".join(pool)))

    def one(draw: random.Random, tally: Tally) -> None:
        way = WAYS[draw.randrange(len(WAYS))]
        frame = pool[draw.randrange(len(pool))]
        spoilt = way(draw, frame, pool[draw.randrange(len(pool))])
        tally.ways[way.__name__] += 1
        decoder = FrameDecoder()
        found = [f for f in decoder.feed(spoilt + tail) if not isinstance(f, Bad)]
        tally.kept_too_much += decoder.pending > 37
        tally.not_resynchronised += true[-1] not in found
        tally.swallowed += true[0] not in found
        tally.false += any(f not in honest for f in found)
        tally.single_bit_accepted += way is _one_bit and found != true

    return one


def _modbus(draw: random.Random, *, rtu: bool) -> Callable[[random.Random, Tally], None]:
    asked = request(rtu=rtu)
    answers = [tuple(draw.randrange(1 << 16) for _ in range(COUNT)) for _ in range(100)]
    whole = [reply(registers, rtu=rtu) for registers in answers]
    honest = set(answers)

    def one(draw: random.Random, tally: Tally) -> None:
        way = WAYS[draw.randrange(len(WAYS))]
        number = draw.randrange(len(whole))
        frame = whole[number]
        spoilt = way(draw, frame, whole[draw.randrange(len(whole))])
        tally.ways[way.__name__] += 1
        heard = taken(asked, spoilt, rtu=rtu)
        false = heard is not None and heard not in honest
        # on TCP the registers themselves have no check sum but TCP's: a change there is an honest other answer
        checked = rtu or spoilt[:MBAP_CHECKED] != frame[:MBAP_CHECKED]
        tally.false += false
        tally.single_bit_accepted += way is _one_bit and heard is not None and checked
        tally.not_resynchronised += taken(asked, frame, rtu=rtu) != answers[number]

    return one


def _registers(draw: random.Random) -> Callable[[random.Random, Tally], None]:
    def one(draw: random.Random, tally: Tally) -> None:
        block = BLOCKS[draw.randrange(len(BLOCKS))]
        off = draw.choice((0, 0, 0, 0, 1, -1, 5))
        words = words_of(draw.randbytes(2 * max(0, block.count + off)))
        try:
            counts = block.counts(words)
        except ValueError:
            tally.crashes += len(words) == block.count
            return
        tally.false += len(words) != block.count  # a block that was cut off must never be decoded
        for register in block.registers:
            again = struct.pack(f">{'qQ'[register.kind[0] == 'u']}", counts[register.name])
            at, size = register.address - block.base, int(register.kind[1:]) // 16
            tally.not_resynchronised += words_of(again)[-size:] != words[at : at + size]

    return one


PLAYERS: dict[str, Callable[[random.Random], Callable[[random.Random, Tally], None]]] = {
    "ball-bar": _ballbar,
    "rtu": lambda draw: _modbus(draw, rtu=True),
    "mbap": lambda draw: _modbus(draw, rtu=False),
    "registers": _registers,
}
