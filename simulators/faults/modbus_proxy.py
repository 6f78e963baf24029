"""A TCP proxy between a host and a Modbus device (MBAP, or RTU frames over TCP) that plays a fault scenario on the traffic."""

import argparse
import asyncio
import socket
import struct
import sys
from collections.abc import Coroutine
from contextlib import suppress
from pathlib import Path
from typing import Any

from abbe.simulators.faults.modbus_toxics import MBAP, RTU, Act, Cutter, Toxics
from abbe.simulators.faults.scenario import Fault, FaultScenario, load

_CONNECTION_KINDS = ("accept_then_close", "one_socket", "kick_oldest")
_RESET = struct.pack("ii", 1, 0)  # linger for 0 s: closing sends RST


class ModbusProxy:
    """Listens on 127.0.0.1 and passes frames between host and device, with the faults of a scenario.

    Besides the kinds of ``modbus_toxics`` it plays three that count connections: ``accept_then_close`` (closes a connection after accepting
    it), ``one_socket`` (does the same while another connection is open), ``kick_oldest`` (closes older connections when a new one opens).

    Parameters
    ----------
    upstream : tuple of (str, int)
        Host and port of the device.
    scenario : FaultScenario
        ``play`` replaces it at run time.
    framing : str
        ``mbap`` or ``rtu``.
    """

    def __init__(self, upstream: tuple[str, int], scenario: FaultScenario | None = None, framing: str = MBAP) -> None:
        self._upstream, self._framing = upstream, framing
        self.port = 0
        self.connections = 0
        self.open = 0
        self.most_open = 0
        self.requests = 0
        self.connected_s: list[float] = []
        """Loop times of the connections."""
        self._server: asyncio.Server | None = None
        self._pairs: list[_Pair] = []
        self._tasks: set[asyncio.Task[None]] = set()
        self.toxics = Toxics(FaultScenario(), framing)
        self.play(scenario or FaultScenario())

    def play(self, scenario: FaultScenario) -> None:
        """Begin a scenario: count requests and connections from 0, and end a black hole."""
        self._of_connections = [fault for fault in scenario.faults if fault.kind in _CONNECTION_KINDS]
        rest = tuple(fault for fault in scenario.faults if fault.kind not in _CONNECTION_KINDS)
        self.toxics = Toxics(FaultScenario(scenario.name, scenario.seed, rest), self._framing, self.toxics.free_at_s)
        self._count = 0

    @property
    def url(self) -> str:
        """URL of the device through this proxy."""
        return f"modbus+tcp://127.0.0.1:{self.port}?unit=1"

    async def start(self, port: int = 0) -> int:
        """Listen and return the port."""
        self._server = await asyncio.start_server(self._accepted, "127.0.0.1", port)
        self.port = int(self._server.sockets[0].getsockname()[1])
        return self.port

    async def stop(self) -> None:
        """Close all connections and stop listening; ``start(port)`` listens again."""
        if self._server is not None:
            self._server.close()
        for pair in list(self._pairs):
            pair.end("fin")
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    def hang_up(self, how: str = "fin") -> None:
        """Close (``fin``) or reset (``rst``) all connections."""
        for pair in list(self._pairs):
            pair.end(how)

    async def _accepted(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        number, self._count = self._count, self._count + 1
        self.connections += 1
        self.connected_s.append(asyncio.get_running_loop().time())
        if self._refuses(number):
            writer.close()
            return
        self.open += 1
        self.most_open = max(self.most_open, self.open)
        pair = None
        try:
            up_reader, up_writer = await asyncio.open_connection(*self._upstream)
            pair = _Pair(self, writer, up_writer)
            self._pairs.append(pair)
            self._spawn(pair.upward(reader))
            await pair.downward(up_reader)
        except OSError:
            writer.close()
        finally:
            self.open -= 1
            if pair is not None:
                self._pairs.remove(pair)
                pair.end("fin")

    def _spawn(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    def _refuses(self, number: int) -> bool:
        hit = {fault.kind for fault in self._of_connections if fault.hits(number)}
        if "kick_oldest" in hit:
            for pair in list(self._pairs):
                pair.end("fin")
        return "accept_then_close" in hit or ("one_socket" in hit and self.open > 0)


class _Pair:
    """One connection of the host and its connection to the device."""

    def __init__(self, proxy: ModbusProxy, host: asyncio.StreamWriter, device: asyncio.StreamWriter) -> None:
        self._proxy, self._host, self._device = proxy, host, device
        self._framing = proxy.toxics.framing
        self._loop = asyncio.get_running_loop()

    async def upward(self, reader: asyncio.StreamReader) -> None:
        """Pass requests from the host to the device until the host hangs up."""
        cutter = Cutter(self._framing, requests=True)
        with suppress(OSError):
            while data := await reader.read(4096):
                for frame in cutter.feed(data):
                    self._proxy.requests += 1
                    passed, acts = self._proxy.toxics.request(frame)
                    self._do(acts)
                    if passed:
                        self._device.write(passed)
        self._device.close()

    async def downward(self, reader: asyncio.StreamReader) -> None:
        """Pass replies from the device to the host until the device hangs up."""
        cutter = Cutter(self._framing, requests=False)
        with suppress(OSError):
            while data := await reader.read(4096):
                for frame in cutter.feed(data):
                    self._do(self._proxy.toxics.reply(frame, self._loop.time()))

    def _do(self, acts: list[Act]) -> None:
        for act in acts:
            if act.after_s > 0:
                self._loop.call_later(act.after_s, self._send, act)
            else:
                self._send(act)

    def _send(self, act: Act) -> None:
        if act.end:
            self.end(act.end)
        elif not self._host.is_closing():
            self._host.write(act.data)

    def end(self, how: str) -> None:
        """Close both connections."""
        end = self._host.get_extra_info("socket")
        if how == "rst" and end is not None and not self._host.is_closing():
            with suppress(OSError):
                end.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET)
            self._host.transport.abort()
        self._host.close()
        self._device.close()


def refusing(times: int = 0) -> FaultScenario:
    """Return a scenario in which the device closes a connection after accepting it, ``times`` in a row (0: always)."""
    return FaultScenario("accept then close", faults=(Fault("accept_then_close", times=times),))


def main() -> None:
    """Run a proxy until Ctrl-C: ``python -m abbe.simulators.faults.modbus_proxy 127.0.0.1:15020 faults.toml``."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("device", help="host:port of the Modbus device")
    parser.add_argument("scenario", type=Path, help="faults as TOML, see simulators/faults/scenario.py")
    parser.add_argument("--port", type=int, default=0, help="port on 127.0.0.1 to listen on (default: any free port, printed at start)")
    parser.add_argument("--rtu", action="store_true", help="RTU frames over TCP, as from a serial device server")
    options = parser.parse_args()
    host, _, port = options.device.rpartition(":")

    async def serve() -> None:
        proxy = ModbusProxy((host, int(port)), load(options.scenario), RTU if options.rtu else MBAP)
        await proxy.start(options.port)
        sys.stdout.write(f"{proxy.url}\n")
        sys.stdout.flush()
        try:
            await asyncio.Event().wait()
        finally:
            await proxy.stop()

    with suppress(KeyboardInterrupt):
        asyncio.run(serve())


if __name__ == "__main__":
    main()
