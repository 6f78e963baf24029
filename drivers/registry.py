"""Open devices by URL: each function returns a connected driver that has verified the kind of its device.

A device with another protocol is described by a file (`abbe.drivers.described`), or a package adds a driver with an entry point named like
its URL scheme (docs/how-to/own-device.md)::

    [project.entry-points."abbe.drivers"]
    "acme+tcp" = "acme_driver:DRIVER"      # DRIVER = {"cnc": open_controller}; async def open_controller(url: str) -> Controller
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import EntryPoint
from typing import cast

from abbe.drivers.api import BallBar, Controller, DeviceInfo, DisplacementMeter, Fixture, OneBank, Tables, has_one_table
from abbe.drivers.ballbar.driver import SerialBallBar
from abbe.drivers.cnc.driver import ModbusController
from abbe.drivers.described.control import ListenedControl
from abbe.drivers.described.opening import open_control, open_meter
from abbe.drivers.described.tested import Ability, check_tested
from abbe.drivers.errors import BadUrl, NotProved
from abbe.drivers.fixture.driver import Ask, ConsoleFixture, RemoteFixture
from abbe.drivers.laser.driver import ModbusLaser
from abbe.drivers.links.modbus_link import Canary, ModbusLink
from abbe.drivers.links.serial_link import ByteLink
from abbe.drivers.links.urls import (
    FixtureConsoleUrl,
    FixtureTcpUrl,
    ModbusRtuUrl,
    ModbusTcpUrl,
    SerialUrl,
    SocketUrl,
    described_by,
    installed,
    parse_url,
    split_report,
)
from abbe.drivers.one_bank import OneBankTables

HEARTBEAT_S = 1.0
"""Seconds between canary reads of an idle controller or laser, so that a loss is detected within 3 s."""


async def open_ballbar(url: str) -> BallBar:
    """Open the ball-bar behind a ``serial://`` or ``socket://`` URL, or behind a URL of an installed driver.

    Raises
    ------
    BadUrl
        Not such a URL.
    LinkDown, ReplyTimeout
        No connection, or no answer.
    """
    if (entry := installed(url)) is not None:
        return cast(BallBar, await _opened(entry, "ballbar", url))
    parsed = parse_url(url)
    if not isinstance(parsed, SerialUrl | SocketUrl):
        raise _wrong_scheme(url, "a ball-bar", "serial:// or socket://")
    ballbar = SerialBallBar(ByteLink(parsed))
    await _identify_or_close(ballbar)
    return ballbar


async def open_laser(url: str) -> DisplacementMeter:
    """Open the laser behind a ``modbus+tcp://`` or ``modbus+rtu://`` URL, behind a URL of an installed driver, or by a device file.

    Raises
    ------
    BadUrl
        Not such a URL.
    WrongDevice
        Something else answers there.
    BadDeviceFile, NotProved
        The device file cannot be used, or the report of the device's test does not prove what a measurement needs.
    LinkDown, ReplyTimeout, BadFrame
        Communication failed.
    """
    if (entry := installed(url)) is not None:
        return cast(DisplacementMeter, await _opened(entry, "laser", url))
    if described_by(parsed := parse_url(url)):
        return await open_meter(parsed, needed=Ability.DWELL)
    laser = ModbusLaser(await _modbus(url, "a laser"))
    await _identify_or_close(laser)
    return laser


async def open_controller(url: str) -> Controller:
    """Open the controller behind a ``modbus+tcp://`` or ``modbus+rtu://`` URL, behind a URL of an installed driver, or by a device file.

    Raises
    ------
    BadUrl
        Not such a URL.
    WrongDevice
        Something else answers there.
    BadDeviceFile, NotProved
        As for `open_laser`.
    LinkDown, ReplyTimeout, BadFrame
        Communication failed.
    """
    if (entry := installed(url)) is not None:
        found = cast(Controller, await _opened(entry, "cnc", url))
        controller = cast(Controller, OneBankTables(cast(OneBank, found))) if has_one_table(found) else found
    elif described_by(parsed := parse_url(url)):
        return await open_control(parsed, needed=Ability.DWELL)
    else:
        controller = ModbusController(await _modbus(url, "a controller"))
    await _identify_or_close(controller)
    return controller


def no_controller() -> Controller:
    """Return the stand-in for a control that is not connected: an operator runs the NC program, and the position is unknown."""
    return ListenedControl(None, None)


async def open_fixture(url: str, ask: Ask) -> Fixture:
    """Open the fixture behind a ``fixture+tcp://`` or ``fixture+console:`` URL.

    ``await ask(text)`` asks the operator and returns after the confirmation; only the console uses it.

    Raises
    ------
    BadUrl
        Not such a URL.
    LinkDown
        No connection.
    """
    parsed = parse_url(url)
    if isinstance(parsed, FixtureConsoleUrl):
        return ConsoleFixture(ask)
    if not isinstance(parsed, FixtureTcpUrl):
        raise _wrong_scheme(url, "a fixture", "fixture+tcp:// or fixture+console:")
    fixture = RemoteFixture(parsed)
    await fixture.open()
    return fixture


ROLES: dict[str, type] = {"laser": DisplacementMeter, "ballbar": BallBar, "cnc": Controller}
"""What a driver opens for each role."""


async def _opened(entry: EntryPoint, role: str, url: str) -> object:
    """Open a device with the driver of an installed package, and refuse one that lacks a method of its role."""
    remedy = "repair or remove the package that offers it"
    try:
        driver = entry.load()
    except Exception as fault:  # an import of foreign code may raise anything
        detail = f"the driver {entry.value} cannot be loaded: {type(fault).__name__}: {fault}"
        raise BadUrl(ascii(url), "open device", detail, remedy) from fault
    if not isinstance(driver, Mapping) or not callable(driver.get(role)):
        raise BadUrl(
            ascii(url), "open device", f"the driver {entry.value} opens no {role}", f"name a driver for {role} under [devices] {role}"
        )
    bare, report = split_report(url)
    device = await driver[role](bare)
    needed = {name for name in dir(ROLES[role]) if name[0] != "_"}
    if role == "cnc" and has_one_table(device):
        needed -= {name for name in (*dir(Tables), "comp_status") if name[0] != "_"}
    missing = sorted(name for name in needed if not hasattr(device, name))
    if missing:
        if hasattr(device, "close"):
            await device.close()
        raise BadUrl(ascii(url), "open device", f"the driver {entry.value} lacks {', '.join(missing)}", remedy)
    if report:
        info = await _identify_or_close(device)
        try:
            check_tested(bare, report, "", info.serial_no, Ability.DWELL)
        except NotProved:
            await device.close()
            raise
    return cast(object, device)


async def _modbus(url: str, what: str) -> ModbusLink:
    parsed = parse_url(url)
    if not isinstance(parsed, ModbusTcpUrl | ModbusRtuUrl):
        raise _wrong_scheme(url, what, "modbus+tcp:// or modbus+rtu://")
    return await ModbusLink.connect(parsed, canary=Canary(), heartbeat_s=HEARTBEAT_S)


def _wrong_scheme(url: str, what: str, schemes: str) -> BadUrl:
    return BadUrl(ascii(url), "read device URL", f"this is not the URL of {what}", f"write {schemes}")


async def _identify_or_close(device: BallBar | DisplacementMeter | Controller) -> DeviceInfo:
    """Identify a device; close its link on any error or cancellation."""
    try:
        return await device.identify()
    except BaseException:
        await device.close()
        raise
