"""What a machine file can say, with bounds on every number and the unit in every key. ``service.config`` reads it."""

from __future__ import annotations

from collections import Counter
from datetime import UTC, datetime
from typing import Annotated, Self
from zoneinfo import ZoneInfo

from cronsim import CronSim, CronSimError
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, field_validator, model_validator

from drivers.errors import DriverError
from drivers.links import urls
from service.errors import AbbeError
from service.mqtt.broker import parse as parse_broker
from service.runs.machine_object import Chain, Interval, Point
from service.storage.engine import parse_url as parse_database

Positive = Annotated[float, Field(gt=0.0)]


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True)


class AxisIntervals(_Section):
    """One interval of commanded coordinates for each axis, mm."""

    X: Interval
    Y: Interval
    Z: Interval


class AxisPoints(_Section):
    """One point for each carriage, mm."""

    X: Point = (0.0, 0.0, 0.0)
    Y: Point = (0.0, 0.0, 0.0)
    Z: Point = (0.0, 0.0, 0.0)


class Devices(_Section):
    """Where the devices are; an absent one is not connected."""

    ballbar: str | None = Field(default=None, description="serial:///dev/ttyUSB0?baud=460800 or socket://host:port")
    laser: str | None = Field(default=None, description="modbus+tcp://host:port or modbus+rtu:///dev/ttyS0?baud=115200")
    cnc: str | None = Field(default=None, description="modbus+tcp://host:port")
    fixture: str | None = Field(default=None, description="fixture+console: or fixture+tcp://host:port")

    @model_validator(mode="after")
    def _urls(self) -> Self:
        for kind, allowed in _SCHEMES.items():
            text = getattr(self, kind)
            if text is not None:
                _check_device(kind, text, allowed)
        return self


_SCHEMES: dict[str, tuple[type[object], ...]] = {
    "ballbar": (urls.SerialUrl, urls.SocketUrl),
    "laser": (urls.ModbusTcpUrl, urls.ModbusRtuUrl),
    "cnc": (urls.ModbusTcpUrl, urls.ModbusRtuUrl),
    "fixture": (urls.FixtureTcpUrl, urls.FixtureConsoleUrl),
}


def _check_device(kind: str, text: str, allowed: tuple[type[object], ...]) -> None:
    try:
        parsed = urls.parse_url(text)
    except DriverError as err:
        raise ValueError(f"{kind} = {text!r}: {err.detail}" + (f" ({err.remedy})" if err.remedy else "")) from None
    if not isinstance(parsed, allowed):
        hint = Devices.model_fields[kind].description
        raise ValueError(f"{kind} = {text!r} is not an address of this kind of device, expected {hint}")


def _database(text: str) -> str:
    try:
        parse_database(text)
    except AbbeError as err:
        raise ValueError(str(err)) from None
    return text


class StoreSection(_Section):
    """Where results are kept."""

    url: Annotated[str, AfterValidator(_database)] = Field(
        default="sqlite:///abbe.sqlite3", description="SQLite file (relative to the machine file's folder) or postgresql://user@host/name"
    )


class Limits(_Section):
    """What must never be exceeded. A table beyond a limit is refused, not clamped."""

    table_value_um: Annotated[float, Field(gt=0.0, le=3276.7)] = Field(default=200.0, description="largest correction at any grid point")
    table_change_um: Annotated[float, Field(gt=0.0, le=6553.4)] = Field(
        default=200.0,
        description="largest change of a correction against the active table; 50 is enough once a machine is corrected, but the first push "
        "on a raw machine replaces nothing by everything",
    )
    table_step_um: Annotated[float, Field(gt=0.0, le=3276.7)] = Field(
        default=20.0, description="largest change between neighbouring grid points"
    )
    feed_mm_min: Annotated[float, Field(gt=0.0, le=100_000.0)] = Field(default=6000.0, description="fastest feed of any measurement")
    temperature_c: Interval = Field(default=(18.0, 24.0), description="air temperature in which a measurement is allowed")


class Verify(_Section):
    """Limits of the scheduled check: above one of them the machine does not pass."""

    body_diagonal_um: Positive = Field(default=20.0, description="range of the deviation along the worst body diagonal")
    helix_rms_um: Positive = Field(default=5.0, description="rms of the ball-bar residual on the check helix")


def _broker(text: str | None) -> str | None:
    try:
        if text is not None:
            parse_broker(text)
    except AbbeError as err:
        raise ValueError(str(err)) from None
    return text


class Mqtt(_Section):
    """Where results are published."""

    url: Annotated[str | None, AfterValidator(_broker)] = Field(
        default=None, description="mqtt://[user:password@]host:1883; absent: nothing is published"
    )
    topic_prefix: str = Field(default="abbe", pattern=r"^[^+#\s/][^+#\s]*$", description="first part of every topic")


class Web(_Section):
    """Where the web page is served."""

    host: str = Field(
        default="127.0.0.1", min_length=1, description="only this computer (127.0.0.1, ::1 or localhost): the page has no users yet"
    )
    port: int = Field(default=8080, ge=0, le=65535, description="0: any free port")


class ScheduleEntry(_Section):
    """One line of the timetable."""

    name: str = Field(min_length=1, max_length=200)
    cron: str = Field(description="minute hour day month weekday, e.g. 0 6 * * 1")
    timezone: str = Field(default="UTC", description="IANA name, e.g. Europe/Berlin")
    recipe: str = Field(default="quick-check", min_length=1, description="what to measure")
    grace_s: float = Field(default=300.0, ge=0.0, le=86_400.0, description="a slot found later than this is recorded as missed and not run")

    @field_validator("cron")
    @classmethod
    def _cron(cls, text: str) -> str:
        try:
            CronSim(text, datetime(2026, 1, 1, tzinfo=UTC))
        except CronSimError as err:
            raise ValueError(f"expected a cron expression (minute hour day month weekday), got {text!r}: {err}") from None
        return text

    @field_validator("timezone")
    @classmethod
    def _timezone(cls, text: str) -> str:
        try:
            ZoneInfo(text)
        except (KeyError, ValueError, OSError):
            raise ValueError(f"expected an IANA time zone such as Europe/Berlin or UTC, got {text!r}") from None
        return text


class MachineFile(_Section):
    """One machine: its geometry, its devices, where results go, and the limits that protect it."""

    name: str = Field(min_length=1, max_length=200)
    chain: Chain = Field(description="carriages from workpiece w over bed b to tool t, e.g. w-X-Y-b-Z-t")
    vertical_axis: str = Field(default="Z", pattern="^[XYZ]$")
    stroke_mm: AxisIntervals
    pivots_mm: AxisPoints = AxisPoints()
    tool_mm: Point = Field(default=(0.0, 0.0, 0.0), description="from the spindle reference point to the functional point")
    devices: Devices = Devices()
    store: StoreSection = StoreSection()
    limits: Limits = Limits()
    verify: Verify = Verify()
    mqtt: Mqtt = Mqtt()
    web: Web = Web()
    schedule: list[ScheduleEntry] = Field(default_factory=list)

    @field_validator("schedule")
    @classmethod
    def _names_differ(cls, entries: list[ScheduleEntry]) -> list[ScheduleEntry]:
        twice = [name for name, count in Counter(entry.name for entry in entries).items() if count > 1]
        if twice:
            raise ValueError(f"two schedules are named {twice[0]!r}, expected different names")
        return entries

    def machine_doc(self) -> dict[str, object]:
        """Write the ``machine`` object of the exchange format."""
        keys = {"name", "chain", "vertical_axis", "stroke_mm", "pivots_mm", "tool_mm"}
        return self.model_dump(mode="json", include=keys)
