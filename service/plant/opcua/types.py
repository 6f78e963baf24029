"""Abbe's types in OPC UA, and the companion specifications that they derive from.

With the nodesets of DI, IA, Machinery (OPC 40001-1) and MachineTool (OPC 40501-1) at hand, the machine is a MachineToolType in the folder
``Machines``, and events are NotificationEventTypes. Without them the same types derive from the standard's types. An alarm is no
AlertType, because clients may acknowledge an AlertType, and here nothing can be written. OPC 40210 is not used, because no package holds
its nodeset.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import ParseError

from asyncua import Node, Server, ua

NODESETS = Path(__file__).resolve().parent / "nodesets"
COMPANIONS = tuple(f"Opc.Ua.{name}.NodeSet2.xml" for name in ("Di", "IA", "Machinery", "MachineTool"))
"""Nodesets of the companion specifications, each after those that it needs."""
MACHINERY, MACHINE_TOOL = (f"http://opcfoundation.org/UA/{name}/" for name in ("Machinery", "MachineTool"))
MACHINES, MACHINE_TOOL_TYPE, NOTIFICATION_EVENT_TYPE = 1001, 13, 35
"""Node ids: the folder of the machines (Machinery); types of a machine tool and of a notification (MachineTool)."""

OBJECT_TYPES = {
    "": "VerifiedMachineType",
    "Check": "RunningCheckType",
    "LastResult": "CheckResultType",
    "Results": "CheckListType",
    "Alarms": "AlarmListType",
    "CompensationTable": "CompensationTableType",
    "Devices/*": "DeviceConnectionType",
}
"""Type of an object by its path under the machine, ``*`` for any name; every other object is a folder."""
_TEXT, _COUNT = ua.VariantType.String, ua.VariantType.Int64
RESULT_FIELDS = (("Number", _COUNT), ("Verdict", _TEXT), ("Schedule", _TEXT), ("Recipe", _TEXT), ("Figures", _TEXT))
ALARM_FIELDS = (("Code", _TEXT), ("Device", _TEXT))


@dataclass(frozen=True, slots=True)
class Types:
    """Types of one server, and where it shows the machine. ``tools``: index of the companion specification's namespace, None if missing."""

    objects: dict[str, ua.NodeId]
    result_event: Node
    alarm_event: Node
    parent: ua.NodeId
    tools: int | None

    def of(self, path: str) -> ua.NodeId:
        """Return the type of the object at ``path``."""
        above, _, _ = path.rpartition("/")
        return self.objects.get(path) or self.objects.get(f"{above}/*") or ua.NodeId(ua.ObjectIds.FolderType)


def has_companions() -> bool:
    """Return whether the nodesets of the companion specifications are at hand."""
    return all((NODESETS / name).is_file() for name in COMPANIONS)


async def add_types(server: Server, index: int, variables: Iterable[tuple[str, ua.NodeId]], *, companions: bool) -> Types:
    """Add the companion specifications, if they are wanted, and Abbe's types.

    Parameters
    ----------
    server, index
        The server; index of Abbe's namespace.
    variables : iterable of (path, data type)
        What the objects of the types hold.

    Raises
    ------
    NodesetBroken
        A companion specification cannot be read; the server must not be used.
    """
    nodes = server.nodes
    machine, event, parent = nodes.base_object_type, nodes.base_event_type, nodes.objects.nodeid
    tools = None
    if companions:
        await _import_companions(server)
        machinery, tools = [await server.get_namespace_index(uri) for uri in (MACHINERY, MACHINE_TOOL)]
        machine, event = (server.get_node(ua.NodeId(number, tools)) for number in (MACHINE_TOOL_TYPE, NOTIFICATION_EVENT_TYPE))
        parent = ua.NodeId(MACHINES, machinery)
    types = {path: await (nodes.base_object_type if path else machine).add_object_type(index, name) for path, name in OBJECT_TYPES.items()}
    for path, datatype in variables:
        above, _, name = path.rpartition("/")
        if above in types:
            node = await types[above].add_variable(index, name, None, datatype=datatype)
            await node.set_modelling_rule(False)  # optional: what is not known is not there, or has no value
    await _add_parts(types, index)
    return Types(
        {path: node.nodeid for path, node in types.items()},
        await server.create_custom_event_type(index, "CheckResultEventType", event.nodeid, list(RESULT_FIELDS)),
        await server.create_custom_event_type(index, "AlarmEventType", event.nodeid, list(ALARM_FIELDS)),
        parent,
        tools,
    )


class NodesetBroken(Exception):  # noqa: N818 - a state of a file
    """A companion specification cannot be read."""


async def _import_companions(server: Server) -> None:
    for name in COMPANIONS:
        try:
            await server.import_xml(NODESETS / name)
        except (ParseError, ValueError, LookupError, RuntimeError, OSError, ua.UaError) as error:
            raise NodesetBroken(f"{name}: {type(error).__name__}: {error}") from error


async def _add_parts(types: dict[str, Node], index: int) -> None:
    """Declare the objects of a machine, all optional; ``Devices`` is a folder of connections."""
    for path, kind in types.items():
        if path and "/" not in path:
            part = await types[""].add_object(index, path, kind.nodeid, instantiate_optional=False)
            await part.set_modelling_rule(False)
    devices = await types[""].add_folder(index, "Devices")
    await devices.set_modelling_rule(False)


async def variables_under(node: Node, path: str = "") -> dict[str, Node]:
    """Return all variables under a node by their path of browse names."""
    found: dict[str, Node] = {}
    for child in await node.get_children():
        name = f"{path}/{(await child.read_browse_name()).Name}".strip("/")
        if await child.read_node_class() == ua.NodeClass.Variable:
            found[name] = child
        found |= await variables_under(child, name)
    return found
