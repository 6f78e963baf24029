"""The service with a check that needs no devices: ``python serve_check.py CONFIG.json``. Run as a process by the tests beside it."""

from __future__ import annotations

import asyncio
import json
import sys
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import aiomqtt

from abbe.service.config_schema import OpcUa, Web
from abbe.service.core.setup import ServiceSetup
from abbe.service.domain.progress import Progress, ProgressSink
from abbe.service.domain.schedule import Schedule
from abbe.service.logs import configure_logs
from abbe.service.mqtt.broker import Topics, parse
from abbe.service.sequences.control import Control, State
from abbe.service.serve import serve


@dataclass(frozen=True)
class Result:
    verdict: str = "pass"
    values: Mapping[str, float] = field(default_factory=lambda: {"body_diagonal_um": 11.8, "helix_rms_um": 1.4})
    uncertainties: Mapping[str, float] = field(default_factory=lambda: {"body_diagonal_um": 1.1, "helix_rms_um": 0.2})
    limits: Mapping[str, float] = field(default_factory=lambda: {"body_diagonal_um": 20.0, "helix_rms_um": 5.0})
    run_labels: tuple[str, ...] = ("helix-1",)
    campaign: str = "check-1"
    started_utc: datetime = field(default_factory=lambda: datetime.now(UTC))
    duration_s: float = 0.2
    text: str = "Every figure lies inside its limit."
    comparable: bool = True


async def check(recipe: str, progress: ProgressSink, control: Control) -> Result:
    """What the recipe says: ``quick`` takes a moment, ``defect`` is a fault of this program, ``endless`` runs until it is stopped."""
    progress(Progress("helix", 1, 2, 0.1, "revolution 1 of 2"))
    if recipe == "defect":
        raise KeyError("a defect")
    if recipe == "endless":
        control.now(State.RUNNING)
        try:
            await control.unless_stopped(asyncio.Event().wait())
        finally:
            sys.stdout.write("held\n")
            sys.stdout.flush()
    return Result()


def lose_cancellations() -> None:
    """What ``asyncio.wait_for`` of Python 3.11 does when acknowledgement and cancellation come together, every time instead of rarely."""
    publish, held = aiomqtt.Client.publish, list[bool]()

    async def acknowledged_late(client: aiomqtt.Client, *args: Any, **more: Any) -> None:
        await publish(client, *args, **more)
        if not held:
            held.append(True)
            with suppress(asyncio.CancelledError):
                await asyncio.Event().wait()

    aiomqtt.Client.publish = acknowledged_late  # type: ignore[method-assign]


def main() -> int:
    given = json.loads(Path(sys.argv[1]).read_text())
    configure_logs()
    if given.get("lose_cancellations"):
        lose_cancellations()
    schedules = tuple(Schedule(name, cron, "UTC", recipe) for name, cron, recipe in given["schedules"])
    broker = parse(given["mqtt"]) if given.get("mqtt") else None
    topics = Topics("plant/abbe", "mill-7")
    return serve(
        ServiceSetup(
            "mill-7",
            {"name": "mill-7"},
            {"laser": "modbus+tcp://127.0.0.1:5021"},
            schedules,
            given["store"],
            broker,
            topics,
            Web(port=given["port"]),
            lambda _: check,
            opcua=OpcUa(port=given["opcua"]) if "opcua" in given else None,
        )
    )


if __name__ == "__main__":
    sys.exit(main())
