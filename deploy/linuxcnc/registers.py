"""The register map of docs/protocols/cnc.md: converts words to commands, and the state to words."""

from __future__ import annotations

import struct
import time

from banks import Banks
from banks import Result as CompResult
from image import BANK_WORDS, LSB_NM
from motion import FIFO_SIZE, Hold, Motion, Result

_UNIT_MM = 1e-5
_FEED_UNIT = 0.01
_CHUNK = 19
_BANKS_AT = (1000, 6000)
_MOTION_AT, _HOLD_AT, _FIFO_AT, _COMP_STATUS_AT, _COMP_AT = 64, 80, 96, 208, 230
_MOTION_WORDS, _COMP_WORDS = 10, 11
_U16, _U32 = 0xFFFF, 0xFFFFFFFF


def _words(layout: str, *values: float) -> list[int]:
    data = struct.pack(layout, *values)
    return list(struct.unpack(f">{len(data) // 2}H", data))


class Clock:
    """Time since the bridge's start."""

    def __init__(self) -> None:
        self._start_s = time.monotonic()

    def seconds(self) -> float:
        """Time in seconds."""
        return time.monotonic() - self._start_s

    def microseconds(self) -> int:
        """Time in whole microseconds."""
        return int(self.seconds() * 1e6)


class RegisterMap:
    """The control, seen through its registers.

    Parameters
    ----------
    motion, banks : Motion, Banks
        Motion and banks that the registers command and show.
    clock : Clock
        Controller time.
    boot_id : int
        Boot id, new at every start.
    """

    def __init__(self, motion: Motion, banks: Banks, clock: Clock, boot_id: int) -> None:
        self._motion, self._banks, self._clock, self._boot_id = motion, banks, clock, boot_id
        self._ack, self._result, self._done = 0, Result.OK, 0
        self._waits: tuple[int, int] | None = None  # number of the motion under way, count of finished motions that ends it
        self._touch: int | None = None
        self._latch = (0, 0, 0, 0, 0)
        self._fifo_ack, self._fifo_result = 0, Result.OK
        self._comp_ack, self._comp_result = 0, CompResult.OK
        self._motion_words, self._comp_words = [0] * _MOTION_WORDS, [0] * _COMP_WORDS

    # ---- reading -----------------------------------------------------------------------------------------------------------------

    def read(self, address: int, count: int) -> list[int] | None:
        """Return the words of one read request; None for addresses that do not exist."""
        for bank, base in enumerate(_BANKS_AT):
            if base <= address and address + count <= base + BANK_WORDS:
                return self._banks.words[bank][address - base : address - base + count]
        for base, size, block in (
            (0, 64, self._status),
            (_MOTION_AT, _MOTION_WORDS, lambda: self._motion_words),
            (_HOLD_AT, 1, lambda: [int(self._motion.hold)]),
            (_COMP_STATUS_AT, 16, self._comp_status),
            (_COMP_AT, _COMP_WORDS, lambda: self._comp_words),
        ):
            if base <= address and address + count <= base + size:
                return block()[address - base : address - base + count]
        return None

    def _status(self) -> list[int]:
        motion = self._motion
        motion.tick()
        gen = self._banks.generation & _U32
        identity = _words(">ifHIIHHHH6x", 0x01020304, 1234.5, 1, self._boot_id, gen, 3, LSB_NM, BANK_WORDS, FIFO_SIZE)
        head = _words(">QIHHHH", self._clock.microseconds(), self._bits(), motion.alarm, self._ack, self._result, self._done_number())
        where = _words(">3iHI", *(round(p / _UNIT_MM) for p in motion.state.position_mm), motion.fifo_free, motion.points_done)
        times = _words(">QQHQ", motion.path_start_us, motion.path_end_us, motion.state.override_percent, motion.in_position_us)
        return identity + head + where + times + _words(">HH", self._fifo_ack, self._fifo_result) + self._probe()

    def _probe(self) -> list[int]:
        state = self._motion.state
        if self._touch is not None and self._done_number() == self._touch and self._motion.latch is not None:
            position_mm, at_us = self._motion.latch
            self._latch = (*(round(p / _UNIT_MM) for p in position_mm), at_us, self._touch)
            self._touch = None
        return _words(">H3iQHH2x", state.probe_ready | state.deflected << 1, *self._latch, self._motion.latch_period_us)

    def _bits(self) -> int:
        motion, state = self._motion, self._motion.state
        bits = (
            state.estop,
            state.door_open,
            motion.alarm != 0,
            state.remote,
            state.homed,
            state.drives_on,
            motion.moving,
            state.in_position and not motion.moving,
            motion.held,
            motion.path_running,
            self._banks.plan.kind != 0,
            motion.program_running,
            state.spindle,
        )
        return sum(1 << n for n, bit in enumerate(bits) if bit)

    def _done_number(self) -> int:
        if self._waits is not None and self._motion.done >= self._waits[1]:
            self._done, self._waits = self._waits[0], None
        return self._done

    def _comp_status(self) -> list[int]:
        banks, now_s = self._banks, self._clock.seconds()
        lease = (banks.owner(now_s), banks.lease_left_ms(now_s) & _U32)
        return _words(">H2I2HHHII6x", banks.active, *banks.crcs, *banks.states, self._comp_ack, self._comp_result, *lease)

    # ---- writing -----------------------------------------------------------------------------------------------------------------

    def write(self, address: int, words: list[int]) -> bool:
        """Execute one write request; return False for addresses that cannot be written."""
        end = address + len(words)
        for bank, base in enumerate(_BANKS_AT):
            if base <= address and end <= base + BANK_WORDS:
                return self._banks.write(bank, address - base, words)
        if address == _FIFO_AT and len(words) <= 2 + 6 * _CHUNK:
            self._take_chunk(words)
        elif address == _HOLD_AT and len(words) == 1 and words[0] in tuple(Hold):
            self._motion.request_hold(Hold(words[0]))
        elif address >= _MOTION_AT and end <= _MOTION_AT + _MOTION_WORDS:
            self._motion_words[address - _MOTION_AT : end - _MOTION_AT] = words
            self._take_motion()
        elif address >= _COMP_AT and end <= _COMP_AT + _COMP_WORDS:
            self._comp_words[address - _COMP_AT : end - _COMP_AT] = words
            self._take_comp()
        else:
            return False
        return True

    def _take_motion(self) -> None:
        number, command, x, y, z, feed = struct.unpack(">HHiiiI", struct.pack(f">{_MOTION_WORDS}H", *self._motion_words))
        if number != (self._ack + 1) & _U16:
            return
        self._motion.tick()
        self._probe()  # an earlier motion that has ended meanwhile, and its latch, must not be lost under this number
        self._done_number()
        before, feed_mm_min = self._motion.done, feed * _FEED_UNIT
        result = Result.BAD_ARGUMENT
        if command == 1:
            result = self._motion.move((x * _UNIT_MM, y * _UNIT_MM, z * _UNIT_MM), feed_mm_min)
        elif command == 2:
            result = self._motion.path_clear()
        elif command == 3:
            result = self._motion.path_start(feed_mm_min)
        elif command == 4:
            result = self._motion.reset_alarm()
        elif command == 5:
            result = self._motion.touch((x * _UNIT_MM, y * _UNIT_MM, z * _UNIT_MM), feed_mm_min)
        self._touch = number if command == 5 and result == Result.OK else None
        self._ack, self._result = number, result
        if result == Result.OK and command in (1, 3, 5):
            self._waits = (number, before + 1)
        elif result == Result.OK:
            self._done, self._waits = number, None

    def _take_chunk(self, words: list[int]) -> None:
        if words[0] != (self._fifo_ack + 1) & _U16:
            return
        count = words[1] if len(words) > 1 else 0
        result = Result.BAD_ARGUMENT
        if 1 <= count <= _CHUNK and len(words) == 2 + 6 * count:
            flat = struct.unpack(f">{3 * count}i", struct.pack(f">{6 * count}H", *words[2:]))
            triples = [tuple(v * _UNIT_MM for v in flat[n : n + 3]) for n in range(0, len(flat), 3)]
            result = self._motion.push(triples)
        self._fifo_ack, self._fifo_result = words[0], result

    def _take_comp(self) -> None:
        fields = struct.unpack(">HHHIIII", struct.pack(f">{_COMP_WORDS}H", *self._comp_words))
        number, command, bank, crc, gen, owner, lease_ms = fields
        if number != (self._comp_ack + 1) & _U16:
            return
        banks, now_s = self._banks, self._clock.seconds()
        result = CompResult.BAD_ARGUMENT
        if command == 1:
            result = banks.seal(bank, owner, now_s)
        elif command == 2:
            self._motion.tick()
            stands = self._motion.may_move() and not self._motion.moving
            result = banks.activate(bank, owner, (crc, gen), may_act=stands, now_s=now_s)
        elif command == 3:
            result = banks.lease(owner, lease_ms, now_s)
        elif command == 4:
            result = banks.release(owner, now_s)
        self._comp_ack, self._comp_result = number, result
