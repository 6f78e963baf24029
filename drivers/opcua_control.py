"""A control behind an OPC UA server: its position and files are read, and files are written. It is not moved and has no tables here.

A plug-in of `abbe.drivers.registry` (entry point ``opc.tcp``) that needs the extra ``pip install 'abbe[opcua]'``. The URL names the nodes::

    opc.tcp://192.168.0.40:4840/?x=ns%3D2%3Bs%3DX&y=ns%3D2%3Bs%3DY&z=ns%3D2%3Bs%3DZ&moving=ns%3D2%3Bs%3DMoving&unit=mm

``moving`` (a Boolean node; optional) shows whether an axis moves. The nodes' EngineeringUnits (UNECE code) give the unit. ``unit``
(mm, um, m, in) states the unit of nodes without EngineeringUnits, and must not contradict others. Values without good quality are refused.

By default the session is anonymous and not encrypted: use such a session only in the machine's own network. ``certificate``, ``key`` (PEM,
Abbe's) and ``server`` (the server's certificate, DER or PEM) encrypt the session by Basic256Sha256; no other server is then accepted.
``user`` and ``password_file`` log in.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Awaitable
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import parse_qsl, urlsplit, urlunsplit

from abbe.drivers.api import NOTHING_HOLDS, Condition, ControllerStatus, DeviceInfo
from abbe.drivers.described.control import ListenedControl
from abbe.drivers.errors import BadFrame, BadUrl, DeviceFault, LinkDown, ReplyTimeout, WrongDevice

ANSWER_S = 4.0
AXES = ("x", "y", "z")
MM = {"mm": 1.0, "um": 1e-3, "m": 1e3, "in": 25.4}
UNECE = {5066068: "mm", 13384: "um", 5067858: "m", 4804168: "in"}
"""EUInformation.UnitId of MMT, 4H, MTR, INH: the code's letters as a number (OPC 10000-8, 5.6.3)."""
CHUNK = 8192
T = TypeVar("T")


class OpcUaControl(ListenedControl):
    """One session with the server; one request at a time."""

    def __init__(self, url: str, client: Any, nodes: dict[str, str], unit: str) -> None:
        super().__init__(None, None)
        self.name, self._client, self._unit = url, client, unit
        self._nodes = {name: client.get_node(node) for name, node in nodes.items()}
        self._scale = dict.fromkeys(AXES, 0.0)

    async def identify(self) -> DeviceInfo:
        """Read the server's product and the unit of each position.

        Raises
        ------
        WrongDevice
            A node has no unit, another unit than stated, or no unit of length.
        LinkDown, ReplyTimeout, BadFrame
            Communication failed, or there is no such node.
        """
        info = await self._ask("identify", self._client.get_node("i=2260").read_value())  # Server.ServerStatus.BuildInfo
        for axis in AXES:
            self._scale[axis] = MM[await self._unit_of(axis)]
        return DeviceInfo("cnc", str(info.ProductName), "", 0, str(info.SoftwareVersion))

    async def _unit_of(self, axis: str) -> str:
        names = {p.Name: p for p in [await self._ask("identify", n.read_browse_name()) for n in await self._properties(axis)]}
        if "EngineeringUnits" not in names:
            if not self._unit:
                raise WrongDevice(self.name, "identify", f"the position of {axis.upper()} states no unit", "add unit=mm to its URL")
            return self._unit
        node = await self._ask("identify", self._nodes[axis].get_child(names["EngineeringUnits"]))
        unit_id = (await self._ask("identify", node.read_value())).UnitId
        found = UNECE.get(unit_id, "")
        if not found or (self._unit and found != self._unit):
            what = found or f"unit {unit_id}, which is no unit of length known here"
            raise WrongDevice(
                self.name, "identify", f"the position of {axis.upper()} is in {what}; the URL states {self._unit or 'no unit'}"
            )
        return found

    async def _properties(self, axis: str) -> list[Any]:
        return list(await self._ask("identify", self._nodes[axis].get_properties()))

    async def status(self) -> ControllerStatus:
        """Read all nodes in one request; the time is this computer's, at the arrival.

        Raises
        ------
        DeviceFault
            A value is not a number, or its quality is not good.
        LinkDown, ReplyTimeout, BadFrame
            Communication failed.
        """
        nodes = list(self._nodes.values())
        found = dict(zip(self._nodes, await self._ask("read status", self._client.read_attributes(nodes)), strict=True))
        host_s = time.monotonic()
        for name, value in found.items():
            plain = None if value.Value is None else value.Value.Value
            fits = isinstance(plain, bool) if name == "moving" else isinstance(plain, float | int) and not isinstance(plain, bool)
            if not value.StatusCode.is_good() or not fits:
                why = f"{name} is not valid ({value.StatusCode.name}: {plain!r})"
                raise DeviceFault(self.name, "read status", why, "look at the control")
        x, y, z = (float(found[a].Value.Value) * self._scale[a] for a in AXES)
        holds = NOTHING_HOLDS
        if "moving" in found:
            holds = Condition.MOVING if found["moving"].Value.Value else Condition.IN_POSITION
        return ControllerStatus(host_s, round(host_s * 1e6), holds, (x, y, z), 0, 0, 0, 100, 0)

    async def close(self) -> None:
        """End the session. Closing twice does nothing."""
        client, self._client = self._client, None
        if client is not None:
            await _ended(client)

    async def _ask(self, operation: str, answer: Awaitable[T]) -> T:
        return await _answered(self.name, operation, answer)


class OpcUaFiles:
    """Files that a control offers as file objects (OPC 10000-20). ``nodes`` maps a file name to its OPC UA node."""

    def __init__(self, url: str, client: Any, nodes: dict[str, str]) -> None:
        self.name, self._client = url, client
        self._nodes = {name: client.get_node(node) for name, node in nodes.items()}

    @property
    def names(self) -> frozenset[str]:
        """Names of the files."""
        return frozenset(self._nodes)

    async def put(self, name: str, data: bytes) -> None:
        """Write a file and replace its content.

        Raises
        ------
        LinkDown, ReplyTimeout, BadFrame
            Communication failed, or the server refuses.
        """
        handle = await self._call(name, "Open", _number(6, "Byte"))
        try:
            for at in range(0, len(data), CHUNK):
                await self._call(name, "Write", _number(handle, "UInt32"), data[at : at + CHUNK])
        finally:
            await self._call(name, "Close", _number(handle, "UInt32"))

    async def get(self, name: str) -> bytes:
        """Read a file whole; errors as for `put`."""
        handle, out = await self._call(name, "Open", _number(1, "Byte")), b""
        try:
            while part := await self._call(name, "Read", _number(handle, "UInt32"), _number(CHUNK, "Int32")):
                out += part
        finally:
            await self._call(name, "Close", _number(handle, "UInt32"))
        return out

    async def _call(self, name: str, method: str, *arguments: Any) -> Any:
        return await _answered(self.name, f"{method.lower()} file", self._nodes[name].call_method(f"0:{method}", *arguments))

    async def close(self) -> None:
        """End the session."""
        await _ended(self._client)


async def _answered(name: str, operation: str, answer: Awaitable[T]) -> T:
    from asyncua import ua

    try:
        async with asyncio.timeout(ANSWER_S):
            return await answer
    except TimeoutError:
        raise ReplyTimeout(name, operation, f"no answer within {ANSWER_S:g} s", "check that the server is on") from None
    except OSError as error:
        raise LinkDown(name, operation, str(error), "check that the server is on, and its address") from None
    except ua.UaError as error:
        raise BadFrame(
            name, operation, str(error) or type(error).__name__, "check that the nodes in the URL belong to this server"
        ) from None


async def _ended(client: Any) -> None:
    try:
        async with asyncio.timeout(ANSWER_S):
            await client.disconnect()
    except (OSError, TimeoutError):
        return


def _number(value: int, kind: str) -> Any:
    from asyncua import ua

    return ua.Variant(value, ua.VariantType[kind])


async def open_opcua(url: str) -> OpcUaControl:
    """Open the control behind an ``opc.tcp://`` URL.

    Raises
    ------
    BadUrl
        A node of X, Y or Z is missing, a key or the unit is unknown, or the extra is not installed.
    LinkDown, ReplyTimeout, BadFrame
        Communication failed.
    """
    query, access = _split(url)
    unit = query.pop("unit", "")
    if not set(AXES) <= set(query) <= {*AXES, "moving"} or unit not in ("", *MM) or not urlsplit(url).hostname:
        remedy = "write opc.tcp://HOST:PORT/?x=NODE&y=NODE&z=NODE, with a NODE such as ns%3D2%3Bs%3DX; optional: &moving=NODE, &unit=mm"
        raise BadUrl(ascii(url), "read device URL", "nodes of X, Y and Z are needed", remedy)
    client = await _connected(url, access)
    try:
        return OpcUaControl(url, client, query, unit)
    except ValueError as error:
        raise await _bad_node(url, client, error) from None


async def open_files(url: str) -> OpcUaFiles:
    """Open the files behind ``opc.tcp://HOST:PORT/?NAME=NODE&NAME=NODE``.

    Raises
    ------
    BadUrl
        There is no file in the URL, or the extra is not installed.
    LinkDown, ReplyTimeout, BadFrame
        Communication failed.
    """
    query, access = _split(url)
    if not query:
        raise BadUrl(
            ascii(url), "read URL", "it names no file", "write opc.tcp://HOST:PORT/?NAME=NODE, for example NODE ns%3D2%3Bs%3DTable"
        )
    client = await _connected(url, access)
    try:
        return OpcUaFiles(url, client, query)
    except ValueError as error:
        raise await _bad_node(url, client, error) from None


SECRETS = ("certificate", "key", "server")
"""Files that encrypt a session: all or none."""
LOGIN = ("user", "password_file")


def _split(url: str) -> tuple[dict[str, str], dict[str, str]]:
    """Return the nodes of a URL, and its keys for encryption and login; both by key."""
    query = dict(parse_qsl(urlsplit(url).query, keep_blank_values=True))
    access = {key: query.pop(key) for key in (*SECRETS, *LOGIN) if key in query}
    wrong = ""
    if 0 < len(access.keys() & set(SECRETS)) < len(SECRETS):
        wrong = "certificate, key and server belong together"
    elif len(access.keys() & set(LOGIN)) == 1:
        wrong = "user and password_file belong together"
    elif "user" in access and "key" not in access:
        wrong = "a password is sent over an encrypted session only: certificate, key and server are missing"
    missing = [path for key, path in access.items() if key != "user" and not Path(path).is_file()]
    if wrong or missing:
        raise BadUrl(ascii(url), "read device URL", wrong or f"{missing[0]}: no such file", "write &certificate=FILE&key=FILE&server=FILE")
    return query, access


async def _secured(client: Any, url: str, access: dict[str, str]) -> None:
    """Encrypt a session and log in, as the URL requires."""
    from asyncua.crypto.security_policies import SecurityPolicyBasic256Sha256

    try:
        client.application_uri = _application_uri(access["certificate"])
        await client.set_security(SecurityPolicyBasic256Sha256, access["certificate"], access["key"], server_certificate=access["server"])
        if "user" in access:
            client.set_user(access["user"])
            client.set_password(_first_line(access["password_file"]))
    except (ValueError, TypeError, IndexError, OSError) as error:
        remedy = "give PEM files; Abbe's certificate needs a URI among its alternative names"
        raise BadUrl(ascii(url), "open device", f"certificate, key or password: {error}", remedy) from None


def _application_uri(certificate: str) -> str:
    from cryptography import x509

    try:
        names = x509.load_pem_x509_certificate(Path(certificate).read_bytes()).extensions.get_extension_for_class(
            x509.SubjectAlternativeName
        )
    except x509.ExtensionNotFound as missing:
        raise ValueError(f"{certificate}: {missing}") from None
    return names.value.get_values_for_type(x509.UniformResourceIdentifier)[0]


def _first_line(path: str) -> str:
    return Path(path).read_text(encoding="utf-8").partition("\n")[0]


async def _connected(url: str, access: dict[str, str]) -> Any:
    try:
        from asyncua import Client
    except ImportError:
        raise BadUrl(ascii(url), "open device", "OPC UA is not installed", "pip install 'abbe[opcua]'") from None
    parts = urlsplit(url)
    client = Client(urlunsplit((parts.scheme, parts.netloc, parts.path, "", "")), timeout=ANSWER_S)
    if "certificate" in access:
        await _secured(client, url, access)
    await _answered(url, "connect", client.connect())
    return client


async def _bad_node(url: str, client: Any, error: ValueError) -> BadUrl:
    await _ended(client)
    return BadUrl(ascii(url), "read device URL", str(error), "write a node as ns%3D2%3Bs%3DX")


DRIVER = {"cnc": open_opcua}
