"""Keep the nodes of the address space equal to a picture: create missing ones, write changed values."""

from __future__ import annotations

from datetime import datetime

from asyncua import Node, Server, ua

from abbe.service.plant.facts import PlantUnit
from abbe.service.plant.opcua.picture import Kind, Leaf, Picture

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
}


class Space:
    """The machine's part of the address space; ``index``: of Abbe's namespace."""

    def __init__(self, server: Server, index: int, machine: str) -> None:
        self._server, self._index, self._machine = server, index, machine
        self._nodes: dict[str, Node] = {}
        self._shown: Picture = {}
        self._stale = False

    async def show(self, picture: Picture, now: datetime) -> int:
        """Write changed values; return how many. Values missing from the picture become unknown."""
        gone = {path: Leaf(None, leaf.kind, leaf.unit) for path, leaf in self._shown.items() if path not in picture}
        changed = {path: leaf for path, leaf in {**picture, **gone}.items() if self._stale or self._shown.get(path) != leaf}
        for path, leaf in changed.items():
            node = self._nodes.get(path) or await self._make(path, leaf)
            await self._server.write_attribute_value(node.nodeid, _data(leaf, now))
        self._shown, self._stale = {**picture, **gone}, False
        return len(changed)

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

    async def _folder(self, path: str) -> Node:
        if path in self._nodes:
            return self._nodes[path]
        above, _, name = path.rpartition("/")
        parent = self._server.nodes.objects if not path else await self._folder(above)
        node = await parent.add_object(self._id(path), ua.QualifiedName(name or self._machine, self._index))
        self._nodes[path] = node
        return node

    async def _make(self, path: str, leaf: Leaf) -> Node:
        above, _, name = path.rpartition("/")
        parent = await self._folder(above)
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
        (result,) = await self._server.iserver.isession.add_nodes([item])
        result.StatusCode.check()
        node = self._nodes[path] = self._server.get_node(self._id(path))
        if leaf.unit is not None:
            await node.add_property(self._id(f"{path}.EngineeringUnits"), ua.QualifiedName("EngineeringUnits", 0), _engineering(leaf.unit))
        return node

    def _id(self, path: str) -> ua.NodeId:
        return ua.NodeId(f"{self._machine}/{path}" if path else self._machine, self._index)


def _data(leaf: Leaf, now: datetime) -> ua.DataValue:
    variant, _ = _TYPES[leaf.kind]
    if leaf.value is None:
        return ua.DataValue(ua.Variant(None, ua.VariantType.Null), ua.StatusCode(ua.StatusCodes.BadNoData), now, now)
    return ua.DataValue(ua.Variant(leaf.value, variant), ua.StatusCode(ua.StatusCodes.Good), now, now)


def _engineering(unit: PlantUnit) -> ua.EUInformation:
    return ua.EUInformation(UNECE, unit.number, ua.LocalizedText(unit.symbol), ua.LocalizedText(unit.symbol))
