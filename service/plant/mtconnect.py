"""MTConnect 1.8 documents of one machine: Devices, Streams and Error, made from facts. Pure except for the sequence numbers.

`Agent` implements an MTConnect agent without assets, and without XPath (``path``) and streaming (``interval``). It observes the
machine at each request. An answer contains the checks that ended since the last request, ten at most, but no earlier state of a running
check.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime

from abbe.service.domain.verification import Verification
from abbe.service.plant.gather import PlantFacts

VERSION = "1.8"
BUFFER = 4096
UNAVAILABLE = "UNAVAILABLE"
Entries = tuple[tuple[str, str], ...]

# id, category, type, representation: the data items, in the order of the documents.
ITEMS = (
    ("avail", "EVENT", "AVAILABILITY", ""),
    ("exec", "EVENT", "EXECUTION", ""),
    ("prog", "EVENT", "PROGRAM", ""),
    ("msg", "EVENT", "MESSAGE", ""),
    ("result", "EVENT", "VARIABLE", "DATA_SET"),
    ("table", "EVENT", "VARIABLE", "DATA_SET"),
    ("system", "CONDITION", "SYSTEM", ""),
)
AGENT_ITEMS = (
    ("agent_avail", "EVENT", "AVAILABILITY", ""),
    ("added", "EVENT", "DEVICE_ADDED", ""),
    ("removed", "EVENT", "DEVICE_REMOVED", ""),
    ("changed", "EVENT", "DEVICE_CHANGED", ""),
)
"""Data items of the agent: MTConnect 1.7 and later require that it is a device itself."""
_NAMES = {"result": "last_check", "table": "compensation_table"}


class MtconnectRefusal(Exception):  # noqa: N818 - reads as what it is
    """A refused request: the code of the Error document, its text, and the HTTP status."""

    def __init__(self, code: str, text: str, status: int = 400) -> None:
        self.code, self.text, self.status = code, text, status
        super().__init__(text)


@dataclass(frozen=True, slots=True)
class Observation:
    """One value of one data item. ``level``: level of a condition; ``native``: code of a condition."""

    sequence: int
    item: str
    utc: datetime
    value: str | Entries
    level: str = ""
    native: str = ""

    def same(self, other: Observation | None) -> bool:
        """Return whether another observation has the same value."""
        return other is not None and (self.value, self.level, self.native) == (other.value, other.level, other.native)


class Agent:
    """Buffer of observations of one machine, numbered from 1 without gaps. ``instance``: the ``instanceId``, new after each start."""

    def __init__(self, instance: int, buffer: int = BUFFER) -> None:
        self._instance, self._size = instance, buffer
        self._buffer: deque[Observation] = deque()
        self._before: dict[str, Observation] = {}  # values before the oldest observation in the buffer
        self._latest: dict[str, Observation] = {}
        self._next = 1
        self._last_check = 0

    def update(self, facts: PlantFacts) -> None:
        """Add observations of everything that has changed."""
        now, job = facts.now_utc, facts.running
        for item, value in (("agent_avail", "AVAILABLE"), ("added", _uuid(facts)), ("removed", UNAVAILABLE), ("changed", UNAVAILABLE)):
            self._put(item, now, value)
        self._put("avail", now, "AVAILABLE")
        self._put("exec", now, "ACTIVE" if job else "READY")
        self._put("prog", now, job.recipe if job else UNAVAILABLE)
        self._put("msg", now, f"{job.stage}: {job.message}" if job and job.stage else UNAVAILABLE)
        if not facts.checks:
            self._put("result", now, UNAVAILABLE)
        for check in sorted(facts.checks[1:], key=lambda one: one.id):
            if check.id > self._last_check:
                self._put("result", now, _result(check, check.verdict))
        if facts.checks:  # a verdict about an earlier table does not hold for the table in force
            self._put("result", now, _result(facts.checks[0], facts.verdict or ""))
            self._last_check = facts.checks[0].id
        table = facts.table
        known = (("bank", str(table.bank)), ("crc32", f"{table.crc:08x}"), ("push", str(table.push))) if table else ()
        verified = () if facts.verified is None else (("verified", facts.verified.state), ("verified_text", facts.verified.text))
        self._put("table", now, (*known, *verified) if known else UNAVAILABLE)
        self._put("system", now, *_condition(facts))

    def _put(self, item: str, utc: datetime, value: str | Entries, level: str = "", native: str = "") -> None:
        one = Observation(self._next, item, utc, value, level, native)
        if one.same(self._latest.get(item)):
            return
        self._next += 1
        self._latest[item] = one
        self._buffer.append(one)
        if len(self._buffer) > self._size:
            gone = self._buffer.popleft()
            self._before[gone.item] = gone

    def probe(self, facts: PlantFacts) -> bytes:
        """Return the Devices document."""
        root = _root(
            "MTConnectDevices", self._header(facts.now_utc, deviceModelChangeTime=self._changed, assetBufferSize="1", assetCount="0")
        )
        devices, version = ET.SubElement(root, "Devices"), f"Abbe {facts.version}"
        agent = ET.SubElement(devices, "Agent", id="agent", name="Agent", uuid=_agent_uuid(facts), mtconnectVersion=VERSION)
        device = ET.SubElement(devices, "Device", id="dev", name=_clean(facts.machine), uuid=_uuid(facts))
        for one, declared in ((agent, AGENT_ITEMS), (device, ITEMS)):
            ET.SubElement(one, "Description", manufacturer="Abbe").text = version
            self._declare(ET.SubElement(one, "DataItems"), declared)
        return _bytes(root)

    def _declare(self, items: ET.Element, declared: tuple[tuple[str, str, str, str], ...]) -> None:
        for item, category, kind, representation in declared:
            attributes = {"id": item, "category": category, "type": kind}
            attributes |= {"representation": representation} if representation else {}
            attributes |= {"name": _NAMES[item]} if item in _NAMES else {}
            ET.SubElement(items, "DataItem", attributes)

    def current(self, facts: PlantFacts, query: Mapping[str, str]) -> bytes:
        """Return the Streams document of the current values, or of the values when observation ``at`` was made."""
        _only(query, {"at"})
        at = self._number(query, "at", self._next - 1, self._first, self._next - 1)
        latest = self._before | {one.item: one for one in self._buffer if one.sequence <= at}
        return self._streams(facts, list(latest.values()), at + 1)

    def sample(self, facts: PlantFacts, query: Mapping[str, str]) -> bytes:
        """Return the Streams document of up to ``count`` observations from number ``from`` on."""
        _only(query, {"from", "count"})
        start = self._number(query, "from", self._first, self._first, self._next)
        count = self._number(query, "count", 100, 1, self._size)
        found = [one for one in self._buffer if one.sequence >= start][:count]
        return self._streams(facts, found, found[-1].sequence + 1 if found else self._next)

    @property
    def _first(self) -> int:
        return self._buffer[0].sequence

    def _number(self, query: Mapping[str, str], name: str, default: int, least: int, most: int) -> int:
        text = query.get(name)
        if text is None:
            return default
        try:
            number = int(text)
        except ValueError:
            raise MtconnectRefusal("INVALID_REQUEST", f"{name} is {text[:40]!r}, expected a whole number") from None
        if not least <= number <= most:
            raise MtconnectRefusal("OUT_OF_RANGE", f"{name} is {text[:40]}, expected {least} to {most}", 404)
        return number

    def _streams(self, facts: PlantFacts, found: list[Observation], following: int) -> bytes:
        numbers = {"nextSequence": following, "firstSequence": self._first, "lastSequence": self._next - 1}
        head = {key: str(value) for key, value in numbers.items()} | {"deviceModelChangeTime": self._changed}
        root = _root("MTConnectStreams", self._header(facts.now_utc, **head))
        streams, name = ET.SubElement(root, "Streams"), _clean(facts.machine)
        agent = ET.SubElement(streams, "DeviceStream", name="Agent", uuid=_agent_uuid(facts))
        device = ET.SubElement(streams, "DeviceStream", name=name, uuid=_uuid(facts))
        own = {item[0] for item in AGENT_ITEMS}
        self._observed(ET.SubElement(agent, "ComponentStream", component="Agent", name="Agent", componentId="agent"), found, own)
        others = {item[0] for item in ITEMS}
        self._observed(ET.SubElement(device, "ComponentStream", component="Device", name=name, componentId="dev"), found, others)
        return _bytes(root)

    def _observed(self, component: ET.Element, found: list[Observation], items: set[str]) -> None:
        in_order = sorted((one for one in found if one.item in items), key=lambda one: one.sequence)
        for group, category in (("Events", "EVENT"), ("Condition", "CONDITION")):
            of_it = [one for one in in_order if _item(one.item)[1] == category]
            if of_it:
                parent = ET.SubElement(component, group)
                for one in of_it:
                    _write(parent, one)

    def error(self, refused: MtconnectRefusal, now: datetime) -> bytes:
        """Return the Error document of a request that was refused."""
        root = _root("MTConnectError", self._header(now))
        ET.SubElement(ET.SubElement(root, "Errors"), "Error", errorCode=refused.code).text = _clean(refused.text)
        return _bytes(root)

    def _header(self, now: datetime, **more: str) -> dict[str, str]:
        head = {"creationTime": _stamp(now), "sender": "abbe", "instanceId": str(self._instance), "version": VERSION}
        return head | {"bufferSize": str(self._size)} | more

    @property
    def _changed(self) -> str:
        return _stamp(datetime.fromtimestamp(self._instance, UTC))


def _uuid(facts: PlantFacts) -> str:
    return f"abbe-{_clean(facts.machine)}"


def _agent_uuid(facts: PlantFacts) -> str:
    return f"abbe-agent-{_clean(facts.machine)}"


def _item(name: str) -> tuple[str, str, str, str]:
    return next(item for item in (*AGENT_ITEMS, *ITEMS) if item[0] == name)


def _write(parent: ET.Element, one: Observation) -> None:
    _, category, kind, representation = _item(one.item)
    tag = one.level if category == "CONDITION" else kind.title().replace("_", "") + ("DataSet" if representation else "")
    attributes = {"dataItemId": one.item, "timestamp": _stamp(one.utc), "sequence": str(one.sequence)}
    attributes |= {"name": _NAMES[one.item]} if one.item in _NAMES else {}
    attributes |= {"type": kind} if category == "CONDITION" else {}
    attributes |= {"nativeCode": _clean(one.native)} if one.native else {}
    if isinstance(one.value, str):
        ET.SubElement(parent, tag, attributes | ({"count": "0"} if representation else {})).text = _clean(one.value)
        return
    written = ET.SubElement(parent, tag, attributes | {"count": str(len(one.value))})
    for key, value in one.value:
        ET.SubElement(written, "Entry", key=_clean(key).replace(" ", "_")).text = _clean(value)


def _result(check: Verification, verdict: str) -> Entries:
    """Return a check's figures, each with its expanded uncertainty (k = 2) and limit. The names end with the unit."""
    head = {"number": str(check.id), "verdict": verdict, "schedule": check.schedule, "recipe": check.recipe}
    for figure in check.figures:
        three = {figure.name: figure.value, f"{figure.name}.expanded": figure.expanded, f"{figure.name}.limit": figure.limit}
        head |= {key: repr(float(value)) for key, value in three.items() if value is not None}
    return (*head.items(), ("started_utc", _stamp(check.started_utc)))


def _condition(facts: PlantFacts) -> tuple[str, str, str]:
    """Return text, level and code of the machine's condition, by the last check of the table in force, else by the state of that table."""
    if facts.verified is not None and not facts.verified.holds:
        state = facts.verified.state
        return ("", "Normal", "") if state == "verified" else (facts.verified.text, "Warning", state)
    if not facts.checks:
        return "", "Unavailable", ""
    last = facts.checks[0]
    if last.verdict == "pass":
        return "", "Normal", ""
    code = next((alarm.code for alarm in facts.alarms if alarm.at_utc == last.started_utc), last.verdict.replace(" ", "-"))
    return last.text, "Fault" if last.verdict == "fail" else "Warning", code


def _only(query: Mapping[str, str], allowed: set[str]) -> None:
    for name in query:
        if name in {"path", "interval", "heartbeat", "to"}:
            raise MtconnectRefusal("UNSUPPORTED", f"{name} is not supported here")
        if name not in allowed:
            raise MtconnectRefusal("INVALID_REQUEST", f"unknown parameter {name[:40]!r}")


def _root(kind: str, header: Mapping[str, str]) -> ET.Element:
    root = ET.Element(kind, {"xmlns": f"urn:mtconnect.org:{kind}:{VERSION}"})
    ET.SubElement(root, "Header", dict(header))
    return root


def _bytes(root: ET.Element) -> bytes:
    document: bytes = ET.tostring(root, encoding="UTF-8", xml_declaration=True)
    return document


def _stamp(time: datetime) -> str:
    return time.astimezone(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def _clean(text: str) -> str:
    """Replace control characters, which XML does not allow and device strings may contain; at most 500 characters."""
    return "".join(c if c.isprintable() else " " for c in text)[:500]
