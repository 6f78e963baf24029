"""Events of the OPC UA server: a check has ended, an alarm is new. Facts from before the server began are in its variables only."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime, timedelta

from asyncua import Node, Server, ua
from asyncua.server.event_generator import EventGenerator

from abbe.service.domain.verification import Verification
from abbe.service.plant.gather import SHOWN_ALARMS, PlantAlarm, PlantFacts
from abbe.service.plant.opcua.space import short_text
from abbe.service.plant.opcua.types import Types

SEVERITIES = {"pass": 100, "cannot tell": 500, "fail": 800}
"""Severity of a result, 1 to 1000 (OPC 10000-5, 6.4.2); an alarm has the highest."""


class News:
    """Finds the checks and alarms that were not shown before.

    Facts hold only the newest alarms. If an alarm leaves the full list, an older one returns to the list and is not new. An alarm has the
    time at which its check began, so alarms may arrive out of order.

    ``since``: checks that ended before this time are not new. Alarms of the first facts that were raised before this time are not new.
    """

    def __init__(self, since: datetime) -> None:
        self._since, self._check = since, -1
        self._shown: frozenset[PlantAlarm] | None = None
        self._oldest_utc = datetime.min.replace(tzinfo=UTC)

    def checks(self, facts: PlantFacts) -> list[Verification]:
        """Return the new checks, oldest first."""
        ended = [one for one in facts.checks if one.started_utc + timedelta(seconds=one.duration_s) > self._since]
        new = sorted((one for one in ended if one.id > self._check), key=lambda one: one.id)
        self._check = max([self._check, *(one.id for one in facts.checks)])
        return new

    def alarms(self, facts: PlantFacts) -> list[PlantAlarm]:
        """Return the new alarms, oldest first."""
        shown = self._shown
        if shown is None:
            shown = frozenset(one for one in facts.alarms if one.at_utc <= self._since)
        new = [one for one in reversed(facts.alarms) if one not in shown and one.at_utc > self._oldest_utc]
        if len(facts.alarms) >= SHOWN_ALARMS:
            self._oldest_utc = facts.alarms[-1].at_utc
        self._shown = frozenset(one for one in (*shown, *facts.alarms) if one.at_utc >= self._oldest_utc)
        return new


class Events:
    """Emits events; make it with `Events.prepared`."""

    def __init__(self, results: Sequence[EventGenerator], alarms: Sequence[EventGenerator], news: News) -> None:
        self._results, self._alarms, self._news = results, alarms, news

    @classmethod
    async def prepared(cls, server: Server, types: Types, machine: Node, since: datetime) -> Events:
        """Return the events of a server for subscribers of its own node and of the machine's node; ``machine``: source of the events."""
        name = (await machine.read_browse_name()).Name
        generators = []
        for kind in (types.result_event, types.alarm_event):
            generators.append([await server.get_event_generator(kind, node) for node in (server.nodes.server, machine)])
            for generator in generators[-1]:
                generator.event.SourceNode, generator.event.SourceName = machine.nodeid, name
                generator.event.data_types["Identifier"] = ua.VariantType.String  # the nodeset gives it no value, so asyncua no type
        results, alarms = generators
        return cls(results, alarms, News(since))

    async def show(self, facts: PlantFacts) -> None:
        """Emit what is new since the last call."""
        for check in self._news.checks(facts):
            figures = {one.name: [one.value, one.expanded, one.limit] for one in check.figures}
            fields: dict[str, str | int] = {
                "Number": check.id,
                "Verdict": check.verdict,
                "Schedule": check.schedule,
                "Recipe": check.recipe,
                "Figures": json.dumps(figures, allow_nan=False),
                "Identifier": f"check {check.id}",
            }
            ended = check.started_utc + timedelta(seconds=check.duration_s)
            await _emit(self._results, fields, check.text, SEVERITIES[check.verdict], ended)
        for alarm in self._news.alarms(facts):
            fields = {"Code": alarm.code, "Device": short_text(alarm.device), "Identifier": alarm.code}
            await _emit(self._alarms, fields, alarm.text, SEVERITIES["fail"], alarm.at_utc)


async def _emit(generators: Sequence[EventGenerator], fields: Mapping[str, str | int], text: str, severity: int, at_utc: datetime) -> None:
    for generator in generators:
        for name, value in fields.items():
            setattr(generator.event, name, value)
        generator.event.Severity = severity
        generator.event.Message = ua.LocalizedText(short_text(text))
        await generator.trigger(at_utc)
