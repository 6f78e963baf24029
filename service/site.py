"""One machine as a job sees it: its nominal geometry, where its devices are, and the limits that protect it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from models.machine import AXES, Machine
from service.config_schema import MachineFile
from service.devices.session import DeviceUrls


@dataclass(frozen=True, slots=True)
class TableLimits:
    """Largest absolute value, largest change against the active table, largest step between neighbours, mm (reliability.md 3.3)."""

    value_mm: float = 0.2
    change_mm: float = 0.2
    step_mm: float = 0.02


@dataclass(frozen=True, slots=True)
class Site:
    """Everything a workflow needs to know about a machine. ``doc`` is the machine object of run-format.md 1."""

    name: str
    machine: Machine
    doc: dict[str, Any]
    urls: DeviceUrls
    limits: TableLimits = field(default_factory=TableLimits)
    max_feed_mm_min: float = 6000.0
    temperature_c: tuple[float, float] = (18.0, 24.0)


def machine_from_doc(doc: dict[str, Any]) -> Machine:
    """Nominal geometry from a machine object (run-format.md 1); pivots and tool default to zero.

    Raises
    ------
    ValueError
        A key is missing or impossible; the message names it.
    """
    try:
        stroke = np.array([doc["stroke_mm"][a] for a in AXES], dtype=np.float64)
    except KeyError as missing:
        raise ValueError(f"machine: {missing} is missing") from None
    pivots = doc.get("pivots_mm") or {}
    return Machine(
        doc["chain"],
        stroke,
        np.array([pivots.get(a) or (0.0, 0.0, 0.0) for a in AXES], dtype=np.float64),
        np.array(doc.get("tool_mm") or (0.0, 0.0, 0.0), dtype=np.float64),
    )


def machine_doc(name: str, machine: Machine, vertical_axis: str = "Z") -> dict[str, Any]:
    """The machine object of run-format.md 1 for a nominal geometry."""
    return {
        "name": name,
        "chain": machine.chain,
        "vertical_axis": vertical_axis,
        "stroke_mm": {a: [float(v) for v in machine.stroke_mm[k]] for k, a in enumerate(AXES)},
        "pivots_mm": {a: [float(v) for v in machine.pivots_mm[k]] for k, a in enumerate(AXES)},
        "tool_mm": [float(v) for v in machine.tool_mm],
    }


def site_of(config: MachineFile) -> Site:
    """What the machine file says, in the units and types of the workflows."""
    doc = config.machine_doc()
    devices, limits = config.devices, config.limits
    return Site(
        config.name,
        machine_from_doc(doc),
        doc,
        DeviceUrls(devices.cnc, devices.ballbar, devices.laser, devices.fixture),
        TableLimits(limits.table_value_um * 1e-3, limits.table_change_um * 1e-3, limits.table_step_um * 1e-3),
        limits.feed_mm_min,
        limits.temperature_c,
    )
