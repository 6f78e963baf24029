"""Opens described devices: the wire by the URL, the rest by the device file. A job may use only tested abilities."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from dataclasses import dataclass, replace
from typing import TypeVar

from abbe.drivers.api import DeviceInfo
from abbe.drivers.described.control import ListenedControl
from abbe.drivers.described.line_source import PolledLines, StreamedLines
from abbe.drivers.described.meter import DescribedMeter
from abbe.drivers.described.modbus_source import ModbusSource, canary_of
from abbe.drivers.described.source import DeviceSource
from abbe.drivers.described.tested import Ability, check_tested
from abbe.drivers.device_file import DeviceFile, Kind, load, port_settings
from abbe.drivers.errors import BadUrl
from abbe.drivers.links.modbus_link import ModbusLink
from abbe.drivers.links.serial_link import ByteLink
from abbe.drivers.links.urls import DeviceUrl, ModbusRtuUrl, ModbusTcpUrl, SerialUrl, SocketUrl, described_by

HEARTBEAT_S = 1.0
T = TypeVar("T", DescribedMeter, ListenedControl)


@dataclass(frozen=True, slots=True)
class Described:
    """A device file as it was read for a URL."""

    url: DeviceUrl
    file: DeviceFile
    sha256: str


def described(url: DeviceUrl, kind: Kind | None = None) -> Described:
    """Read the device file of a URL; raises BadDeviceFile, or BadUrl if the file describes another kind of device."""
    file, sha256 = load(described_by(url).device)
    if kind is not None and file.kind != kind:
        raise BadUrl(ascii(str(url)), "open device", f"its device file is of kind {file.kind!r}, not {kind!r}", "name another device file")
    if isinstance(url, ModbusRtuUrl | SerialUrl):
        url = replace(url, **port_settings(file))
    return Described(url, file, sha256)


async def open_source(url: DeviceUrl, file: DeviceFile) -> DeviceSource:
    """Open the wire of a described device without identification.

    Raises
    ------
    BadUrl
        The URL has another wire than the device file.
    LinkDown
        No connection.
    """
    if file.modbus is not None and isinstance(url, ModbusTcpUrl | ModbusRtuUrl):
        link = await ModbusLink.connect(url, timeout_s=file.modbus.timeout_s, canary=canary_of(file), heartbeat_s=HEARTBEAT_S)
        return ModbusSource(file, link)
    if file.line is not None and isinstance(url, SerialUrl | SocketUrl):
        link_ = ByteLink(url, bits=file.line.bits, stop=file.line.stop)
        return PolledLines(file, link_) if file.line.mode == "poll" else StreamedLines(file, link_)
    wanted = "modbus+tcp:// or modbus+rtu://" if file.modbus is not None else "serial:// or socket://"
    raise BadUrl(ascii(str(url)), "open device", "the device file is for another kind of line", f"write {wanted}")


async def open_meter(url: DeviceUrl, *, needed: Ability | None = None) -> DescribedMeter:
    """Open and identify a described displacement sensor, and refuse it if its report does not prove what is ``needed`` (None: nothing).

    Raises
    ------
    BadDeviceFile, BadUrl
        The device file cannot be used, or describes another kind of device or another wire than the URL.
    NotProved
        As for `check_tested`.
    WrongDevice, LinkDown, ReplyTimeout, BadFrame, DeviceFault
        Another device, or communication failed.
    """
    about = described(url, "displacement")
    return await _identified(DescribedMeter(about.file, await open_source(about.url, about.file)), about, needed)


async def open_control(url: DeviceUrl, *, needed: Ability | None = None) -> ListenedControl:
    """Open and identify a described control, which can only be listened to; parameters and errors as for `open_meter`."""
    about = described(url, "position")
    return await _identified(ListenedControl(about.file, await open_source(about.url, about.file)), about, needed)


async def _identified(device: T, about: Described, needed: Ability | None) -> T:
    identify: Callable[[], Awaitable[DeviceInfo]] = device.identify
    try:
        info = await identify()
        if needed is not None:
            check_tested(str(about.url), described_by(about.url).tested, about.sha256, info.serial_no, needed)
    except BaseException:
        await device.close()
        raise
    return device
