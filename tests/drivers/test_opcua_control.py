"""A control behind OPC UA, as a plug-in, against asyncua's own server: positions with unit and quality, and a file that is read back."""

from __future__ import annotations

import importlib
import socket
import tomllib
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("asyncua", reason="the extra [opcua] is not installed")

from asyncua import Server, ua
from asyncua.crypto.permission_rules import User, UserRole
from asyncua.server.user_managers import UserManager
from cryptography import x509
from cryptography.hazmat.primitives.serialization import Encoding

from abbe.drivers.api import Condition, only_listens
from abbe.drivers.errors import BadFrame, BadUrl, DeviceFault, LinkDown, NotProved, ReplyTimeout, WrongDevice
from abbe.drivers.opcua_control import DRIVER, MM, UNECE, OpcUaControl, open_files
from abbe.service.devices.session import open_session
from tests.certificates import Signed, issued
from tests.service.devices.test_second_controller import machine_with

ROOT = Path(__file__).resolve().parents[2]
MILL = "urn:mill:server"
X, Y, Z, MOVING, FILE = ("ns=2;s=" + name for name in ("X", "Y", "Z", "Moving", "Table"))


@dataclass
class Plant:
    """A control's server: three positions, one Boolean, one file object whose content is here."""

    server: Any
    url: str
    nodes: dict[str, Any] = field(default_factory=dict)
    content: bytes = b"old"
    spoils: bool = False
    at: int = 0

    def asked(self, unit: str = "") -> str:
        pairs = {"x": X, "y": Y, "z": Z, "moving": MOVING} | ({"unit": unit} if unit else {})
        return f"{self.url}?" + "&".join(f"{k}={v.replace('=', '%3D').replace(';', '%3B')}" for k, v in pairs.items())


async def _file(plant: Plant, index: int) -> None:
    """A file object (OPC 10000-20) with Open, Read, Write, Close."""

    async def opened(parent: Any, mode: Any) -> list[Any]:
        plant.at = 0
        plant.content = b"" if mode.Value & 4 else plant.content
        return [ua.Variant(7, ua.VariantType.UInt32)]

    async def read(parent: Any, handle: Any, count: Any) -> list[Any]:
        part, plant.at = plant.content[plant.at : plant.at + count.Value], plant.at + count.Value
        return [ua.Variant(part, ua.VariantType.ByteString)]

    async def write(parent: Any, handle: Any, data: Any) -> list[Any]:
        plant.content += data.Value[:-1] if plant.spoils else data.Value
        return []

    async def closed(parent: Any, handle: Any) -> list[Any]:
        return []

    node = await plant.server.nodes.objects.add_object(ua.NodeId("Table", index), "Table")
    for name, does in (("Open", opened), ("Read", read), ("Write", write), ("Close", closed)):
        await node.add_method(ua.NodeId(f"Table.{name}", index), ua.QualifiedName(name, 0), does)


@asynccontextmanager
async def serving(own: Signed | None = None, client: Signed | None = None) -> AsyncIterator[Plant]:
    """A control's server; ``own``: encrypted only, for ``client`` and the user of `_OneUser`."""
    with socket.create_server(("127.0.0.1", 0)) as held:
        port = held.getsockname()[1]
    server = Server(user_manager=_OneUser(client.pem) if client else None)
    await server.init()
    url = f"opc.tcp://127.0.0.1:{port}/"
    server.set_endpoint(url)
    if own is None:
        server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
    else:
        await server.set_application_uri(MILL)
        server.set_security_policy([ua.SecurityPolicyType.Basic256Sha256_SignAndEncrypt])
        server.set_identity_tokens([ua.UserNameIdentityToken])
        await server.load_certificate(str(own.pem))
        await server.load_private_key(str(own.key_pem))
    index = await server.register_namespace("urn:mill")
    plant = Plant(server, url)
    for name, value in (("X", 1.5), ("Y", -20.0), ("Z", 300.25), ("Moving", False)):
        node = await server.nodes.objects.add_variable(ua.NodeId(name, index), name, value)
        plant.nodes[name] = node
        if name != "Moving":
            unit = ua.EUInformation(NamespaceUri="http://www.opcfoundation.org/UA/units/un/cefact", UnitId=5066068)
            await node.add_property(ua.NodeId(f"{name}.unit", index), ua.QualifiedName("EngineeringUnits", 0), unit)
    await _file(plant, index)
    async with server:
        yield plant


class _OneUser(UserManager):
    """Knows one user, on a channel of one certificate."""

    def __init__(self, pem: Path) -> None:
        self.der = x509.load_pem_x509_certificate(pem.read_bytes()).public_bytes(Encoding.DER)

    def get_user(self, iserver: Any, username: str | None = None, password: Any = None, certificate: Any = None) -> User | None:
        return User(role=UserRole.User) if (username, password) == ("abbe", "bar ball") else None


@pytest.fixture
async def plant() -> AsyncIterator[Plant]:
    async with serving() as plant:
        yield plant


async def _open(url: str) -> OpcUaControl:
    control = await DRIVER["cnc"](url)
    try:
        await control.identify()
    except BaseException:
        await control.close()
        raise
    return control


def test_unit_codes_are_the_letters_of_unece() -> None:
    assert {code.to_bytes(3, "big").lstrip(b"\0").decode(): name for code, name in UNECE.items()} == {
        "MMT": "mm", "4H": "um", "MTR": "m", "INH": "in",
    }  # fmt: skip
    assert set(UNECE.values()) == set(MM)


async def test_positions_are_read_with_unit_and_quality(plant: Plant) -> None:
    control = await _open(plant.asked())
    try:
        assert only_listens(control)
        status = await control.status()
        assert (status.position_mm, status.conditions) == ((1.5, -20.0, 300.25), Condition.IN_POSITION)
        await plant.nodes["Moving"].write_value(True)
        assert (await control.status()).moving
        uncertain = ua.DataValue(ua.Variant(1.5), ua.StatusCode(ua.StatusCodes.BadSensorFailure))
        await plant.nodes["X"].write_value(uncertain)
        with pytest.raises(DeviceFault, match=r"x is not valid \(BadSensorFailure"):
            await control.status()
        with pytest.raises(NotProved, match="Abbe writes no table"):
            await control.write_bank(0, b"")
    finally:
        await control.close()
    with pytest.raises(WrongDevice, match="X is in mm; the URL states in"):
        await _open(plant.asked("in"))


def secured(url: str, ours: Signed, server: Path, password: Path) -> str:
    return f"{url}&certificate={ours.pem}&key={ours.key_pem}&server={server}&user=abbe&password_file={password}"


async def test_an_encrypted_control_with_users_is_read_and_no_other_server_is_spoken_to(tmp_path: Path) -> None:
    mill = issued(tmp_path, "mill", None, addresses=("127.0.0.1",), uri=MILL)
    ours = issued(tmp_path, "abbe", None, uri="urn:abbe:mill-7")
    other = issued(tmp_path, "other", None, addresses=("127.0.0.1",), uri=MILL)
    right, wrong = tmp_path / "right", tmp_path / "wrong"
    right.write_text("bar ball\n")
    wrong.write_text("ball bar\n")
    async with serving(mill, ours) as plant:
        control = await _open(secured(plant.asked(), ours, mill.pem, right))
        try:
            assert (await control.status()).position_mm == (1.5, -20.0, 300.25)
        finally:
            await control.close()
        for url in (secured(plant.asked(), ours, mill.pem, wrong), secured(plant.asked(), ours, other.pem, right), plant.asked()):
            with pytest.raises((BadFrame, LinkDown, ReplyTimeout)):
                await _open(url)


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ("&certificate={0}", "certificate, key and server belong together"),
        ("&user=abbe", "user and password_file belong together"),
        ("&user=abbe&password_file={0}", "over an encrypted session only"),
        ("&certificate={0}&key={0}&server=gone.der", "gone.der: no such file"),
        ("&certificate={0}&key={0}&server={0}", "certificate, key or password:"),
        ("&certificate=&key=&server=&user=abbe&password_file=", "no such file"),
    ],
)
async def test_a_session_that_is_half_secured_is_refused_before_anything_is_sent(tmp_path: Path, more: str, words: str) -> None:
    file = tmp_path / "file"
    file.write_text("no certificate")
    nodes = "opc.tcp://127.0.0.1:1/?x=ns%3D2%3Bs%3DX&y=ns%3D2%3Bs%3DY&z=ns%3D2%3Bs%3DZ"
    with pytest.raises(BadUrl, match=words):
        await DRIVER["cnc"](nodes + more.format(file))


async def test_a_file_is_put_into_it_and_read_back(plant: Plant) -> None:
    files = await open_files(f"{plant.url}?x.tab={FILE}&gone=ns=2;s=Nothing".replace(";", "%3B").replace("ns=2", "ns%3D2"))
    try:
        table = bytes(range(256)) * 100
        assert (files.names, await files.get("x.tab")) == ({"x.tab", "gone"}, b"old")
        await files.put("x.tab", table)
        assert (plant.content, await files.get("x.tab")) == (table, table)
        with pytest.raises(BadFrame, match="check that the nodes"):
            await files.get("gone")
    finally:
        await files.close()


def test_the_package_offers_it_by_its_scheme() -> None:
    offered = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["entry-points"]["abbe.drivers"]
    assert EntryPoint("opc.tcp", offered["opc.tcp"], "abbe.drivers").load() is DRIVER


async def test_the_service_opens_it_as_a_control_that_is_only_listened_to(
    plant: Plant, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    info = tmp_path / "site" / "abbe_opcua-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: abbe-opcua\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[abbe.drivers]\nopc.tcp = abbe.drivers.opcua_control:DRIVER\n")
    monkeypatch.syspath_prepend(str(info.parent))
    importlib.invalidate_caches()
    async with open_session(machine_with(tmp_path, plant.asked()).urls, listening=True) as session:
        assert only_listens(session.controller)
        assert (await session.controller.status()).position_mm == (1.5, -20.0, 300.25)


async def test_what_cannot_be_opened_is_named() -> None:
    with pytest.raises(BadUrl, match="nodes of X, Y and Z are needed"):
        await DRIVER["cnc"]("opc.tcp://127.0.0.1:4840/?x=ns%3D2%3Bs%3DX")
    with socket.create_server(("127.0.0.1", 0)) as held:
        port = held.getsockname()[1]
    with pytest.raises(LinkDown, match="check that the server is on"):
        await DRIVER["cnc"](f"opc.tcp://127.0.0.1:{port}/?x={X}&y={Y}&z={Z}".replace(";", "%3B"))
