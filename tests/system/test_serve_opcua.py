"""The service as a process with its OPC UA server, asked by a real client while checks run."""

from __future__ import annotations

import asyncio
from contextlib import closing
from pathlib import Path

import httpx
import pytest

from tests.patience import within

pytest.importorskip("asyncua", reason="the extra [opcua] is not installed")

from asyncua import Client, Node

from tests.system.serve_bench import free_port, service


class Numbers:
    """What the server tells of the last result."""

    def __init__(self) -> None:
        self.told: asyncio.Queue[int] = asyncio.Queue()

    def datachange_notification(self, node: Node, number: int, data: object) -> None:
        self.told.put_nowait(number)


async def test_results_arrive_and_the_service_stops_in_time(tmp_path: Path) -> None:
    port, page = free_port(), free_port()
    fast = service(tmp_path, schedules=[["fast", "* * * * * *", "quick"]], port=page, opcua=port)
    with closing(fast) as running:
        await asyncio.to_thread(running.expect, "opc ua served")
        numbers = Numbers()
        async with Client(f"opc.tcp://127.0.0.1:{port}/abbe/", timeout=20, watchdog_intervall=30) as client:
            subscription = await client.create_subscription(100, numbers)
            await subscription.subscribe_data_change(client.get_node("ns=2;s=mill-7/LastResult/Number"))
            seen: list[int] = []
            async with asyncio.timeout(within(60)):
                while len(set(seen)) < 2:
                    number = await numbers.told.get()
                    seen += [number] if number is not None else []
            assert seen == sorted(seen)
            assert await client.get_node("ns=2;s=mill-7/LastResult/Figures/body_diagonal_um").read_value() == 11.8
            async with httpx.AsyncClient() as web:
                answer = await web.get(f"http://127.0.0.1:{page}/mtconnect/current")
            assert answer.status_code == 200
            assert b'key="body_diagonal_um">11.8<' in answer.content
            assert b'type="SYSTEM"' in answer.content
            # With the client still there.
            code, took_s = await asyncio.to_thread(running.terminate)
        assert (code, took_s < 5.0) == (0, True)
        assert not any("Traceback" in line for line in running.lines)
