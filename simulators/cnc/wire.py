"""Register map of the CNC controller (docs/protocols/cnc.md), encoded by its own struct code: big-endian, high word first."""

import struct
from collections.abc import Callable

import numpy as np

from abbe.simulators.cnc.bank import BANK_WORDS, LSB_NM
from abbe.simulators.cnc.compensation import CompResult
from abbe.simulators.cnc.device import FIFO_SIZE, Controller, Hold, Result
from abbe.simulators.cnc.log import HOLDS, Command, TableAccess

MAP_VERSION = 1
UNIT_MM = 1e-5  # positions count 10 nm
FEED_UNIT = 0.01  # mm/min

_IDENTITY = struct.Struct(">ifHIIHHHH3H")  # 0..15
_STATUS = struct.Struct(">QIHHHHiiiHIQQHQHHHiiiQH4x")  # 16..63
_COMP = struct.Struct(">H2I2HHHII3H")  # 208..223, with 3 words of padding
_MOTION_AT, _MOTION_WORDS = 64, 10
_HOLD_AT = 80
_FIFO_AT, _FIFO_POINTS = 96, 19
_COMP_STATUS_AT, _COMP_STATUS_WORDS = 208, 16
_COMP_AT, _COMP_WORDS = 230, 11
_BANKS_AT = (1000, 6000)


def words(data: bytes) -> list[int]:
    """Return bytes as big-endian registers."""
    return list(struct.unpack(f">{len(data) // 2}H", data))


class CncRegisters:
    """The controller seen through its registers.

    ``advance`` brings the world up to date; it is called before every request, so that a reply always shows the current state.
    """

    size = _BANKS_AT[1] + BANK_WORDS

    def __init__(self, controller: Controller, boot_id: int, advance: Callable[[], None]) -> None:
        self._cnc, self._boot_id, self._advance = controller, boot_id, advance
        self._motion = [0] * _MOTION_WORDS
        self._comp = [0] * _COMP_WORDS
        self._motion_ack, self._motion_result, self._motion_done = 0, Result.OK, 0
        self._waiting: tuple[int, int] | None = None  # (command number, value of motions_done that means finished)
        self._touch: int | None = None
        self._latch: tuple[int, ...] = (0, 0, 0, 0, 0)
        self._fifo_ack, self._fifo_result = 0, Result.OK
        self._comp_ack, self._comp_result = 0, CompResult.OK
        self.log: list[Command] = []
        """Every command that carried a new number, and every hold request, in order."""
        self.table_log: list[TableAccess] = []
        """Every attempt to change banks, active table or lease, in order, refused ones too."""

    # ---- reading -------------------------------------------------------------------------------------------------

    def read(self, address: int, count: int) -> list[int] | None:
        """Return the words of one read request, None for an illegal address."""
        self._advance()
        for number, base in enumerate(_BANKS_AT):
            if base <= address and address + count <= base + BANK_WORDS:
                return self._cnc.comp.words[number][address - base : address - base + count]
        for first, length, region in (
            (0, 64, self._identity_and_status),
            (_MOTION_AT, _MOTION_WORDS, lambda: self._motion),
            (_HOLD_AT, 1, lambda: [int(self._cnc.hold)]),
            (_COMP_STATUS_AT, _COMP_STATUS_WORDS, self._comp_status),
            (_COMP_AT, _COMP_WORDS, lambda: self._comp),
        ):
            if first <= address and address + count <= first + length:
                return region()[address - first : address - first + count]
        return None

    def _identity_and_status(self) -> list[int]:
        cnc = self._cnc
        identity = _IDENTITY.pack(
            0x01020304, 1234.5, MAP_VERSION, self._boot_id, cnc.comp.generation & 0xFFFFFFFF, 3, LSB_NM, BANK_WORDS, FIFO_SIZE, 0, 0, 0
        )
        status = _STATUS.pack(
            _us(cnc.now_s),
            self._status_bits(),
            cnc.alarm,
            self._motion_ack,
            self._motion_result,
            self._done_number(),
            *(round(float(p) / UNIT_MM) for p in cnc.position_mm),
            cnc.fifo_free,
            cnc.path_points_done,
            _us(cnc.path_start_s),
            _us(cnc.path_end_s),
            cnc.override_percent,
            _us(cnc.in_position_s),
            self._fifo_ack,
            self._fifo_result,
            *self._probe(),
        )
        return words(identity + status)

    def _status_bits(self) -> int:
        cnc, switches = self._cnc, self._cnc.switches
        bits = (
            switches.estop,
            switches.door_open,
            cnc.alarm != 0,
            switches.remote,
            switches.referenced,
            cnc.drives_on,
            cnc.moving,
            cnc.in_position,
            cnc.held,
            cnc.path_running,
            cnc.comp.kind != 0,
            switches.program_running,
            switches.spindle_turning,
        )
        return sum(1 << i for i, bit in enumerate(bits) if bit)

    def _probe(self) -> tuple[int, ...]:
        """Return PROBE_BITS, the latched position, its time, and the number of the touch that latched it."""
        cnc = self._cnc
        bits = int(cnc.probe_fitted()) | int(cnc.deflected()) << 1
        if self._touch is not None and self._done_number() == self._touch and cnc.latch_mm is not None:
            self._latch = (*(round(float(p) / UNIT_MM) for p in cnc.latch_mm), _us(cnc.latch_s), self._touch)
            self._touch = None
        return (bits, *self._latch)

    def _done_number(self) -> int:
        """Return the number of the last motion command that has finished."""
        if self._waiting is not None and self._cnc.motions_done >= self._waiting[1]:
            self._motion_done, self._waiting = self._waiting[0], None
        return self._motion_done

    def _comp_status(self) -> list[int]:
        comp, now_s = self._cnc.comp, self._cnc.now_s
        return words(
            _COMP.pack(
                comp.active,
                *comp.crcs,
                *comp.states,
                self._comp_ack,
                self._comp_result,
                comp.owner(now_s),
                comp.lease_left_ms(now_s),
                0,
                0,
                0,
            )
        )

    # ---- writing -------------------------------------------------------------------------------------------------

    def write(self, address: int, values: list[int]) -> bool:
        """Take one write request; False for an illegal address."""
        self._advance()
        end = address + len(values)
        for number, base in enumerate(_BANKS_AT):
            if base <= address and end <= base + BANK_WORDS:
                return self._take_bank(number, address - base, values)
        if address == _FIFO_AT and len(values) <= 2 + 6 * _FIFO_POINTS:
            self._take_fifo(values)
        elif address == _HOLD_AT and len(values) == 1:
            return self._take_hold(values[0])
        elif address >= _MOTION_AT and end <= _MOTION_AT + _MOTION_WORDS:
            self._motion[address - _MOTION_AT : end - _MOTION_AT] = values
            self._take_motion()
        elif address >= _COMP_AT and end <= _COMP_AT + _COMP_WORDS:
            self._comp[address - _COMP_AT : end - _COMP_AT] = values
            self._take_comp()
        else:
            return False
        return True

    def _take_bank(self, number: int, offset: int, values: list[int]) -> bool:
        """Write into a bank. The log also keeps refused writes, so that tests find hosts that write without permission."""
        comp = self._cnc.comp
        owner = comp.owner(self._cnc.now_s)
        taken = comp.write(number, offset, values)
        self._note_table("write", number, offset, tuple(values), 0, owner, taken=taken)
        return taken

    def _note_table(self, kind: str, bank: int, first: int, words: tuple[int, ...], by: int, owner: int, *, taken: bool) -> None:
        comp = self._cnc.comp
        self.table_log.append(TableAccess(self._cnc.now_s, kind, bank, first, words, by, taken, owner, comp.active, comp.generation))

    def _note(self, kind: str, *args: int) -> None:
        self.log.append(Command(self._cnc.now_s, kind, args, self._cnc.moving))

    def _take_hold(self, value: int) -> bool:
        if value not in tuple(Hold):
            return False
        self._note(HOLDS[value])
        self._cnc.request_hold(Hold(value))
        return True

    def _take_motion(self) -> None:
        """Execute the command in the motion registers if it carries the next command number."""
        number, command, x, y, z, feed = struct.unpack(">HHiiiI", struct.pack(f">{_MOTION_WORDS}H", *self._motion))
        if number != (self._motion_ack + 1) & 0xFFFF:
            return
        self._note({1: "move", 2: "path_clear", 3: "path_start", 4: "reset_alarm", 5: "touch"}.get(command, "?"), x, y, z, feed)
        self._probe()  # the number and the latch of an earlier motion must not be lost under this one
        done_before = self._cnc.motions_done
        speed = feed * FEED_UNIT
        result = Result.BAD_ARGUMENT
        if command == 1:
            result = self._cnc.move(np.array([x, y, z]) * UNIT_MM, speed)
        elif command == 2:
            result = self._cnc.path_clear()
        elif command == 3:
            result = self._cnc.path_start(speed)
        elif command == 4:
            result = self._cnc.reset_alarm()
        elif command == 5:
            result = self._cnc.touch(np.array([x, y, z]) * UNIT_MM, speed)
        self._touch = number if command == 5 and result == Result.OK else None
        self._motion_ack, self._motion_result = number, result
        if result == Result.OK and command in (1, 3, 5):
            self._waiting = (number, done_before + 1)
        elif result == Result.OK and not self._cnc.moving:
            self._motion_done, self._waiting = number, None  # finished as soon as it was executed

    def _take_fifo(self, values: list[int]) -> None:
        """Store a chunk of path points if it carries the next command number."""
        if values[0] != (self._fifo_ack + 1) & 0xFFFF:
            return
        self._note("fifo", *values[1:])
        count = values[1] if len(values) > 1 else 0
        result = Result.BAD_ARGUMENT
        if 1 <= count <= _FIFO_POINTS and len(values) == 2 + 6 * count:
            raw = np.frombuffer(struct.pack(f">{6 * count}H", *values[2:]), dtype=">i4")
            result = self._cnc.fifo_push(raw.astype(np.float64).reshape(-1, 3) * UNIT_MM)
        self._fifo_ack, self._fifo_result = values[0], result

    def _take_comp(self) -> None:
        """Execute the command in the compensation registers if it carries the next command number."""
        number, command, bank, crc, generation, owner, lease_ms = struct.unpack(">HHHIIII", struct.pack(f">{_COMP_WORDS}H", *self._comp))
        comp, now_s = self._cnc.comp, self._cnc.now_s
        holder = comp.owner(now_s)
        if number != (self._comp_ack + 1) & 0xFFFF:
            self._note_table("stale", bank, 0, (number, command), owner, holder, taken=False)
            return
        result = CompResult.BAD_ARGUMENT
        if command == 1:
            result = comp.seal(bank, owner, now_s)
        elif command == 2:
            may_act = self._cnc.may_move() and not self._cnc.moving
            result = comp.activate(bank, owner, (crc, generation), may_act=may_act, now_s=now_s)
        elif command == 3:
            result = comp.lease(owner, lease_ms, now_s)
        elif command == 4:
            result = comp.release(owner, now_s)
        self._comp_ack, self._comp_result = number, result
        kind = {1: "seal", 2: "activate", 3: "lease", 4: "release"}.get(command, "?")
        self._note_table(kind, bank, 0, (number, int(result)), owner, holder, taken=result == CompResult.OK)


def _us(time_s: float) -> int:
    """Return seconds as whole microseconds."""
    return round(time_s * 1e6)
