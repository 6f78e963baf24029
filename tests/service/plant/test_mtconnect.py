"""MTConnect documents: valid by the official schemas of 1.8, numbered without gaps, and errors in their own form."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import AsyncIterator
from dataclasses import replace
from datetime import timedelta
from pathlib import Path

import httpx
import pytest
from fastapi import FastAPI
from xmlschema import XMLSchema10

from abbe.service.plant.mtconnect import AGENT_ITEMS, ITEMS, Agent
from abbe.service.web.mtconnect import add_mtconnect
from tests.service.plant.facts_for_tests import NOON, RUNNING, Source, check, facts

ALL = {item[0] for item in (*AGENT_ITEMS, *ITEMS)}
Schemas = dict[str, XMLSchema10]


@pytest.fixture(scope="module")
def schemas(shared: Path) -> Schemas:
    """The schemas of the MTConnect Institute, by root element."""
    kinds = ("MTConnectDevices", "MTConnectStreams", "MTConnectError")
    return {kind: XMLSchema10(str(shared / "data" / "foreign" / "mtconnect" / f"{kind}_1.8_1.0.xsd")) for kind in kinds}


class Asked:
    def __init__(self, source: Source, client: httpx.AsyncClient, schemas: Schemas) -> None:
        self.source, self._client, self._schemas = source, client, schemas

    async def get(self, path: str, kind: str = "MTConnectStreams", status: int = 200) -> ET.Element:
        """The document, after what every one of them has to be."""
        answer = await self._client.get(f"/mtconnect/{path}")
        assert answer.status_code == status, answer.text
        assert answer.headers["content-type"].startswith("text/xml")
        root = ET.fromstring(answer.content)
        assert root.tag == f"{{urn:mtconnect.org:{kind}:1.8}}{kind}"
        self._schemas[kind].validate(answer.text)
        assert root[0].attrib["version"] == "1.8"
        assert root[0].attrib["creationTime"].endswith("Z")
        return root

    async def refused(self, path: str, status: int) -> str:
        root = await self.get(path, "MTConnectError", status)
        (error,) = root.findall("{*}Errors/{*}Error")
        assert error.text
        return error.attrib["errorCode"]


@pytest.fixture
async def asked(schemas: Schemas) -> AsyncIterator[Asked]:
    app, source = FastAPI(), Source()
    add_mtconnect(app, source)
    async with httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url="http://127.0.0.1") as client:
        yield Asked(source, client, schemas)


def observations(root: ET.Element) -> list[ET.Element]:
    found = [one for group in ("Events", "Condition") for one in root.findall(f".//{{*}}{group}/*")]
    for one in found:
        assert {"dataItemId", "timestamp", "sequence"} <= set(one.attrib), one.attrib
    return found


def values(root: ET.Element) -> dict[str, str]:
    return {one.attrib["dataItemId"]: one.text or "" for one in observations(root)}


def entries(root: ET.Element, item: str) -> list[dict[str, str]]:
    sets = [one for one in observations(root) if one.attrib["dataItemId"] == item]
    for one in sets:
        assert one.attrib["count"] == str(len(one))
    return [{entry.attrib["key"]: entry.text or "" for entry in one} for one in sets]


async def test_probe_describes_what_the_streams_hold(asked: Asked) -> None:
    asked.source.now = facts(running=RUNNING)
    probe = await asked.get("probe", "MTConnectDevices")
    (device,) = probe.findall("{*}Devices/{*}Device")
    assert (device.attrib["name"], device.attrib["uuid"]) == ("mill-7", "abbe-mill-7")
    (agent,) = probe.findall("{*}Devices/{*}Agent")
    declared = [item.attrib["id"] for one in (agent, device) for item in one.findall("{*}DataItems/{*}DataItem")]
    current = await asked.get("current")
    assert set(declared) == set(values(current)) == ALL
    assert values(current)["added"] == device.attrib["uuid"]


async def test_current_says_what_holds(asked: Asked) -> None:
    asked.source.now = facts(running=RUNNING)
    current = await asked.get("current")
    now = values(current)
    assert (now["avail"], now["exec"], now["prog"]) == ("AVAILABLE", "ACTIVE", "quick-check")
    assert now["msg"] == "helix: revolution 3 of 10"
    (result,) = entries(current, "result")
    assert (result["number"], result["verdict"]) == ("2", "fail")
    assert (result["body_diagonal_um"], result["body_diagonal_um.expanded"], result["body_diagonal_um.limit"]) == ("11.8", "1.1", "20.0")
    assert entries(current, "table") == [{"bank": "1", "crc32": "0000beef", "push": "4"}]
    (condition,) = current.findall(".//{*}Condition/*")
    assert condition.tag.endswith("}Fault")
    assert (condition.attrib["type"], condition.attrib["nativeCode"], condition.text) == ("SYSTEM", "DRV-002", "check 2: fail")
    asked.source.now = facts(checks=(), table=None)
    current = await asked.get("current")
    assert {values(current)[item] for item in ("result", "table", "prog", "msg")} == {"UNAVAILABLE"}
    assert current.findall(".//{*}Condition/{*}Unavailable")


async def test_numbers_grow_without_gaps_and_sample_pages_through_all(asked: Asked) -> None:
    await asked.get("current")
    for n in range(3, 40):
        asked.source.now = facts(running=RUNNING if n % 2 else None, checks=(check(n), check(n - 1)), now_utc=NOON + timedelta(minutes=n))
        await asked.get("current")
    seen: list[int] = []
    following, last = 1, 1
    while following != last + 1:
        root = await asked.get(f"sample?from={following}&count=17")
        numbers = sorted(int(one.attrib["sequence"]) for one in observations(root))
        assert len(numbers) <= 17
        seen += numbers
        following, last = int(root[0].attrib["nextSequence"]), int(root[0].attrib["lastSequence"])
    assert seen == list(range(1, last + 1))
    assert last > 100
    whole = await asked.get("sample?count=4096")
    assert [one["number"] for one in entries(whole, "result")] == [str(n) for n in range(1, 40)], "every check, in order, once"
    stamps = [one.attrib["timestamp"] for one in sorted(observations(whole), key=lambda one: int(one.attrib["sequence"]))]
    assert stamps == sorted(stamps)
    nothing_new = await asked.get(f"sample?from={last + 1}")
    assert observations(nothing_new) == []
    assert nothing_new[0].attrib["nextSequence"] == str(last + 1)


async def test_current_at_an_earlier_number(asked: Asked) -> None:
    first = int((await asked.get("current"))[0].attrib["lastSequence"])
    asked.source.now = facts(running=RUNNING)
    assert values(await asked.get("current"))["exec"] == "ACTIVE"
    assert values(await asked.get(f"current?at={first}"))["exec"] == "READY"


@pytest.mark.parametrize(
    ("path", "status", "code"),
    [
        ("sample?from=0", 404, "OUT_OF_RANGE"),
        ("sample?from=999999", 404, "OUT_OF_RANGE"),
        ("sample?count=0", 404, "OUT_OF_RANGE"),
        ("sample?count=-5", 404, "OUT_OF_RANGE"),
        ("sample?count=4097", 404, "OUT_OF_RANGE"),
        ("current?at=999999", 404, "OUT_OF_RANGE"),
        ("sample?from=abc", 400, "INVALID_REQUEST"),
        ("sample?count=1e3", 400, "INVALID_REQUEST"),
        ("sample?from=%00%01", 400, "INVALID_REQUEST"),
        ("current?from=1", 400, "INVALID_REQUEST"),
        ("sample?path=//DataItem", 400, "UNSUPPORTED"),
        ("sample?interval=1000", 400, "UNSUPPORTED"),
    ],
)
async def test_bad_questions_are_answered_in_its_own_form(asked: Asked, path: str, status: int, code: str) -> None:
    assert await asked.refused(path, status) == code


async def test_device_strings_cannot_break_a_document(asked: Asked) -> None:
    nasty = replace(RUNNING, stage="<x>&\x00\x1b\ud800", message="]]><!--")
    asked.source.now = facts(running=nasty, machine="mill\x07<7>", checks=(replace(check(1), verdict="fail", text="\x00</Fault>"),))
    current = await asked.get("current")
    assert values(current)["msg"] == "<x>&   : ]]><!--"
    assert values(current)["system"] == " </Fault>"
    await asked.get("probe", "MTConnectDevices")


def test_a_full_buffer_forgets_the_oldest_and_still_knows_what_held() -> None:
    agent = Agent(1, buffer=10)
    for n in range(40):
        agent.update(facts(running=RUNNING if n % 2 else None))
    first = ET.fromstring(agent.sample(facts(), {}))
    head = first[0].attrib
    assert int(head["lastSequence"]) - int(head["firstSequence"]) == 9
    held = values(ET.fromstring(agent.current(facts(), {"at": head["firstSequence"]})))
    assert set(held) == ALL, "also what never changed since long before"
    with pytest.raises(Exception, match="expected"):
        agent.sample(facts(), {"from": "1"})
