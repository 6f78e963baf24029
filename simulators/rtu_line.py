"""Modbus RTU over pseudo terminals: the host's terminal and the server's, joined back to back like a null modem."""

from pathlib import Path

from abbe.simulators.modbus_wire import ModbusRtu, RegisterMap
from abbe.simulators.pseudo_serial import PseudoSerial

BAUD = 115200


class RtuLine:
    """A Modbus RTU device at a path. pymodbus opens a terminal by its name, so it gets one of its own."""

    def __init__(self, registers: RegisterMap, link: Path | None) -> None:
        self._server = ModbusRtu(registers)
        self._link = link
        self._host: PseudoSerial | None = None
        self._device: PseudoSerial | None = None

    async def start(self) -> str:
        """Open both terminals and serve; gives the URL."""
        host = self._host = PseudoSerial(self._to_device, self._link)
        self._device = PseudoSerial(host.send)
        await self._server.start(self._device.path, BAUD)
        return f"modbus+rtu://{host.path}?baud={BAUD}&unit=1"

    async def stop(self) -> None:
        """Hang up."""
        await self._server.stop()
        for terminal in (self._host, self._device):
            if terminal is not None:
                terminal.close()

    def _to_device(self, data: bytes) -> None:
        if self._device is not None:
            self._device.send(data)
