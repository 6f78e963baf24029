"""Open devices by URL: each function returns a connected driver that has verified the kind of its device.

A package adds another protocol with an entry point named like its URL scheme::

    [project.entry-points."abbe.cnc"]
    "acme+tcp" = "acme_driver:open_controller"      # async def open_controller(url: str) -> abbe.drivers.api.Controller
"""

from __future__ import annotations

from importlib.metadata import EntryPoint
from typing import cast

from abbe.drivers.api import BallBar, Controller, DeviceInfo, DisplacementMeter, Fixture
from abbe.drivers.ballbar.driver import SerialBallBar
from abbe.drivers.cnc.driver import ModbusController
from abbe.drivers.errors import BadUrl
from abbe.drivers.fixture.driver import Ask, ConsoleFixture, RemoteFixture
from abbe.drivers.laser.driver import ModbusLaser
from abbe.drivers.links.modbus_link import Canary, ModbusLink
from abbe.drivers.links.serial_link import ByteLink
from abbe.drivers.links.urls import FixtureConsoleUrl, FixtureTcpUrl, ModbusRtuUrl, ModbusTcpUrl, SerialUrl, SocketUrl, installed, parse_url

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
    if (entry := installed("ballbar", url)) is not None:
        return cast(BallBar, await _opened(entry, url))
    parsed = parse_url(url)
    if not isinstance(parsed, SerialUrl | SocketUrl):
        raise _wrong_scheme(url, "a ball-bar", "serial:// or socket://")
    ballbar = SerialBallBar(ByteLink(parsed))
    await _identify_or_close(ballbar)
    return ballbar


async def open_laser(url: str) -> DisplacementMeter:
    """Open the laser behind a ``modbus+tcp://`` or ``modbus+rtu://`` URL, or behind a URL of an installed driver.

    Raises
    ------
    BadUrl
        Not such a URL.
    WrongDevice
        Something else answers there.
    LinkDown, ReplyTimeout, BadFrame
        Communication failed.
    """
    if (entry := installed("laser", url)) is not None:
        return cast(DisplacementMeter, await _opened(entry, url))
    laser = ModbusLaser(await _modbus(url, "a laser"))
    await _identify_or_close(laser)
    return laser


async def open_controller(url: str) -> Controller:
    """Open the controller behind a ``modbus+tcp://`` or ``modbus+rtu://`` URL, or behind a URL of an installed driver.

    Raises
    ------
    BadUrl
        Not such a URL.
    WrongDevice
        Something else answers there.
    LinkDown, ReplyTimeout, BadFrame
        Communication failed.
    """
    if (entry := installed("cnc", url)) is not None:
        controller = cast(Controller, await _opened(entry, url))
    else:
        controller = ModbusController(await _modbus(url, "a controller"))
    await _identify_or_close(controller)
    return controller


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


async def _opened(entry: EntryPoint, url: str) -> object:
    """Open a device with the driver of an installed package."""
    try:
        opener = entry.load()
    except Exception as fault:  # an import of foreign code may raise anything
        detail = f"the driver {entry.value} cannot be loaded: {type(fault).__name__}: {fault}"
        raise BadUrl(ascii(url), "open device", detail, "repair or remove the package that offers it") from fault
    return await opener(url)


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
