"""The OPC UA address space: its content as a flat mapping from path to value (`Picture`), and the nodes that show it."""

from __future__ import annotations

import json
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Literal, TypeAlias

from asyncua import Node, Server, ua
from asyncua.common.instantiate_util import instantiate

from abbe.service.domain.progress import DeviceStatus
from abbe.service.domain.verification import Verification
from abbe.service.plant.gather import PlantAlarm, PlantFacts, PlantUnit, unit_of
from abbe.service.plant.opcua.types import Types, add_types, variables_under

Value: TypeAlias = str | bool | int | float | datetime | list[str] | list[datetime] | ua.NodeId | None
Kind = Literal["text", "flag", "count", "real", "time", "texts", "times", "localized", "node"]
PAST_CHECKS = 10
MAX_TEXT = 500


@dataclass(frozen=True, slots=True)
class Leaf:
    """One variable. ``value`` None: unknown, which is shown as a bad status and not as zero."""

    value: Value
    kind: Kind
    unit: PlantUnit | None = None


Picture = dict[str, Leaf]
"""Variables by their path under the machine's object, e.g. ``LastResult/Figures/body_diagonal_um``."""


def picture_of(facts: PlantFacts) -> Picture:
    """Return all variables of the machine."""
    return {
        "State": Leaf(facts.state, "text"),
        "Version": Leaf(facts.version, "text"),
        "NextCheck": Leaf(facts.next_utc, "time"),
        **_running(facts),
        **_last(facts.checks[0] if facts.checks else None, facts.verdict),
        **_past(facts.checks),
        **_alarms(facts.alarms),
        **_table(facts),
        **_devices(facts),
    }


def _running(facts: PlantFacts) -> Picture:
    now = facts.running
    return {
        "Check/Active": Leaf(now is not None, "flag"),
        "Check/Schedule": Leaf(now.schedule if now else None, "text"),
        "Check/Recipe": Leaf(now.recipe if now else None, "text"),
        "Check/Since": Leaf(now.since_utc if now else None, "time"),
        "Check/Stage": Leaf(now.stage if now else None, "text"),
        "Check/Message": Leaf(short_text(now.message) if now else None, "text"),
        "Check/Progress": Leaf(now.percent if now else None, "real", unit_of("progress_percent")),
        "Check/Remaining": Leaf(now.eta_s if now else None, "real", unit_of("remaining_s")),
    }


def _last(check: Verification | None, verdict: str | None) -> Picture:
    """Return the last check; ``verdict`` as `PlantFacts.verdict`."""
    out = {
        "LastResult/Number": Leaf(check.id if check else None, "count"),
        "LastResult/Verdict": Leaf(verdict, "text"),
        "LastResult/Text": Leaf(short_text(check.text) if check else None, "text"),
        "LastResult/Schedule": Leaf(check.schedule if check else None, "text"),
        "LastResult/Recipe": Leaf(check.recipe if check else None, "text"),
        "LastResult/Started": Leaf(check.started_utc if check else None, "time"),
        "LastResult/Duration": Leaf(check.duration_s if check else None, "real", unit_of("duration_s")),
    }
    for figure in check.figures if check else ():
        unit = unit_of(figure.name)
        out[f"LastResult/Figures/{figure.name}"] = Leaf(figure.value, "real", unit)
        out[f"LastResult/Uncertainties/{figure.name}"] = Leaf(figure.expanded, "real", unit)
        out[f"LastResult/Limits/{figure.name}"] = Leaf(figure.limit, "real", unit)
    return out


def _past(checks: tuple[Verification, ...]) -> Picture:
    shown = checks[:PAST_CHECKS]
    figures = [
        json.dumps({figure.name: [figure.value, figure.expanded, figure.limit] for figure in check.figures}, allow_nan=False)
        for check in shown
    ]
    return {
        "Results/Numbers": Leaf([str(check.id) for check in shown], "texts"),
        "Results/Verdicts": Leaf([str(check.verdict) for check in shown], "texts"),
        "Results/Started": Leaf([check.started_utc for check in shown], "times"),
        "Results/Figures": Leaf(figures, "texts"),
    }


def _alarms(alarms: tuple[PlantAlarm, ...]) -> Picture:
    return {
        "Alarms/Count": Leaf(len(alarms), "count"),
        "Alarms/Codes": Leaf([alarm.code for alarm in alarms], "texts"),
        "Alarms/Texts": Leaf([short_text(alarm.text) for alarm in alarms], "texts"),
        "Alarms/Devices": Leaf([short_text(alarm.device) for alarm in alarms], "texts"),
        "Alarms/Times": Leaf([alarm.at_utc for alarm in alarms], "times"),
    }


def _table(facts: PlantFacts) -> Picture:
    table, verified = facts.table, facts.verified
    return {
        "CompensationTable/Known": Leaf(table is not None, "flag"),
        "CompensationTable/Bank": Leaf(table.bank if table else None, "count"),
        "CompensationTable/Crc32": Leaf(f"{table.crc:08x}" if table else None, "text"),
        "CompensationTable/Push": Leaf(table.push if table else None, "count"),
        "CompensationTable/Since": Leaf(table.since_utc if table else None, "time"),
        "CompensationTable/Verified": Leaf({"verified": True, "unverified": False}.get(verified.state if verified else ""), "flag"),
        "CompensationTable/VerifiedText": Leaf(verified.text if verified else None, "text"),
    }


def _devices(facts: PlantFacts) -> Picture:
    out: Picture = {}
    for device in facts.devices:
        out[f"Devices/{device.role}/State"] = Leaf(device.state, "text")
        out[f"Devices/{device.role}/Text"] = Leaf(short_text(device.text), "text")
        out[f"Devices/{device.role}/LastHeard"] = Leaf(device.at_utc, "time")
    return out


def short_text(text: str) -> str:
    """Return printable text of at most `MAX_TEXT` characters: device strings may hold anything."""
    return "".join(c if c.isprintable() else " " for c in text)[:MAX_TEXT]


NAMESPACE = "urn:abbe:machine"
UNECE = "http://www.opcfoundation.org/UA/units/un/cefact"
_TYPES: dict[Kind, tuple[ua.VariantType, int]] = {
    "text": (ua.VariantType.String, ua.ObjectIds.String),
    "flag": (ua.VariantType.Boolean, ua.ObjectIds.Boolean),
    "count": (ua.VariantType.Int64, ua.ObjectIds.Int64),
    "real": (ua.VariantType.Double, ua.ObjectIds.Double),
    "time": (ua.VariantType.DateTime, ua.ObjectIds.UtcTime),
    "texts": (ua.VariantType.String, ua.ObjectIds.String),
    "times": (ua.VariantType.DateTime, ua.ObjectIds.UtcTime),
    "localized": (ua.VariantType.LocalizedText, ua.ObjectIds.LocalizedText),
    "node": (ua.VariantType.NodeId, ua.ObjectIds.NodeId),
}


ANY = PlantFacts("", "", datetime.fromtimestamp(0, UTC), None, None, (), (), (DeviceStatus(role="*", url="", state="not used yet"),))
"""A machine of which nothing is known: its picture holds the variables of the types."""
PROGRAM = "Production/ActiveProgram"
"""The running program of a MachineToolType."""
RUNNING = 5041
"""Node id of the state Running of a program (MachineTool)."""


class Space:
    """The machine's part of the address space; make it with `Space.built`."""

    def __init__(self, server: Server, index: int, machine: str, types: Types) -> None:
        self._server, self._index, self._machine = server, index, machine
        self.types = types
        self._nodes: dict[str, Node] = {}
        self._shown: Picture = {}
        self._stale = False

    @classmethod
    async def built(cls, server: Server, index: int, machine: str, *, companions: bool) -> Space:
        """Add the types and the machine; ``index``: index of Abbe's namespace; other arguments and errors as for `add_types`."""
        variables = [(path, ua.NodeId(_TYPES[leaf.kind][1])) for path, leaf in picture_of(ANY).items()]
        space = cls(server, index, machine, await add_types(server, index, variables, companions=companions))
        await space._add_machine()
        return space

    @property
    def root(self) -> Node:
        """The machine's node."""
        return self._nodes[""]

    async def _add_machine(self) -> None:
        parent, kind = (self._server.get_node(one) for one in (self.types.parent, self.types.of("")))
        name = ua.QualifiedName(self._machine, self._index)
        (node, *_) = await instantiate(parent, kind, self._id(""), name, ua.LocalizedText(self._machine), instantiate_optional=False)
        self._nodes = {"": node} | await variables_under(node)
        for path in self._nodes.keys() - {""}:  # what the standard wants and Abbe does not know has no value
            self._shown[path] = Leaf(None, "text")
            await self._server.write_attribute_value(self._nodes[path].nodeid, _data(self._shown[path], datetime.now(UTC)))

    async def show(self, picture: Picture, now: datetime) -> int:
        """Write changed values; return how many. Values missing from the picture become unknown."""
        picture = {**picture, **self._program(picture)}
        gone = {path: Leaf(None, leaf.kind, leaf.unit) for path, leaf in self._shown.items() if path not in picture}
        changed = {path: leaf for path, leaf in {**picture, **gone}.items() if self._stale or self._shown.get(path) != leaf}
        for path, leaf in changed.items():
            node = self._nodes.get(path) or await self._make(path, leaf)
            await self._server.write_attribute_value(node.nodeid, _data(leaf, now))
        self._shown, self._stale = {**picture, **gone}, False
        return len(changed)

    def _program(self, picture: Picture) -> Picture:
        """A running check is the machine's active program; what the machine runs otherwise is not known."""
        if self.types.tools is None:
            return {}
        running = picture["Check/Active"].value
        return {
            f"{PROGRAM}/Name": picture["Check/Recipe"],
            f"{PROGRAM}/State/CurrentState": Leaf("Running" if running else None, "localized"),
            f"{PROGRAM}/State/CurrentState/Id": Leaf(ua.NodeId(RUNNING, self.types.tools) if running else None, "node"),
        }

    async def show_stale(self, now: datetime) -> bool:
        """Mark every value as the last known one; return False if they were marked before."""
        if self._stale:
            return False
        self._stale = True
        for path, leaf in self._shown.items():
            value = _data(leaf, now)
            if leaf.value is not None:
                value = ua.DataValue(value.Value, ua.StatusCode(ua.StatusCodes.UncertainLastUsableValue), now, now)
            await self._server.write_attribute_value(self._nodes[path].nodeid, value)
        return True

    async def _object(self, path: str) -> Node:
        if path not in self._nodes:
            above, _, name = path.rpartition("/")
            item = ua.AddNodesItem()
            item.RequestedNewNodeId, item.BrowseName = self._id(path), ua.QualifiedName(name, self._index)
            item.NodeClass, item.ParentNodeId = ua.NodeClass.Object, (await self._object(above)).nodeid
            item.ReferenceTypeId = ua.NodeId(ua.ObjectIds.HasComponent)
            item.TypeDefinition = self.types.of(path)
            item.NodeAttributes = ua.ObjectAttributes(DisplayName=ua.LocalizedText(name), Description=ua.LocalizedText(name))
            self._nodes[path] = await self._add(item)
        return self._nodes[path]

    async def _add(self, item: ua.AddNodesItem) -> Node:
        (result,) = await self._server.iserver.isession.add_nodes([item])
        result.StatusCode.check()
        return self._server.get_node(item.RequestedNewNodeId)

    async def _make(self, path: str, leaf: Leaf) -> Node:
        above, _, name = path.rpartition("/")
        parent = await self._object(above)
        _, datatype = _TYPES[leaf.kind]
        item = ua.AddNodesItem()
        item.RequestedNewNodeId, item.BrowseName = self._id(path), ua.QualifiedName(name, self._index)
        item.NodeClass, item.ParentNodeId = ua.NodeClass.Variable, parent.nodeid
        item.ReferenceTypeId = ua.NodeId(ua.ObjectIds.HasComponent)
        item.TypeDefinition = ua.NodeId(ua.ObjectIds.AnalogUnitType if leaf.unit else ua.ObjectIds.BaseDataVariableType)
        attributes = ua.VariableAttributes()
        attributes.DisplayName, attributes.Description = ua.LocalizedText(name), ua.LocalizedText(name)
        attributes.DataType = ua.NodeId(datatype)
        attributes.ValueRank = ua.ValueRank.OneDimension if leaf.kind in {"texts", "times"} else ua.ValueRank.Scalar
        attributes.AccessLevel = attributes.UserAccessLevel = ua.AccessLevel.CurrentRead.mask
        attributes.Value = ua.Variant()
        item.NodeAttributes = attributes
        node = self._nodes[path] = await self._add(item)
        if leaf.unit is not None:
            await node.add_property(self._id(f"{path}.EngineeringUnits"), ua.QualifiedName("EngineeringUnits", 0), _engineering(leaf.unit))
        return node

    def _id(self, path: str) -> ua.NodeId:
        return ua.NodeId(f"{self._machine}/{path}" if path else self._machine, self._index)


def _data(leaf: Leaf, now: datetime) -> ua.DataValue:
    variant, _ = _TYPES[leaf.kind]
    if leaf.value is None:
        return ua.DataValue(ua.Variant(None, ua.VariantType.Null), ua.StatusCode(ua.StatusCodes.BadNoData), now, now)
    value = ua.LocalizedText(str(leaf.value)) if leaf.kind == "localized" else leaf.value
    return ua.DataValue(ua.Variant(value, variant), ua.StatusCode(ua.StatusCodes.Good), now, now)


def _engineering(unit: PlantUnit) -> ua.EUInformation:
    return ua.EUInformation(UNECE, unit.number, ua.LocalizedText(unit.symbol), ua.LocalizedText(unit.symbol))
