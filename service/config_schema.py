"""Schema of the machine file, with bounds on every number and the unit in every key. ``abbe.service.config`` reads it."""

from __future__ import annotations

import ipaddress
from collections import Counter
from datetime import date
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, Field, field_validator, model_validator

from abbe.drivers.errors import DriverError
from abbe.drivers.links.urls import is_url_of
from abbe.service.domain.machine import AxisMaterial, Chain, ConfigTable, Interval, Issuer, Item, Point
from abbe.service.domain.machine_file import CaptureSettings, Loosens
from abbe.service.domain.schedule import Schedule, Window, complete, one_way
from abbe.service.errors import AbbeError
from abbe.service.mqtt.broker import parse as parse_broker
from abbe.service.push.validate import PushLimits

Positive = Annotated[float, Field(gt=0.0)]

MIB = 1 << 20
SHORTEST_MM, LONGEST_MM = 50.0, 50_000.0
"""Range of real machines' strokes. A stroke up to 1.27 m, given in inches, falls below the shortest."""
COLDEST_C, WARMEST_C = -20.0, 50.0
"""Plausible air temperatures; a window such as 68 to 72 is in Fahrenheit."""
CERTIFICATES = (date(2000, 1, 1), date(2199, 12, 31))
"""Earliest and latest plausible last day of a certificate; certificates of the demonstration end in 2099."""


def _celsius(window: tuple[float, float]) -> tuple[float, float]:
    low, high = window
    if low < COLDEST_C or high > WARMEST_C:
        hint = "; is this Fahrenheit?" if low > WARMEST_C else ""
        raise ValueError(f"expected degrees C from {COLDEST_C:g} to {WARMEST_C:g}, got [{low:g}, {high:g}]{hint}")
    return window


def _certificate(day: date | None) -> date | None:
    first, last = CERTIFICATES
    if day is not None and not first <= day <= last:
        raise ValueError(f"expected the last day of a certificate, a date between {first} and {last}, got {day}")
    return day


Coefficient = Annotated[float, Field(ge=-1e-5, le=1e-4)]
"""Bounds of an expansion coefficient, 1/K: negative for some glass ceramics and fibres; a value in µm/m/K exceeds the upper bound."""
CoefficientUncertainty = Annotated[float, Field(gt=0.0, le=1e-5)]
Temperatures = Annotated[Interval, AfterValidator(_celsius)]
ROOM_K = 1.0
"""Largest stated range of a room's temperature, K; the same as `abbe.service.verification.verify.SAME_AIR_C`."""
MachineWindow = Annotated[Window, AfterValidator(complete)]
EXCLUSIVE_KEYS = {
    "schedule": (("cron",), ("every_h", "first")),
    "maintenance": (("cron", "hours"), ("days", "start", "end")),
    "staffed": (("cron", "hours"), ("days", "start", "end")),
}
"""Keys of the two ways to write an entry of a list; an entry uses one of them."""
Certificate = Annotated[date | None, AfterValidator(_certificate)]


class AxisIntervals(ConfigTable):
    """One interval of commanded coordinates for each axis, mm, e.g. ``{X = [0, 600], Y = [0, 500], Z = [0, 450]}``."""

    X: Interval
    Y: Interval
    Z: Interval


class AxisPoints(ConfigTable):
    """One point for each carriage, mm."""

    X: Point = (0.0, 0.0, 0.0)
    Y: Point = (0.0, 0.0, 0.0)
    Z: Point = (0.0, 0.0, 0.0)


class Devices(ConfigTable):
    """Addresses of the devices; an absent one is not connected."""

    ballbar: str | None = Field(default=None, description="serial:///dev/ttyUSB0?baud=460800 or socket://host:port")
    laser: str | None = Field(default=None, description="modbus+tcp://host:port or modbus+rtu:///dev/ttyS0?baud=115200")
    cnc: str | None = Field(default=None, description="modbus+tcp://host:port")
    fixture: str | None = Field(default=None, description="fixture+console: or fixture+tcp://host:port")

    @model_validator(mode="after")
    def _urls(self) -> Self:
        for kind in type(self).model_fields:
            text = getattr(self, kind)
            if text is not None:
                _check_device(kind, text)
        return self


def _check_device(kind: str, text: str) -> None:
    try:
        right = is_url_of(kind, text)
    except DriverError as err:
        raise ValueError(f"{kind} = {text!r}: {err.detail}" + (f" ({err.remedy})" if err.remedy else "")) from None
    if not right:
        hint = Devices.model_fields[kind].description
        raise ValueError(f"{kind} = {text!r} is not an address of this kind of device, expected {hint}")


def _database(text: str) -> str:
    from abbe.service.storage.engine import parse_url as parse_database  # of sqlalchemy, which no other key needs

    try:
        parse_database(text)
    except AbbeError as err:
        raise ValueError(str(err)) from None
    return text


class StoreSection(ConfigTable):
    """Where results are stored."""

    url: Annotated[str, AfterValidator(_database)] = Field(
        default="sqlite:///abbe.sqlite3", description="SQLite file (relative to the machine file's folder) or postgresql://user@host/name"
    )
    capture: str = Field(
        default="",
        description="local folder in which samples are saved before they reach the database; empty: beside the SQLite file; PostgreSQL "
        "needs one",
    )
    capture_reserve_mib: Annotated[float, Field(ge=0.0625, le=1024.0)] = Field(
        default=16.0, description="disk space reserved so that a run can be closed when the disk is full"
    )
    keep_segments: bool = Field(default=False, description="keep the capture files after their samples are in the database")

    def for_capture(self) -> CaptureSettings:
        """Return the settings of the capture."""
        return CaptureSettings(self.capture, int(self.capture_reserve_mib * MIB), self.keep_segments)


class Limits(ConfigTable):
    """Limits that must never be exceeded. A table beyond a limit is refused, not clamped."""

    table_value_um: Annotated[float, Field(gt=0.0, le=3276.7), Loosens("more")] = Field(
        default=100.0, description="largest correction at any grid point"
    )
    table_change_um: Annotated[float, Field(gt=0.0, le=6553.4), Loosens("more")] = Field(
        default=50.0,
        description="largest change of a correction against the active table; the first push on an uncorrected "
        "machine may need more: look at the proposal first",
    )
    table_step_um: Annotated[float, Field(gt=0.0, le=3276.7), Loosens("more")] = Field(
        default=20.0, description="largest change between neighbouring grid points"
    )
    table_beyond_percent: Annotated[float, Field(ge=0.0, le=100.0), Loosens("more")] = Field(
        default=25.0, description="largest part of a stroke that a table corrects beyond the measured positions, at either end"
    )
    table_walk_um: Annotated[float, Field(gt=0.0, le=6553.4), Loosens("more")] = Field(
        default=50.0, description="largest change of a correction over 30 days by unattended pushes ([alarm] push)"
    )
    measurement_age_h: Annotated[float, Field(gt=0.0, le=8760.0), Loosens("more")] = Field(
        default=72.0, description="a table is only written from runs of at most this age"
    )
    two_people: Annotated[bool, Loosens("less")] = Field(
        default=False,
        description="a proposed table is only pushed after a person other than its proposer has approved it (`abbe comp approve`)",
    )
    feed_mm_min: Annotated[float, Field(gt=0.0, le=100_000.0), Loosens("more")] = Field(
        default=6000.0, description="fastest feed of any measurement"
    )
    temperature_c: Annotated[Temperatures, Loosens("wider")] = Field(
        default=(18.0, 24.0), description="permitted air temperature of a measurement"
    )
    run_temperature_c: Annotated[Temperatures | None, Loosens("wider")] = Field(
        default=None, description="air temperature, read from the laser, outside which a running measurement stops; absent: not watched"
    )
    continue_after: Annotated[list[Literal["door", "beam", "temperature", "ballbar"]], Loosens("added")] = Field(
        default_factory=list,
        description="conditions that only suspend a measurement, which resumes by itself when they have cleared; e-stop and alarm always "
        "end it. Condition ballbar: the box of the ball-bar lost its connection or restarted; it clears when the box answers again",
    )
    suspend_s: Annotated[float, Field(gt=0.0, le=86_400.0), Loosens("more")] = Field(
        default=1800.0, description="longest suspension; after it the run ends"
    )
    settle_s: Annotated[float, Field(ge=0.0, le=3600.0), Loosens("less")] = Field(
        default=10.0, description="how long all conditions must be clear before the measurement resumes"
    )

    def for_push(self) -> PushLimits:
        """The limits for tables, in mm."""
        return PushLimits(
            value_mm=self.table_value_um * 1e-3,
            beyond=self.table_beyond_percent * 1e-2,
            change_mm=self.table_change_um * 1e-3,
            step_mm=self.table_step_um * 1e-3,
            walk_mm=self.table_walk_um * 1e-3,
            temperature_c=self.temperature_c,
            age_h=self.measurement_age_h,
        )


class AxisCoefficients(ConfigTable):
    """One expansion coefficient for each axis, 1/K. An axis without one is not reduced to 20 °C."""

    X: Coefficient | None = None
    Y: Coefficient | None = None
    Z: Coefficient | None = None


class AxisUncertainties(ConfigTable):
    """One standard uncertainty of a coefficient for each axis, 1/K."""

    X: CoefficientUncertainty | None = None
    Y: CoefficientUncertainty | None = None
    Z: CoefficientUncertainty | None = None


class Material(ConfigTable):
    """Thermal expansion, to reduce figures of ISO 230-2 and 230-6 to 20 °C. Without a coefficient and a temperature nothing is reduced."""

    scale_per_k: AxisCoefficients = Field(
        default=AxisCoefficients(),
        description="expansion coefficient of each axis' scale (without a scale: of its screw), 1/K, e.g. {X = 11.5e-6}",
    )
    u_scale_per_k: AxisUncertainties = Field(
        default=AxisUncertainties(),
        description="standard uncertainty of scale_per_k, 1/K, for each axis with a coefficient, e.g. {X = 0.6e-6}",
    )
    temperature_c: Annotated[float, Field(ge=COLDEST_C, le=WARMEST_C)] | None = Field(
        default=None, description="temperature of the scales, for runs that did not record it for their axis (temp_x_C, temp_y_C, temp_z_C)"
    )
    u_temperature_k: Annotated[float, Field(ge=0.0, le=10.0)] = Field(
        default=0.2, description="standard uncertainty of the scales' temperature, recorded or stated"
    )
    laser_per_k: Coefficient = Field(
        default=0.0,
        description="expansion coefficient set in the laser's own compensation of material, 1/K; its sensor is taken to be as warm as the "
        "scales; 0: the compensation is off, the laser reads true length",
    )
    workpiece_per_k: Coefficient | None = Field(
        default=None,
        description="expansion coefficient of the workpieces, 1/K: reports then also show the deviations at 20 °C of a part that was made "
        "at the temperature of the scales",
    )
    u_workpiece_per_k: CoefficientUncertainty | None = Field(default=None, description="standard uncertainty of workpiece_per_k, 1/K")

    @model_validator(mode="after")
    def _known(self) -> Self:
        for axis in "XYZ":
            if (getattr(self.scale_per_k, axis) is None) != (getattr(self.u_scale_per_k, axis) is None):
                raise ValueError(f"scale_per_k.{axis} and u_scale_per_k.{axis} belong together, expected both or neither")
        if (self.workpiece_per_k is None) != (self.u_workpiece_per_k is None):
            raise ValueError("workpiece_per_k and u_workpiece_per_k belong together, expected both or neither")
        return self

    def by_axis(self) -> dict[str, AxisMaterial]:
        """The section as reports use it, for each axis."""
        return {
            axis: AxisMaterial(
                getattr(self.scale_per_k, axis),
                getattr(self.u_scale_per_k, axis),
                self.temperature_c,
                self.u_temperature_k,
                self.laser_per_k,
                self.workpiece_per_k,
                self.u_workpiece_per_k,
            )
            for axis in "XYZ"
        }


class Calibration(ConfigTable):
    """Last days of the instruments' certificates. No table is written from an instrument without a valid certificate."""

    ballbar: Annotated[Certificate, Loosens("later")] = Field(
        default=None, description="last day of the ball-bar's certificate, e.g. 2027-05-31"
    )
    ballbar_is: str = Field(
        default="", max_length=400, description="maker, model and serial of the ball-bar; number and laboratory of its certificate"
    )
    laser: Annotated[Certificate, Loosens("later")] = Field(default=None, description="last day of the laser's certificate")
    laser_is: str = Field(default="", max_length=400, description="the same facts for the laser")
    artefact: Annotated[Certificate, Loosens("later")] = Field(
        default=None,
        description="last day of the certificate of the artefact's length; without a calibrated length: of the touch probe's test (ISO "
        "230-10)",
    )
    artefact_is: str = Field(default="", max_length=400, description="the same facts for the artefact")
    room: Annotated[Certificate, Loosens("later")] = Field(
        default=None, description="last day for which somebody confirmed room_temperature_c"
    )
    room_temperature_c: Annotated[Temperatures | None, Loosens("stated")] = Field(
        default=None,
        description="lowest and highest air temperature by the room's own thermometer, at most 1 K apart; only for a machine without a "
        "laser, whose sensor would read the air",
    )

    @model_validator(mode="after")
    def _room(self) -> Self:
        if (self.room is None) != (self.room_temperature_c is None):
            raise ValueError("room and room_temperature_c belong together, expected both or neither")
        if self.room_temperature_c is not None and self.room_temperature_c[1] - self.room_temperature_c[0] > ROOM_K + 1e-9:
            low, high = self.room_temperature_c
            raise ValueError(
                f"room_temperature_c is {low:g} to {high:g}, expected at most {ROOM_K:g} K from lowest to highest, as verifications need"
            )
        return self

    def until(self) -> dict[str, date]:
        """Stated last days of the certificates by instrument (`abbe.service.domain.run.Run.instrument`), and of the room's temperature."""
        days = {"ballbar": self.ballbar, "laser": self.laser, "artefact": self.artefact, "room": self.room}
        return {kind: day for kind, day in days.items() if day is not None}

    def identities(self) -> dict[str, str]:
        """The stated facts about each instrument and its certificate."""
        known = {"ballbar": self.ballbar_is, "laser": self.laser_is, "artefact": self.artefact_is}
        return {kind: text for kind, text in known.items() if text}


class Nc(ConfigTable):
    """The controller that NC programs are written for (`abbe measure --nc`)."""

    acceleration_mm_s2: Annotated[float, Field(gt=0.0, le=100_000.0)] = Field(
        default=500.0, description="acceleration along the path; used only to estimate how long a program runs"
    )
    heidenhain_tool: Annotated[int, Field(ge=1, le=32_767)] | None = Field(
        default=None, description="row of the tool table for the tool in the spindle (length 0, radius 0); absent: the operator enters it"
    )
    memory_kib: dict[Literal["siemens", "fanuc", "heidenhain", "linuxcnc", "iso"], Positive] = Field(
        default_factory=dict, description="program memory by dialect; absent: 256 for fanuc and iso, no limit for the others"
    )


class Verify(ConfigTable):
    """Limits of the scheduled check: a machine above any of them fails."""

    body_diagonal_um: Annotated[Positive, Loosens("more")] = Field(
        default=20.0, description="range of the deviation along the worst body diagonal"
    )
    helix_rms_um: Annotated[Positive, Loosens("more")] = Field(default=5.0, description="rms of the ball-bar residual on the check helix")
    reversal_um: Annotated[Positive | None, Loosens("higher")] = Field(
        default=None, description="largest mean reversal value of a body diagonal; absent: it is measured, but not judged"
    )

    def limits_um(self) -> dict[str, float]:
        """Return the limits by the names of the figures, without those that are not judged."""
        limits = {"body_diagonal_um": self.body_diagonal_um, "helix_rms_um": self.helix_rms_um, "reversal_um": self.reversal_um}
        return {key: limit for key, limit in limits.items() if limit is not None}


def _broker(text: str | None) -> str | None:
    try:
        if text is not None:
            parse_broker(text)
    except AbbeError as err:
        raise ValueError(str(err)) from None
    return text


class Mqtt(ConfigTable):
    """Where results are published."""

    url: Annotated[str | None, AfterValidator(_broker)] = Field(
        default=None, description="mqtt://[user:password@]host:1883; absent: nothing is published"
    )
    topic_prefix: str = Field(default="abbe", pattern=r"^[^+#\s/][^+#\s]*$", description="first part of every topic")
    ca: str = Field(
        default="",
        description="authority that signed the broker's certificate, PEM file (relative to the machine file's folder); empty: the "
        "authorities that this computer trusts",
    )
    certificate: str = Field(default="", description="client certificate of Abbe, PEM file, if the broker asks for one")
    key: str = Field(default="", description="private key of this certificate, PEM file")

    @model_validator(mode="after")
    def _encrypted(self) -> Self:
        if bool(self.certificate) != bool(self.key):
            raise ValueError("certificate and key belong together, expected both or neither")
        if (self.ca or self.certificate) and not (self.url or "").startswith("mqtts:"):
            raise ValueError("ca and certificate are for an encrypted connection, expected url = mqtts://host:8883")
        return self


class Web(ConfigTable):
    """Where the web page is served."""

    host: str = Field(
        default="127.0.0.1",
        min_length=1,
        description="address to listen on; any but this computer's own (127.0.0.1, ::1, localhost) needs users and a certificate",
    )
    port: int = Field(default=8080, ge=0, le=65535, description="0: any free port")
    names: list[Annotated[str, Field(pattern=r"^[A-Za-z0-9.:\[\]-]{1,253}$")]] = Field(
        default_factory=list, description="names and addresses under which other computers ask for the page, e.g. abbe.plant.example"
    )
    certificate: str = Field(default="", description="TLS certificate, PEM file (relative to the machine file's folder); empty: plain HTTP")
    key: str = Field(default="", description="private key of the certificate, PEM file")
    behind_tls: bool = Field(
        default=False,
        description="a reverse proxy on this computer terminates TLS, keeps Host and appends to X-Forwarded-For; names holds its host name",
    )
    memory_mb: int = Field(
        default=1024,
        ge=512,
        le=65536,
        description="memory limit of the page's process, MiB; the core restarts a process that exceeds it",
    )

    @model_validator(mode="after")
    def _both(self) -> Self:
        if bool(self.certificate) != bool(self.key):
            raise ValueError("certificate and key belong together, expected both or neither")
        if self.behind_tls and not self.names:
            raise ValueError("behind_tls = true needs names: add the host name under which browsers reach the proxy")
        return self


class OpcUa(ConfigTable):
    """A read-only OPC UA server that shows the machine to the plant."""

    enabled: bool = Field(default=False, description="whether the server runs; it needs the optional packages: pip install 'abbe[opcua]'")
    host: str = Field(
        default="127.0.0.1",
        min_length=1,
        description="address to listen on; any but this computer's own needs certificate, key and clients",
    )
    port: int = Field(default=4840, ge=0, le=65535, description="0: any free port")
    certificate: str = Field(
        default="", description="TLS certificate of this server, PEM file (relative to the machine file's folder); empty: not encrypted"
    )
    key: str = Field(default="", description="private key of the certificate, PEM file")
    clients: tuple[str, ...] = Field(
        default=(),
        description="certificates of the programs that may read, PEM or DER files; without any: every program on this computer",
    )

    @model_validator(mode="after")
    def _both(self) -> Self:
        if bool(self.certificate) != bool(self.key):
            raise ValueError("certificate and key belong together, expected both or neither")
        return self

    @property
    def exposed(self) -> bool:
        """Whether other computers can reach the server: then every client needs encryption and a known certificate."""
        try:
            return not ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return self.host != "localhost"

    @property
    def guarded(self) -> bool:
        """Whether only clients with a known certificate may read."""
        return self.exposed or bool(self.clients)


def _public_key(text: str) -> str:
    if len(text) != 64 or not set(text) <= set("0123456789abcdef"):
        raise ValueError(f"{text!r} is not a public key, expected 64 hex digits as `abbe key new` prints them")
    return text


class Signatures(ConfigTable):
    """Keys of the people whose signatures are trusted; a compensation file without a trusted signature is only a candidate."""

    trusted: list[Annotated[str, AfterValidator(_public_key)]] = Field(
        default_factory=list, description="public keys of metrologists, 64 hex digits each, as `abbe key new` prints them"
    )


class AlarmSection(ConfigTable):
    """Conditions for an alarm of scheduled checks before a limit is exceeded, and reactions that the service may start by itself."""

    warn_days: float = Field(
        default=14.0,
        ge=0.0,
        le=3650.0,
        description="alarm when a figure may reach its limit within this many days (lower end of the 95 % interval); 0: never",
    )
    campaign: str = Field(
        default="identification",
        min_length=1,
        description="what the service measures for a schedule with on_alarm: identification, or a recipe FILE.toml beside this file",
    )
    push: Literal["never", "approved"] = Field(
        default="never",
        description="approved: when the machine is idle, the service pushes a proposal that a person has approved, and verifies it",
    )
    watch_table: bool = Field(
        default=True, description="check every 10 s whether another program activated a compensation table, and raise an alarm"
    )


class MachineFile(ConfigTable):
    """One machine: its geometry, its devices, where results go, and the limits that protect it."""

    name: str = Field(min_length=1, max_length=200)
    chain: Chain = Field(description="carriages from workpiece w over bed b to tool t, e.g. w-X-Y-b-Z-t")
    vertical_axis: str = Field(default="Z", pattern="^[XYZ]$")
    stroke_mm: AxisIntervals
    short_strokes: bool = Field(
        default=False, description="accept strokes under 50 mm: otherwise they are refused, since they may be inches"
    )
    pivots_mm: AxisPoints = AxisPoints()
    tool_mm: Point = Field(default=(0.0, 0.0, 0.0), description="from the spindle reference point to the functional point")
    devices: Devices = Devices()
    store: StoreSection = StoreSection()
    limits: Limits = Limits()
    material: Material = Material()
    calibration: Calibration = Calibration()
    issuer: Issuer | None = None
    item: Item = Item()
    nc: Nc = Nc()
    verify: Verify = Verify()
    mqtt: Mqtt = Mqtt()
    web: Web = Web()
    opcua: OpcUa = OpcUa()
    signatures: Signatures = Signatures()
    alarm: AlarmSection = AlarmSection()
    schedule: list[Annotated[Schedule, AfterValidator(one_way)]] = Field(default_factory=list)
    maintenance: list[MachineWindow] = Field(default_factory=list, description="windows in which no scheduled check starts")
    staffed: list[MachineWindow] = Field(default_factory=list, description="when an operator is at the machine")

    @field_validator("schedule")
    @classmethod
    def _names_differ(cls, entries: list[Schedule]) -> list[Schedule]:
        twice = [name for name, count in Counter(entry.name for entry in entries).items() if count > 1]
        if twice:
            raise ValueError(f"two schedules are named {twice[0]!r}, expected different names")
        return entries

    @model_validator(mode="after")
    def _of_a_machine(self) -> Self:
        for axis, (low, high) in self.stroke_mm.model_dump().items():
            found = f"stroke_mm.{axis} = [{low:g}, {high:g}]"
            if max(abs(low), abs(high), high - low) > LONGEST_MM:
                raise ValueError(f"{found}: expected mm, no axis is longer than {LONGEST_MM:g} mm")
            if high - low < SHORTEST_MM and not self.short_strokes:
                meant = f"if it really is shorter than {SHORTEST_MM:g} mm, write short_strokes = true"
                raise ValueError(f"{found}: expected mm, {high - low:g} looks like inches; {meant}")
        return self

    @model_validator(mode="after")
    def _can_be_met(self) -> Self:
        if (room := self.calibration.room_temperature_c) is not None:
            low, high = self.limits.temperature_c
            if self.devices.laser:
                raise ValueError("room_temperature_c is stated beside a laser, whose sensor reads the air: expected only one of them")
            if not low <= room[0] <= room[1] <= high:
                raise ValueError(f"room_temperature_c is outside of [limits] temperature_c, expected inside {low:g} to {high:g}")
        for entry in self.schedule:
            if entry.needs.operator == "present" and not self.staffed:
                raise ValueError(f"schedule {entry.name!r} needs an operator, expected [[staffed]] to say when one is there")
            if entry.needs.air and self.devices.laser is None:
                raise ValueError(f"schedule {entry.name!r} needs the air's temperature, expected a laser in [devices] to measure it")
        return self

    def machine_doc(self) -> dict[str, object]:
        """Return the ``machine`` object of the exchange format."""
        keys = {"name", "chain", "vertical_axis", "stroke_mm", "pivots_mm", "tool_mm"}
        return self.model_dump(mode="json", include=keys)
