"""Events of the OPC UA server: a check has ended, an alarm is new. Earlier events are in the variables only."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass

from asyncua import Node, Server, ua
from asyncua.server.event_generator import EventGenerator

from abbe.service.domain.verification import Verification
from abbe.service.plant.gather import PlantAlarm, PlantFacts
from abbe.service.plant.opcua.types import Types

SEVERITIES = {"pass": 100, "cannot tell": 500, "fail": 800}
"""Severity of a result, 1 to 1000 (OPC 10000-5, 6.4.2); that of an alarm is the highest."""


@dataclass(frozen=True, slots=True)
class News:
    """Events between two snapshots of the machine, oldest first."""

    checks: tuple[Verification, ...]
    alarms: tuple[PlantAlarm, ...]


def news(before: PlantFacts, now: PlantFacts) -> News:
    """Return the checks and alarms of ``now`` that ``before`` did not hold."""
    known_checks, known_alarms = {check.id for check in before.checks}, set(before.alarms)
    return News(
        tuple(check for check in reversed(now.checks) if check.id not in known_checks),
        tuple(alarm for alarm in reversed(now.alarms) if alarm not in known_alarms),
    )


class Events:
    """Emits events; make it with `Events.prepared`."""

    def __init__(self, results: Sequence[EventGenerator], alarms: Sequence[EventGenerator]) -> None:
        self._results, self._alarms = results, alarms
        self._known: PlantFacts | None = None

    @classmethod
    async def prepared(cls, server: Server, types: Types, machine: Node) -> Events:
        """Return the events of a server; ``machine``: their source. Subscribers of the server's node and of the machine's get them."""
        name = (await machine.read_browse_name()).Name
        generators = []
        for kind in (types.result_event, types.alarm_event):
            generators.append([await server.get_event_generator(kind, node) for node in (server.nodes.server, machine)])
            for generator in generators[-1]:
                generator.event.SourceNode, generator.event.SourceName = machine.nodeid, name
        return cls(*generators)

    async def show(self, facts: PlantFacts) -> None:
        """Emit what is new since the last call; the first call emits nothing."""
        new = news(self._known or facts, facts)
        self._known = facts
        for check in new.checks:
            figures = {one.name: [one.value, one.expanded, one.limit] for one in check.figures}
            fields = {
                "Number": check.id,
                "Verdict": check.verdict,
                "Schedule": check.schedule,
                "Recipe": check.recipe,
                "Figures": json.dumps(figures, allow_nan=False),
                "Identifier": f"check {check.id}",
            }
            await _emit(self._results, fields, check.text, SEVERITIES[check.verdict])
        for alarm in new.alarms:
            await _emit(
                self._alarms, {"Code": alarm.code, "Device": alarm.device, "Identifier": alarm.code}, alarm.text, SEVERITIES["fail"]
            )


async def _emit(generators: Sequence[EventGenerator], fields: dict[str, str | int], text: str, severity: int) -> None:
    for generator in generators:
        for name, value in fields.items():
            if hasattr(generator.event, name):  # an Identifier only where the companion specifications are
                setattr(generator.event, name, value)
        generator.event.Severity = severity
        generator.event.Message = ua.LocalizedText(text)
        await generator.trigger()
