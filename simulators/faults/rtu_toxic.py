"""A Modbus RTU device on a pty whose line plays a scenario: late, doubled, cut, noisy replies, echoes, a second master."""

import asyncio
from pathlib import Path

from abbe.simulators.faults.modbus_toxics import RTU, Act, Cutter, Frame, Toxics, answer, parts
from abbe.simulators.faults.scenario import FaultScenario
from abbe.simulators.modbus_wire import RegisterMap
from abbe.simulators.pseudo_serial import PseudoSerial

BAUD = 115200


class ToxicRtuLine:
    """A register map at the end of a bad line. Like a device on a real line it handles one request at a time.

    Parameters
    ----------
    registers : RegisterMap
        Registers of the device.
    scenario : FaultScenario
        ``play`` replaces it at run time.
    link : Path, optional
        Stable path of the host's terminal.
    unit : int
        Unit number; requests to other units get no answer.
    """

    def __init__(self, registers: RegisterMap, scenario: FaultScenario | None = None, link: Path | None = None, unit: int = 1) -> None:
        self._registers, self._unit = registers, unit
        self._link = link
        self._host: PseudoSerial | None = None
        self._cutter = Cutter(RTU, requests=True)
        self._loop = asyncio.get_running_loop()
        self._timers: set[asyncio.TimerHandle] = set()
        self.requests = 0
        self._toxics = Toxics(scenario or FaultScenario(), RTU)

    def play(self, scenario: FaultScenario) -> None:
        """Begin a scenario: count requests from 0."""
        self._toxics = Toxics(scenario, RTU, self._toxics.free_at_s)

    @property
    def url(self) -> str:
        """URL of the device."""
        path = "" if self._host is None else self._host.path
        return f"modbus+rtu://{path}?baud={BAUD}&unit={self._unit}"

    def start(self) -> str:
        """Open the line and return the URL."""
        self._cutter = Cutter(RTU, requests=True)
        self._host = PseudoSerial(self._received, self._link)
        return self.url

    def stop(self) -> None:
        """Close the line; ``start`` opens it again, possibly at another path."""
        for timer in self._timers:
            timer.cancel()
        self._timers.clear()
        if self._host is not None:
            self._host.close()
            self._host = None

    def inject(self, data: bytes) -> None:
        """Put unsolicited bytes on the line: noise, or another master's traffic."""
        if self._host is not None:
            self._host.send(data)

    def _received(self, data: bytes) -> None:
        for frame in self._cutter.feed(data):
            self.requests += 1
            passed, acts = self._toxics.request(frame)
            self._do(acts)
            asked = parts(passed, RTU) if passed else None
            if asked is not None and asked.unit == self._unit:
                reply = Frame(self._unit, answer(self._registers, asked.pdu)).bytes(RTU)
                self._do(self._toxics.reply(reply, self._loop.time()))

    def _do(self, acts: list[Act]) -> None:
        for act in acts:
            if act.after_s > 0:
                self._later(act)
            else:
                self.inject(act.data)

    def _later(self, act: Act) -> None:
        def send() -> None:
            self._timers.discard(timer)
            self.inject(act.data)

        timer = self._loop.call_later(act.after_s, send)
        self._timers.add(timer)
