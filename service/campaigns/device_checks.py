"""The devices that a campaign needs, and their checks before anything moves: configured, answering, with the needed rate and range.

The laser check takes a reading and ignores the beam, which is aligned and zeroed only when the laser is mounted during the campaign.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Awaitable, Callable, Collection
from dataclasses import dataclass, field
from typing import Any

from abbe.drivers.api import LaserReading
from abbe.drivers.errors import DriverError, ReplyTimeout, WrongDevice
from abbe.drivers.fixture.driver import ConsoleFixture
from abbe.service.devices.session import Session, raise_all
from abbe.service.errors import AbbeError, ConfigError
from abbe.service.sequences.probing import need_probe
from abbe.service.sequences.resume_plan import BY_HAND
from abbe.service.sequences.steps import (
    CampaignPlan,
    ChangeBar,
    MountBar,
    MountLaser,
    ReadBar,
    ReadLaser,
    RecordPath,
    TouchFeature,
    ZeroLaser,
)

BEFORE_S = 5.0
"""Longest search for the ball-bar's box before a run."""
BAR_RANGE_MM = 0.1
"""Minimum stroke of the bar to either side: machine errors are tens of micrometres, and a reading at the end of the stroke says nothing."""
LASER_S = 2.0
"""Longest wait for a new sample of the laser, which delivers twenty per second."""
POLL_S = 0.02
AIR_C, AIR_PA = (-20.0, 60.0), (50_000.0, 120_000.0)
"""Plausible readings of the laser's sensors in a workshop. Outside them a sensor is broken, and every length is wrong."""
CNC, BALLBAR, LASER, FIXTURE = "cnc", "ballbar", "laser", "fixture"
ROLE_NAMES = {CNC: "a controller", BALLBAR: "a ball-bar", LASER: "a laser", FIXTURE: "a fixture"}
USED_BY: dict[str, Any] = {
    BALLBAR: MountBar | ChangeBar | RecordPath | ReadBar,
    LASER: MountLaser | ZeroLaser | ReadLaser,
    FIXTURE: BY_HAND,
}


@dataclass(frozen=True, slots=True)
class Needed:
    """Devices of a campaign. ``first``: role -> its first use; ``rate_hz``: fastest stream of the ball-bar, 0: none."""

    first: dict[str, str] = field(default_factory=dict)
    rate_hz: int = 0


def needed_by(plan: CampaignPlan, *, air: bool = False) -> Needed:
    """Return the devices that the steps of a campaign use. ``air``: its temperature is watched, which needs the laser's sensor."""
    first = {CNC: "all motion"}
    for role, kinds in USED_BY.items():
        test = next((t for t in plan.tests if any(isinstance(s, kinds) for s in t.steps)), None)
        if test is not None:
            first[role] = f"test {test.label}"
    if air:
        first.setdefault(LASER, "run_temperature_c")
    rates = [step.rate_hz for test in plan.tests for step in test.steps if isinstance(step, RecordPath | ReadBar)]
    return Needed(first, max(rates, default=0))


def check_configured(needed: Needed, there: Collection[str]) -> None:
    """Raise ConfigError if needed roles are not in ``there``, the roles that the machine file names. Connects to nothing."""
    missing = [role for role in needed.first if role not in there]
    if missing:
        listed = " and ".join(f"{ROLE_NAMES[role]} for {needed.first[role]}" for role in missing)
        keys = ", ".join(f"{role} = ..." for role in missing)
        raise ConfigError(f"this needs {listed}, and the machine file names none", f"add {keys} under [devices]")


async def check_devices(session: Session, plan: CampaignPlan, *, air: bool = False) -> None:
    """Check that every device of a campaign is configured, answers, and has the needed rate and range.

    Raises
    ------
    ConfigError, DriverError
        One device is not ready.
    DevicesNotReady
        Several are not ready; all are named in one line.
    """
    needed = needed_by(plan, air=air)
    there = [role for role in needed.first if role != CNC and getattr(session, role) is not None]
    troubles: list[AbbeError | DriverError] = []
    try:
        check_configured(needed, [CNC, *there])
        if any(isinstance(s, TouchFeature) for t in plan.tests for s in t.steps):
            need_probe(session.controller)
    except ConfigError as error:
        troubles.append(error)
    ask: dict[str, Callable[[Session, Needed], Awaitable[None]]] = {BALLBAR: _ballbar, LASER: _laser, FIXTURE: _fixture}
    for role in there:
        try:
            await ask[role](session, needed)
        except (AbbeError, DriverError) as error:
            troubles.append(error)
    raise_all(troubles)


async def _ballbar(session: Session, needed: Needed) -> None:
    bar = session.need_ballbar()
    await bar.make_ready(within_s=BEFORE_S)
    await bar.check(needed.rate_hz, range_mm=BAR_RANGE_MM)


async def _laser(session: Session, needed: Needed) -> None:
    laser = session.need_laser()
    first = await laser.peek()
    clock = asyncio.get_running_loop().time
    until_s = clock() + LASER_S
    name = getattr(laser, "name", LASER)
    while (reading := await laser.peek()).sample_count == first.sample_count:
        if clock() > until_s:
            raise ReplyTimeout(name, "read", f"no new sample within {LASER_S:g} s", "start the meter's measurement")
        await asyncio.sleep(POLL_S)
    check_sensors(name, reading)


def check_sensors(name: str, reading: LaserReading) -> None:
    """Raise WrongDevice if an air sensor of the laser, which corrects its lengths, reads an implausible value."""
    for what, value, (low, high), unit in (
        ("air temperature", reading.air_temp_c, AIR_C, "C"),
        ("air pressure", reading.air_pressure_pa, AIR_PA, "Pa"),
    ):
        if not (low <= value <= high or math.isnan(value)):
            detail = f"its {what} reads {value:g} {unit}, which no workshop has"
            raise WrongDevice(name, "read", detail, "connect the sensor, and check that the address is the laser's")


async def _fixture(session: Session, needed: Needed) -> None:
    fixture = session.need_fixture()
    if isinstance(fixture, ConsoleFixture) and not session.attended:
        raise ConfigError(
            "a person at the console has to mount bar and mirror, but nobody is at the console",
            "start the command from a terminal, or configure a remote fixture; nothing has moved",
        )
    await fixture.identify()
