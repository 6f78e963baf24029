"""Device URLs of the configuration, parsed into plain values.

======================================================  =======================================================
``serial:///dev/ttyUSB0?baud=460800``                   a serial line, 8N1
``serial:///dev/ttyUSB0?parity=even&serial_no=4711``    with parity; only the box with this serial number is accepted
``socket://10.0.0.5:4001``                              the same bytes over raw TCP (serial device server); serial_no as above
``modbus+tcp://10.0.0.6:502?unit=1``                    Modbus TCP
``modbus+rtu:///dev/ttyS0?baud=115200&unit=1``          Modbus RTU, 8N1
``socket://10.0.0.8:23?device=FILE.toml``               a device described by a file (`abbe.drivers.described`); also with
                                                        ``tested=FILE.json``, the report of ``abbe device test``
``fixture+tcp://10.0.0.7:9000``                         a remote fixture (docs/protocols/fixture.md)
``fixture+console:``                                    the operator at the console
======================================================  =======================================================

Installed packages add devices with other protocols and other schemes: `installed`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from urllib.parse import SplitResult, parse_qsl, quote, unquote, urlsplit

from abbe.drivers.errors import BadUrl

SERIAL_BAUD = 460_800
RTU_BAUD = 115_200
_MAX_BAUD = 12_000_000
_MAX_UNIT = 247
_MAX_SERIAL_NO = 0xFFFFFFFF
PARITIES = ("none", "even", "odd")


@dataclass(frozen=True, slots=True)
class Description:
    """Files, named in a URL, about a device whose protocol is not built in: its device file, and the report of ``abbe device test``."""

    device: str = ""
    tested: str = ""

    def __bool__(self) -> bool:
        return bool(self.device)

    def __str__(self) -> str:
        return "".join(f"&{key}={quote(value)}" for key, value in (("device", self.device), ("tested", self.tested)) if value)


NOT_DESCRIBED = Description()


@dataclass(frozen=True, slots=True)
class SerialUrl:
    """A serial port, by its device path: 8 data bits, 1 stop bit; ``baud`` in bit/s; ``parity``: none, even or odd.

    ``serial_no``: serial number of the only accepted device; None: any. ``description``: `Description`.
    """

    path: str
    baud: int = SERIAL_BAUD
    parity: str = "none"
    serial_no: int | None = None
    description: Description = NOT_DESCRIBED

    def __str__(self) -> str:
        parity = "" if self.parity == "none" else f"&parity={self.parity}"
        number = "" if self.serial_no is None else f"&serial_no={self.serial_no}"
        return f"serial://{quote(self.path)}?baud={self.baud}{parity}{number}{self.description}"


@dataclass(frozen=True, slots=True)
class SocketUrl:
    """Raw bytes over TCP; ``serial_no`` as in `SerialUrl`."""

    host: str
    port: int
    serial_no: int | None = None
    description: Description = NOT_DESCRIBED

    def __str__(self) -> str:
        query = f"{'' if self.serial_no is None else f'&serial_no={self.serial_no}'}{self.description}"
        return f"socket://{_netloc(self.host, self.port)}{query.replace('&', '?', 1)}"


@dataclass(frozen=True, slots=True)
class ModbusTcpUrl:
    """A Modbus TCP server and the unit behind it."""

    host: str
    port: int
    unit: int = 1
    description: Description = NOT_DESCRIBED

    def __str__(self) -> str:
        return f"modbus+tcp://{_netloc(self.host, self.port)}?unit={self.unit}{self.description}"


@dataclass(frozen=True, slots=True)
class ModbusRtuUrl:
    """A Modbus RTU line (``baud`` in bit/s, 8 data bits, 1 stop bit) and the unit on it."""

    path: str
    baud: int = RTU_BAUD
    unit: int = 1
    parity: str = "none"
    description: Description = NOT_DESCRIBED

    def __str__(self) -> str:
        parity = "" if self.parity == "none" else f"&parity={self.parity}"
        return f"modbus+rtu://{quote(self.path)}?baud={self.baud}&unit={self.unit}{parity}{self.description}"


@dataclass(frozen=True, slots=True)
class FixtureTcpUrl:
    """A remote fixture's address."""

    host: str
    port: int

    def __str__(self) -> str:
        return f"fixture+tcp://{_netloc(self.host, self.port)}"


@dataclass(frozen=True, slots=True)
class FixtureConsoleUrl:
    """URL of a fixture that a person operates; requests appear on the console."""

    def __str__(self) -> str:
        return "fixture+console:"


DeviceUrl = SerialUrl | SocketUrl | ModbusTcpUrl | ModbusRtuUrl | FixtureTcpUrl | FixtureConsoleUrl


def parse_url(text: str) -> DeviceUrl:
    """Parse a device URL.

    Parameters
    ----------
    text : str
        The URL as the user wrote it.

    Returns
    -------
    DeviceUrl
        One of the frozen URL classes of this module; ``str()`` returns the URL in its full form.

    Raises
    ------
    BadUrl
        Unknown scheme, missing host, port or path, unknown query key, or a number out of range.
    """
    if any(character <= " " or character == "\x7f" for character in text):
        raise _bad(text, "it contains blanks or control characters", "write blanks in a path as %20")
    try:
        parts = urlsplit(text)
    except ValueError as error:
        raise _bad(text, str(error)) from None
    builder = _BUILDERS.get(parts.scheme)
    if builder is None:
        raise _bad(text, f"unknown scheme {parts.scheme!r}", f"use one of {', '.join(_BUILDERS)}")
    if parts.fragment or parts.username is not None or parts.password is not None:
        raise _bad(text, "user names, passwords and #fragments are not allowed")
    return builder(text, parts)


_ROLES: Mapping[str, tuple[type[DeviceUrl], ...]] = {
    "ballbar": (SerialUrl, SocketUrl),
    "laser": (ModbusTcpUrl, ModbusRtuUrl),
    "cnc": (ModbusTcpUrl, ModbusRtuUrl),
    "fixture": (FixtureTcpUrl, FixtureConsoleUrl),
}


_DESCRIBED_ROLES = ("laser", "cnc")


def is_url_of(role: str, text: str) -> bool:
    """Whether a URL leads to a device of this role: ballbar, laser, cnc or fixture. Raises the errors of `parse_url`.

    An installed driver, or a device file, is checked when the device is opened.
    """
    if installed(text) is not None:
        return role != "fixture"
    url = parse_url(text)
    return role in _DESCRIBED_ROLES if described_by(url) else isinstance(url, _ROLES[role])


def described_by(url: DeviceUrl) -> Description:
    """Return the device file and the test report that a URL names; ``bool`` of the result is False if the URL names no device file."""
    return NOT_DESCRIBED if isinstance(url, FixtureTcpUrl | FixtureConsoleUrl) else url.description


_REPORT = re.compile(r"(?P<before>[?&])tested=(?P<path>[^&#]*)(?P<after>&?)")


def split_report(text: str) -> tuple[str, str]:
    """Return a URL without the report of the device's test, and the path of this report; empty if there is none."""
    found = _REPORT.search(text)
    if found is None:
        return text, ""
    between = found["before"] if found["after"] else ""
    return text[: found.start()] + between + text[found.end() :], unquote(found["path"])


def untested_remedy(text: str) -> str:
    """Return the remedy for a device whose test is missing or out of date."""
    bare = split_report(text)[0]
    return f'run: abbe device test "{bare}" --out report.json, then add {"&" if "?" in bare else "?"}tested=report.json to the URL'


def beside(text: str, folder: Path) -> str:
    """Return a URL whose files (`Description`) are found from any working directory; relative paths refer to ``folder``."""
    if installed(text) is not None:
        bare, report = split_report(text)
        return f"{bare}{'&' if '?' in bare else '?'}tested={quote(str(folder / report))}" if report else text
    url = parse_url(text)
    found = described_by(url)
    if not found or isinstance(url, FixtureTcpUrl | FixtureConsoleUrl):
        return text
    builtin = "." not in found.device and "/" not in found.device
    files = Description(found.device if builtin else str(folder / found.device), str(folder / found.tested) if found.tested else "")
    return str(replace(url, description=files))


def installed(text: str) -> EntryPoint | None:
    """Return the driver of an installed package for a URL; None if there is none, or for a built-in scheme.

    A driver is an entry point of the group ``abbe.drivers`` with the scheme as its name (`abbe.drivers.registry`). Nothing is loaded here.
    """
    scheme = text.partition(":")[0].lower()
    if scheme in _BUILDERS:
        return None
    return next(iter(entry_points(group="abbe.drivers", name=scheme)), None)


def _serial(text: str, parts: SplitResult) -> SerialUrl:
    query = _query(text, parts, {"baud", "parity", "serial_no", *_FILES})
    baud = _number(text, query, "baud", SERIAL_BAUD, _MAX_BAUD)
    return SerialUrl(_path(text, parts), baud, _parity(text, query), _serial_no(text, query), _description(text, query))


def _socket(text: str, parts: SplitResult) -> SocketUrl:
    query = _query(text, parts, {"serial_no", *_FILES})
    return SocketUrl(*_address(text, parts), _serial_no(text, query), _description(text, query))


_FILES = ("device", "tested")


def _description(text: str, query: Mapping[str, str]) -> Description:
    found = Description(*(query.get(key, "") for key in _FILES))
    if found.tested and not found.device:
        raise _bad(text, "tested= needs device=", "name the device file that was tested, too")
    return found


def _parity(text: str, query: Mapping[str, str]) -> str:
    parity = query.get("parity", "none")
    if parity not in PARITIES:
        raise _bad(text, f"parity={parity!a} is none of {', '.join(PARITIES)}")
    return parity


def _serial_no(text: str, query: Mapping[str, str]) -> int | None:
    return _number(text, query, "serial_no", 1, _MAX_SERIAL_NO) if "serial_no" in query else None


def _modbus_tcp(text: str, parts: SplitResult) -> ModbusTcpUrl:
    query = _query(text, parts, {"unit", *_FILES})
    host, port = _address(text, parts)
    return ModbusTcpUrl(host, port, _number(text, query, "unit", 1, _MAX_UNIT), _description(text, query))


def _modbus_rtu(text: str, parts: SplitResult) -> ModbusRtuUrl:
    query = _query(text, parts, {"baud", "unit", "parity", *_FILES})
    baud = _number(text, query, "baud", RTU_BAUD, _MAX_BAUD)
    unit = _number(text, query, "unit", 1, _MAX_UNIT)
    return ModbusRtuUrl(_path(text, parts), baud, unit, _parity(text, query), _description(text, query))


def _fixture_tcp(text: str, parts: SplitResult) -> FixtureTcpUrl:
    _query(text, parts, set())
    return FixtureTcpUrl(*_address(text, parts))


def _fixture_console(text: str, parts: SplitResult) -> FixtureConsoleUrl:
    _query(text, parts, set())
    if parts.netloc or parts.path:
        raise _bad(text, "the console has no address", "write just fixture+console:")
    return FixtureConsoleUrl()


_BUILDERS: Mapping[str, Callable[[str, SplitResult], DeviceUrl]] = {
    "serial": _serial,
    "socket": _socket,
    "modbus+tcp": _modbus_tcp,
    "modbus+rtu": _modbus_rtu,
    "fixture+tcp": _fixture_tcp,
    "fixture+console": _fixture_console,
}


def _netloc(host: str, port: int) -> str:
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def _bad(text: str, detail: str, remedy: str = "docs/reference/machine-file.md shows the forms") -> BadUrl:
    return BadUrl(ascii(text), "read device URL", detail, remedy)


def _address(text: str, parts: SplitResult) -> tuple[str, int]:
    try:
        port = parts.port
    except ValueError:
        raise _bad(text, "the port is not a number from 1 to 65535") from None
    if not parts.hostname:
        raise _bad(text, "the host is missing", f"write {parts.scheme}://host:port")
    if not port:
        raise _bad(text, "the port is missing", f"write {parts.scheme}://{parts.hostname}:port")
    if parts.path not in ("", "/"):
        raise _bad(text, f"a path ({parts.path}) is not allowed with this scheme")
    return parts.hostname, port


def _path(text: str, parts: SplitResult) -> str:
    if parts.netloc:
        raise _bad(text, f"a host ({parts.netloc}) is not allowed with this scheme", f"write three slashes: {parts.scheme}:///dev/...")
    path = unquote(parts.path)
    if not path.startswith("/") or path.endswith("/") or "\x00" in path:
        raise _bad(text, "the device path is missing or not absolute", f"write {parts.scheme}:///dev/ttyUSB0")
    return path


def _query(text: str, parts: SplitResult, known: set[str]) -> dict[str, str]:
    try:
        pairs = parse_qsl(parts.query, keep_blank_values=True, strict_parsing=bool(parts.query))
    except ValueError:
        raise _bad(text, f"the part after ? ({parts.query}) is not key=value") from None
    query = dict(pairs)
    if len(query) != len(pairs):
        raise _bad(text, "a key is given twice")
    if unknown := sorted(set(query) - known):
        raise _bad(text, f"unknown key {unknown[0]!a}", f"known keys: {', '.join(sorted(known)) or 'none'}")
    return query


def _number(text: str, query: Mapping[str, str], key: str, default: int, largest: int) -> int:
    value = query.get(key)
    if value is None:
        return default
    if not (value.isascii() and value.isdigit() and len(value) <= len(str(largest)) and 1 <= int(value) <= largest):
        raise _bad(text, f"{key}={value!a} is not a whole number from 1 to {largest}")
    return int(value)
