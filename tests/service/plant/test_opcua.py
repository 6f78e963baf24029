"""The OPC UA server by asyncua's own client over real sockets: read, and nothing else, over every node there is."""

from __future__ import annotations

import asyncio
import json
import socket
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from copy import copy
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path

import pytest

from tests.patience import within

pytest.importorskip("asyncua", reason="the extra [opcua] is not installed")

from asyncua import Client, Node, ua
from asyncua.common.events import Event
from asyncua.crypto.security_policies import SecurityPolicyBasic256Sha256
from asyncua.server.address_space import NodeData, NodeManagementService
from asyncua.server.standard_address_space import standard_address_space
from asyncua.ua.uaerrors import UaStatusCodeError

from abbe.service.clock import Clock, SystemClock
from abbe.service.config_schema import OpcUa
from abbe.service.errors import ConfigError
from abbe.service.plant.gather import PlantAlarm
from abbe.service.plant.opcua import events as news
from abbe.service.plant.opcua import server as served
from abbe.service.plant.opcua import types
from abbe.service.plant.opcua.server import OpcUaServer
from abbe.service.plant.opcua.setup import check_opcua
from tests.certificates import Signed, issued
from tests.conftest import Require
from tests.service.plant.facts_for_tests import NOON, RUNNING, Source, check, facts

BASE = "ns=2;s=mill-7"
CLIENT_URI = "urn:plant:scada"
DI = "http://opcfoundation.org/UA/DI/"
ALARM = PlantAlarm("SCH-001", "weekly: the slot\x00 was missed", NOON + timedelta(hours=2))
NEW = replace(check(3, "fail", straightness_um=4.0), started_utc=NOON + timedelta(hours=1))


@asynccontextmanager
async def running(setup: OpcUa, source: Source, clock: Clock | None = None) -> AsyncIterator[OpcUaServer]:
    stop = asyncio.Event()
    part = OpcUaServer(setup, source, clock or SystemClock(), "mill-7", "0.1.0")
    task = asyncio.create_task(part.run(stop))
    heard = asyncio.create_task(part.listening.wait())
    try:
        async with asyncio.timeout(within(60)):
            await asyncio.wait({task, heard}, return_when=asyncio.FIRST_COMPLETED)
        if task.done():
            await task
        yield part
    finally:
        heard.cancel()
        stop.set()
        async with asyncio.timeout(within(5)):
            await task
        assert part.port == 0


def _copied(nodes: dict[ua.NodeId, NodeData]) -> dict[ua.NodeId, NodeData]:
    """What a server may change of its nodes is its own: values, references, who is told."""
    found = {}
    for nodeid, node in nodes.items():
        own = found[nodeid] = copy(node)
        own.references = [copy(one) for one in node.references]
        own.attributes = {which: copy(one) for which, one in node.attributes.items()}
        for one in own.attributes.values():
            one.datachange_callbacks = {}
    return found


@pytest.fixture(scope="module", autouse=True)
def _standard_nodes_built_once() -> Iterator[None]:
    """The nodes of the standard are built by the first server; those after it get copies of them."""
    fill, kept = standard_address_space.fill_address_space, dict[ua.NodeId, NodeData]()

    def filled(service: NodeManagementService) -> None:
        if not kept:
            fill(service)
            kept.update(_copied(service._aspace._nodes))
        else:
            service._aspace._nodes.update(_copied(kept))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(standard_address_space, "fill_address_space", filled)
        yield


@pytest.fixture
def source() -> Source:
    return Source()


@pytest.fixture(autouse=True)
def often(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(served, "PERIOD_S", 0.02)


def client_of(part: OpcUaServer) -> Client:
    # The client probes its server as often as this and gives up when an answer takes longer: no question of a busy test machine.
    return Client(f"opc.tcp://127.0.0.1:{part.port}/abbe/", timeout=20, watchdog_intervall=30)


async def value(client: Client, path: str) -> object:
    return await client.get_node(f"{BASE}/{path}").read_value()


class Turned:
    """Waits for the server to have shown what is new: told by a subscription, as a real client is."""

    def __init__(self) -> None:
        self.values: asyncio.Queue[object] = asyncio.Queue()

    def datachange_notification(self, node: Node, val: object, data: object) -> None:
        self.values.put_nowait(val)

    async def until(self, wanted: object) -> None:
        async with asyncio.timeout(within(20)):
            while await self.values.get() != wanted:
                pass


async def test_what_is_shown_follows_the_facts(source: Source) -> None:
    async with running(OpcUa(port=0), source) as part, client_of(part) as client:
        assert await value(client, "State") == "idle"
        assert (await value(client, "LastResult/Verdict"), await value(client, "LastResult/Number")) == ("fail", 2)
        figure = client.get_node(f"{BASE}/LastResult/Figures/body_diagonal_um")
        assert await figure.read_value() == 11.8
        assert await value(client, "LastResult/Uncertainties/body_diagonal_um") == 1.1
        assert await value(client, "LastResult/Limits/body_diagonal_um") == 20.0
        (unit,) = await figure.get_properties()
        assert (await unit.read_browse_name()).Name == "EngineeringUnits"
        unit_value = await unit.read_value()
        assert (unit_value.DisplayName.Text, unit_value.UnitId) == ("µm", 13384)
        assert (await figure.read_type_definition()) == ua.NodeId(ua.ObjectIds.AnalogUnitType)
        assert (await value(client, "CompensationTable/Bank"), await value(client, "CompensationTable/Crc32")) == (1, "0000beef")
        assert await value(client, "Alarms/Codes") == ["DRV-002"]
        assert await value(client, "Results/Verdicts") == ["fail", "pass"]
        assert await value(client, "Devices/cnc/Text") == "refused by peer"
        progress = client.get_node(f"{BASE}/Check/Progress")
        assert (await progress.read_data_value(raise_on_bad_status=False)).StatusCode.name == "BadNoData"

        turned = Turned()
        subscription = await client.create_subscription(20, turned)
        await subscription.subscribe_data_change(client.get_node(f"{BASE}/LastResult/Number"))
        source.now = facts(running=RUNNING, checks=(check(3, straightness_um=4.0),), table=None)
        await turned.until(3)
        assert (await value(client, "State"), await progress.read_value()) == ("measuring", 30.0)
        assert await value(client, "Check/Message") == "revolution 3 of 10"
        assert await value(client, "LastResult/Figures/straightness_um") == 4.0
        for gone in ("LastResult/Figures/body_diagonal_um", "CompensationTable/Bank"):
            assert (await client.get_node(f"{BASE}/{gone}").read_data_value(raise_on_bad_status=False)).StatusCode.name == "BadNoData"

        source.now = None
        state = client.get_node(f"{BASE}/State")
        await source.asked_again()
        stale = await state.read_data_value(raise_on_bad_status=False)
        assert (stale.Value.Value, stale.StatusCode.name) == ("measuring", "UncertainLastUsableValue")
        source.now = facts()
        await turned.until(2)
        assert (await state.read_data_value()).StatusCode.is_good()
        await subscription.delete()


NODESETS = types.NODESETS


@pytest.fixture(autouse=True)
def _standard_types_only(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Reading the companion specifications takes a second of each start: only tests that ask for them have them."""
    monkeypatch.setattr(types, "NODESETS", tmp_path)


@pytest.fixture(params=[True, False], ids=["companion specifications", "standard types only"])
def companions(require: Require, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> bool:
    if request.param:
        require("nodesets", (NODESETS / types.COMPANIONS[-1]).is_file(), "deploy/npm_files.py did not fetch them")
        monkeypatch.setattr(types, "NODESETS", NODESETS)
    return bool(request.param)


async def test_a_client_knows_the_machine_by_its_types(source: Source, companions: bool) -> None:
    source.now = facts(running=RUNNING)
    async with running(OpcUa(port=0), source) as part, client_of(part) as client:
        machine = client.get_node(BASE)
        kind = client.get_node(await machine.read_type_definition())
        above = await (await kind.get_parent()).read_browse_name()
        where = await (await machine.get_parent()).read_browse_name()
        assert (await kind.read_browse_name()).Name == "VerifiedMachineType"
        assert (above.Name, where.Name) == (("MachineToolType", "Machines") if companions else ("BaseObjectType", "Objects"))
        for path, name in {
            "LastResult": "CheckResultType",
            "Devices/cnc": "DeviceConnectionType",
            "LastResult/Limits": "FolderType",
        }.items():
            assert await type_name(client, path) == name
        declared = {(await one.read_browse_name()).Name for one in await client.get_node(await type_of(client, "Check")).get_children()}
        shown = {(await one.read_browse_name()).Name for one in await client.get_node(f"{BASE}/Check").get_children()}
        assert declared == shown
        parts = {(await one.read_browse_name()).Name for one in await kind.get_children()}
        assert {"State", "Check", "LastResult", "Alarms", "CompensationTable", "Devices"} <= parts
        if companions:
            uris = [await client.get_namespace_index(uri) for uri in (DI, types.MACHINE_TOOL)]
            program = await machine.get_child([f"{uris[1]}:Production", f"{uris[1]}:ActiveProgram", f"{uris[1]}:Name"])
            serial = await machine.get_child([f"{uris[0]}:Identification", f"{uris[0]}:SerialNumber"])
            state = await machine.get_child([*(f"{uris[1]}:{name}" for name in ("Production", "ActiveProgram", "State")), "0:CurrentState"])
            at = await client.get_node(await (await state.get_child("0:Id")).read_value()).read_browse_name()
            assert (await program.read_value(), (await state.read_value()).Text, at.Name) == ("quick-check", "Running", "Running")
            assert (await serial.read_data_value(raise_on_bad_status=False)).StatusCode.name == "BadNoData", "not known, so not invented"
            source.now = None
            await source.asked_again()
            stale = await program.read_data_value(raise_on_bad_status=False)
            assert stale.StatusCode.name == "UncertainLastUsableValue"


async def type_of(client: Client, path: str) -> ua.NodeId:
    return await client.get_node(f"{BASE}/{path}").read_type_definition()


async def type_name(client: Client, path: str) -> str:
    return (await client.get_node(await type_of(client, path)).read_browse_name()).Name


class AtNoon(SystemClock):
    """The server began before what is new."""

    def utc(self) -> datetime:
        return NOON


def test_what_comes_back_into_a_full_list_is_no_news() -> None:
    """Facts hold the newest twenty alarms and ten checks: when one leaves them, an older one returns."""
    alarms = [PlantAlarm("SCH-001", f"slot {k}", NOON - timedelta(days=k)) for k in range(21)]  # newest first
    new = news.News(NOON)
    assert new.alarms(facts(alarms=tuple(alarms[:20]))) == []
    assert new.alarms(facts(alarms=tuple(alarms[1:]))) == []
    twins = tuple(replace(ALARM, text=f"twin {k}") for k in (2, 1))
    assert [one.text for one in new.alarms(facts(alarms=(*twins[1:], *alarms[:19])))] == ["twin 1"]
    assert [one.text for one in new.alarms(facts(alarms=(*twins, *alarms[:18])))] == ["twin 2"]
    assert new.checks(facts(checks=(check(2),))) == []
    assert [one.id for one in new.checks(facts(checks=(NEW, check(2), check(1))))] == [3]
    assert new.checks(facts(checks=(NEW, check(2)))) == []


def test_the_alarm_of_a_check_is_new_though_the_check_began_before_another_alarm() -> None:
    new, began = news.News(NOON), PlantAlarm("DRV-002", "the check failed", NOON - timedelta(minutes=5))
    assert new.alarms(facts(alarms=())) == []
    assert new.alarms(facts(alarms=(ALARM,))) == [ALARM]
    assert new.alarms(facts(alarms=(ALARM, began))) == [began]
    assert new.alarms(facts(alarms=(ALARM, began))) == []


async def test_a_damaged_nodeset_is_left_out(source: Source, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in types.COMPANIONS:
        (tmp_path / name).write_text("<UANodeSet")
    monkeypatch.setattr(types, "NODESETS", tmp_path)
    async with running(OpcUa(port=0), source) as part, client_of(part) as client:
        assert await value(client, "State") == "idle"


class Heard:
    """Collects events, as a real client gets them."""

    def __init__(self) -> None:
        self.events: asyncio.Queue[Event] = asyncio.Queue()

    def event_notification(self, event: Event) -> None:
        self.events.put_nowait(event)

    async def next(self) -> Event:
        async with asyncio.timeout(within(20)):
            return await self.events.get()


@pytest.mark.parametrize("emitter", ["i=2253", BASE], ids=["at the server", "at the machine"])
async def test_a_check_that_ended_and_a_new_alarm_are_events(source: Source, companions: bool, emitter: str) -> None:
    async with running(OpcUa(port=0), source, AtNoon()) as part, client_of(part) as client:
        heard = Heard()
        subscription = await client.create_subscription(20, heard)
        kinds = [one for path in ("CheckResultEventType", "AlarmEventType") for one in [await event_type(client, path, companions)]]
        await subscription.subscribe_events(client.get_node(emitter), kinds)
        await source.asked_again()
        assert heard.events.empty(), "what was known at the start is no news"
        source.now = facts(checks=(NEW, check(2, "fail")), alarms=(ALARM, *facts().alarms))
        result, alarm = await heard.next(), await heard.next()
        assert (result.Number, result.Verdict, result.Recipe, result.Severity) == (3, "fail", "quick-check", 800)
        assert (json.loads(result.Figures), result.Message.Text) == ({"straightness_um": [4.0, 1.1, 20.0]}, "check 3: fail")
        assert (alarm.Code, alarm.Message.Text, alarm.SourceName) == ("SCH-001", "weekly: the slot  was missed", "mill-7")
        assert (alarm.Time, result.Time) == (ALARM.at_utc, NEW.started_utc + timedelta(seconds=61))
        if companions:
            assert (result.Identifier, alarm.Identifier) == ("check 3", "SCH-001")
        await source.asked_again()
        assert heard.events.empty(), "each once"


async def event_type(client: Client, name: str, companions: bool) -> Node:
    base = client.nodes.base_event_type
    if companions:
        base = client.get_node(ua.NodeId(types.NOTIFICATION_EVENT_TYPE, await client.get_namespace_index(types.MACHINE_TOOL)))
    return await base.get_child(f"2:{name}")


async def every_node(client: Client) -> list[tuple[ua.NodeId, ua.NodeClass]]:
    """All nodes that can be reached from the root, by browsing a hundred at a time."""
    root = client.nodes.root.nodeid
    known: dict[ua.NodeId, ua.NodeClass] = {root: ua.NodeClass.Object}
    edge = [root]
    while edge:
        asked, edge = edge[:100], edge[100:]
        parameters = ua.BrowseParameters()
        for nodeid in asked:
            what = ua.BrowseDescription()
            what.NodeId, what.BrowseDirection, what.IncludeSubtypes = nodeid, ua.BrowseDirection.Forward, True
            what.ReferenceTypeId = ua.NodeId(ua.ObjectIds.HierarchicalReferences)
            what.ResultMask = ua.BrowseResultMask.All
            parameters.NodesToBrowse.append(what)
        for result in await client.uaclient.browse(parameters):
            for one in result.References:
                if one.NodeId not in known:
                    known[one.NodeId] = one.NodeClass
                    edge.append(one.NodeId)
    return list(known.items())


async def test_no_node_can_be_written_and_no_method_called(source: Source, companions: bool) -> None:
    async with running(OpcUa(port=0), source) as part, client_of(part) as client:
        nodes = await every_node(client)
        ours = [nodeid for nodeid, _ in nodes if nodeid.NamespaceIndex == 2]
        assert len(ours) > 60
        assert len(nodes) > (4000 if companions else 3000)

        refused = 0
        for start in range(0, len(nodes), 100):
            writes = ua.WriteParameters()
            for nodeid, _ in nodes[start : start + 100]:
                for attribute in (ua.AttributeIds.Value, ua.AttributeIds.DisplayName, ua.AttributeIds.AccessLevel):
                    write = ua.WriteValue()
                    write.NodeId, write.AttributeId = nodeid, attribute
                    write.Value = ua.DataValue(ua.Variant(1, ua.VariantType.Int32))
                    writes.NodesToWrite.append(write)
            for status in await client.uaclient.write(writes):
                assert status.name == "BadNotWritable"
                refused += 1
        assert refused == 3 * len(nodes)

        levels = [ua.AttributeIds.AccessLevel, ua.AttributeIds.UserAccessLevel]
        variables = [nodeid for nodeid, kind in nodes if kind == ua.NodeClass.Variable]
        methods = [nodeid for nodeid, kind in nodes if kind == ua.NodeClass.Method]
        read = [one for level in levels for one in await client.uaclient.read_attributes(variables, level)]
        assert [one for one in read if one.Value.Value & ~(ua.AccessLevel.CurrentRead.mask | ua.AccessLevel.HistoryRead.mask)] == []
        executable = [one for at in (ua.AttributeIds.Executable, ua.AttributeIds.UserExecutable) for one in
                      await client.uaclient.read_attributes(methods, at)]  # fmt: skip
        assert not any(one.Value.Value for one in executable)
        assert not [nodeid for nodeid in methods if nodeid.NamespaceIndex == 2], "no method of ours at all"
        calls = [ua.CallMethodRequest(client.nodes.server.nodeid, nodeid, []) for nodeid in methods]
        results = await client.uaclient.call(calls)
        assert {one.StatusCode.name for one in results} == {"BadNotExecutable"}
        assert len(results) == len(methods) > 20
        print(f"{len(nodes)} nodes, {len(variables)} variables, {len(methods)} methods: {refused} writes and {len(results)} calls refused")  # noqa: T201 - the figure of the test


async def test_nothing_can_be_added_or_removed_or_registered_and_nobody_logs_in_by_name(source: Source) -> None:
    async with running(OpcUa(port=0), source) as part, client_of(part) as client:
        named = client_of(part)
        named.set_user("admin")
        named.set_password("admin")
        with pytest.raises((UaStatusCodeError, ua.UaError)):
            await named.connect()
        state = ua.NodeId.from_string(f"{BASE}/State")
        with pytest.raises(UaStatusCodeError) as refused:
            await client.nodes.objects.add_object(ua.NodeId("x", 2), ua.QualifiedName("x", 2))
        assert refused.value.code == ua.StatusCodes.BadUserAccessDenied
        gone = ua.DeleteNodesParameters()
        gone.NodesToDelete.append(ua.DeleteNodesItem(state, True))
        with pytest.raises(UaStatusCodeError):
            await client.uaclient.delete_nodes(gone)
        reference = ua.DeleteReferencesItem(ua.NodeId.from_string(BASE), ua.NodeId(ua.ObjectIds.HasComponent), True, state, True)
        with pytest.raises(UaStatusCodeError):
            await client.uaclient.delete_references([reference])
        server = ua.RegisteredServer()
        server.ServerUri, server.ServerNames = "urn:foreign", [ua.LocalizedText("x")]
        with pytest.raises(UaStatusCodeError):
            await client.uaclient.register_server(server)
        assert await value(client, "State") == "idle"
        assert [one.ApplicationUri for one in await client.uaclient.find_servers(ua.FindServersParameters())] == ["urn:abbe:mill-7"]


# --- encrypted -----------------------------------------------------------------------------------------------------------------------


@pytest.fixture
def scada(tmp_path: Path) -> Signed:
    return issued(tmp_path, "scada", None, uri=CLIENT_URI)


@pytest.fixture
def guarded(tmp_path: Path, scada: Signed) -> OpcUa:
    own = issued(tmp_path, "abbe", None, addresses=("127.0.0.1",), uri="urn:abbe:mill-7")
    setup = OpcUa(host="127.0.0.1", port=0, certificate=str(own.pem), key=str(own.key_pem), clients=(str(scada.pem),))
    check_opcua(setup)
    return setup


async def encrypted(part: OpcUaServer, channel: Signed, user: Signed | None, own: str) -> Client:
    client = client_of(part)
    client.application_uri = CLIENT_URI
    await client.set_security(SecurityPolicyBasic256Sha256, channel.pem, channel.key_pem, server_certificate=own)
    if user is not None:
        await client.load_client_certificate(user.pem)
        await client.load_private_key(user.key_pem)
    return client


async def test_a_known_client_reads_encrypted(source: Source, guarded: OpcUa, scada: Signed) -> None:
    async with running(guarded, source) as part:
        client = await encrypted(part, scada, scada, guarded.certificate)
        async with client:
            assert await value(client, "LastResult/Verdict") == "fail"
            with pytest.raises(UaStatusCodeError) as refused:
                await client.get_node(f"{BASE}/State").write_value("x")
            assert refused.value.code == ua.StatusCodes.BadNotWritable
        offered = await client_of(part).connect_and_get_server_endpoints()
        assert [(one.SecurityPolicyUri.rpartition("#")[2], one.SecurityMode.name) for one in offered] == [
            ("Basic256Sha256", "SignAndEncrypt")
        ]


async def test_everybody_else_is_refused(tmp_path: Path, source: Source, guarded: OpcUa, scada: Signed) -> None:
    stranger = issued(tmp_path, "stranger", None, uri=CLIENT_URI)
    old = issued(tmp_path, "old", None, uri=CLIENT_URI, days=(-30, -1))
    setup = guarded.model_copy(update={"clients": (*guarded.clients, str(old.pem))})
    async with running(setup, source) as part:
        own = setup.certificate
        in_clear = client_of(part)
        await in_clear.load_client_certificate(scada.pem)
        await in_clear.load_private_key(scada.key_pem)
        by_name = await encrypted(part, scada, None, own)
        by_name.set_user("admin")
        by_name.set_password("admin")
        everybody = {
            "nobody": client_of(part),
            "known, in clear": in_clear,
            "stranger": await encrypted(part, stranger, stranger, own),
            "known, by a stranger's channel": await encrypted(part, stranger, scada, own),
            "stranger, by a known channel": await encrypted(part, scada, stranger, own),
            "known channel, nobody in it": await encrypted(part, scada, None, own),
            "known channel, by name": by_name,
            "certificate run out": await encrypted(part, old, old, own),
        }
        for who, client in everybody.items():
            with pytest.raises((UaStatusCodeError, ua.UaError, ConnectionError, TimeoutError)):
                async with client:
                    pytest.fail(f"{who} got in")
        known = await encrypted(part, scada, scada, own)
        async with known:
            assert await value(known, "State") == "idle"


# --- what it refuses to start with, and what it does when it cannot ---------------------------------------------------------------------


@pytest.mark.parametrize(
    ("setup", "words"),
    [
        (OpcUa(host="0.0.0.0"), "reached by other computers: it needs certificate, key and clients"),
        (OpcUa(host="192.0.2.7", port=4840, certificate="c.pem", key="k.pem"), "needs certificate, key and clients"),
        (OpcUa(host="plant.example", port=4840), "needs certificate, key and clients"),
        (OpcUa(clients=("x.pem",)), "clients needs certificate and key"),
        (OpcUa(certificate="gone.pem", key="gone.key"), "no such file"),
        (OpcUa(host="0.0.0.0", port=4840, certificate="c.pem", key="k.pem", clients=("gone.pem",)), "clients: gone.pem"),
    ],
)
def test_an_exposed_server_needs_to_know_its_clients(setup: OpcUa, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        check_opcua(setup)


def test_a_client_that_is_no_certificate(tmp_path: Path) -> None:
    (tmp_path / "x.pem").write_text("-----BEGIN CERTIFICATE-----\nAAAA\n-----END CERTIFICATE-----\n")
    with pytest.raises(ConfigError, match="is not a certificate"):
        check_opcua(OpcUa(host="0.0.0.0", port=4840, certificate="c.pem", key="k.pem", clients=(str(tmp_path / "x.pem"),)))


def test_without_the_extra_one_clear_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"needs the package 'asyncua' - pip install 'abbe\[opcua\]'"):
        check_opcua(OpcUa())


class Paced(SystemClock):
    """Pauses are short, and heard of."""

    def __init__(self) -> None:
        self.pauses: asyncio.Queue[float] = asyncio.Queue()

    async def sleep(self, s: float) -> None:
        self.pauses.put_nowait(s)
        await super().sleep(min(s, 0.02))


async def test_a_port_that_somebody_has_is_tried_again(source: Source) -> None:
    clock, stop = Paced(), asyncio.Event()
    with socket.create_server(("127.0.0.1", 0)) as taken:
        part = OpcUaServer(OpcUa(port=int(taken.getsockname()[1])), source, clock, "mill-7", "0.1.0")
        task = asyncio.create_task(part.run(stop))
        async with asyncio.timeout(within(30)):
            assert [await clock.pauses.get(), await clock.pauses.get()] == [served.AGAIN_S, served.AGAIN_S]
        assert not task.done()
        assert not part.listening.is_set()
    async with asyncio.timeout(within(30)):
        await part.listening.wait()
    stop.set()
    await task
