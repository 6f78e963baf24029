"""A machine: the ``machine`` object of the exchange format, the types that it shares with the machine file, and the addresses of devices.

Nothing here connects to a device.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import date
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self
from urllib.parse import parse_qs, urlsplit

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

if TYPE_CHECKING:
    from abbe.models.machine import Machine

Name = Annotated[str, Field(min_length=1, max_length=200)]
Role = Literal["identify", "holdout", "sealed"]


def check_chain(text: str) -> str:
    """Return a valid kinematic chain, e.g. ``"w-X-Y-b-Z-t"``.

    Raises
    ------
    ValueError
        The chain does not go from w to t over b with each of X, Y, Z once.
    """
    parts = text.split("-")
    if parts[0] != "w" or parts[-1] != "t" or sorted(parts[1:-1]) != ["X", "Y", "Z", "b"]:
        raise ValueError(f"expected a chain from w to t with X, Y, Z and b once each, e.g. 'w-X-Y-b-Z-t', got {text!r}")
    return text


def _check_interval(pair: tuple[float, float]) -> tuple[float, float]:
    if not pair[0] < pair[1]:
        raise ValueError(f"expected [smaller, larger], got {list(pair)}")
    return pair


Chain = Annotated[str, AfterValidator(check_chain)]
Interval = Annotated[tuple[float, float], AfterValidator(_check_interval)]
Point = tuple[float, float, float]


class FileObject(BaseModel):
    """Base of everything in an exchange file: unknown keys are kept, numbers are finite, text is not a number."""

    model_config = ConfigDict(extra="allow", allow_inf_nan=False, strict=True, frozen=True, defer_build=True)

    @classmethod
    def read(cls, doc: object) -> Self:
        """Validate a parsed JSON object, in which lists stand for tuples.

        Raises
        ------
        pydantic.ValidationError
            The object has another form.
        """
        return cls.model_validate(doc, strict=False)


class Strokes(FileObject):
    """Travel of each axis, commanded coordinates, mm."""

    X: Interval
    Y: Interval
    Z: Interval


class Pivots(FileObject):
    """Points about which carriages turn, mm."""

    X: Point | None = None
    Y: Point | None = None
    Z: Point | None = None


class MachineObject(FileObject):
    """Nominal geometry of a machine."""

    name: str | None = None
    chain: Chain = Field(description="carriages from workpiece w over bed b to tool t")
    vertical_axis: Literal["X", "Y", "Z"]
    stroke_mm: Strokes
    pivots_mm: Pivots | None = None
    tool_mm: Point | None = None


class MeasuredFile(FileObject):
    """Head of runs and campaigns: campaign and machine."""

    campaign: Name
    machine: MachineObject


class RunFileHead(MeasuredFile):
    """Head of every run, of an instrument or of an artefact (``abbe-run/1``)."""

    format: Literal["abbe-run/1"]
    run_id: Name
    role: Role


UNIT = "1"
"""Modbus unit of a URL that names none."""


@dataclass(frozen=True, slots=True)
class DeviceUrls:
    """Device URLs of a machine; None: not connected. ``control``: identity of the control (`control_of`); empty without a control."""

    cnc: str | None = None
    ballbar: str | None = None
    laser: str | None = None
    fixture: str | None = None
    control: str = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "control", control_of(self.cnc))

    def named(self) -> tuple[str, ...]:
        """Roles that have an address."""
        return tuple(role for role in ("cnc", "ballbar", "laser", "fixture") if getattr(self, role) is not None)


def control_of(url: str | None) -> str:
    """Return the identity of a control for the push journal; empty for no URL.

    The register map has no serial number, and a boot id changes at every start, so the address identifies the control: `address_of`, plus
    the Modbus unit if it is not 1, because a gateway has several controls behind one address. One control under two addresses (a host name
    and its IP) counts as two: docs/decisions/0030-whose-table-it-is.md.
    """
    address = address_of(url)
    unit = parse_qs((url or "").partition("?")[2]).get("unit", [UNIT])[0].strip().lstrip("0") or "0"
    return address if unit == UNIT or not address else f"{address}?unit={unit}"


def address_of(url: str | None) -> str:
    """Return the address in a URL for the machine lock: scheme, host in lower case and port (or the path of a serial line), no query.

    All units behind one address share one lock. Text that is no URL is its own address: the machine file refuses it later.
    """
    if not url:
        return ""
    plain = url.partition("?")[0]
    try:
        parts = urlsplit(plain)
    except ValueError:
        return plain
    return f"{parts.scheme}://{parts.netloc.lower()}{parts.path.rstrip('/')}" if parts.scheme else plain


@dataclass(frozen=True, slots=True)
class AxisMaterial:
    """Section ``[material]`` of the machine file for one axis; None: not stated. Every ``u_`` is a standard uncertainty.

    ``scale_per_k``, ``laser_per_k``: expansion coefficients of the scale and of the laser's own compensation (0: off), 1/K;
    ``temperature_c``: temperature of the scale, °C, for runs that did not record it; ``u_temperature_k``: uncertainty of the recorded or
    stated temperature, K. ``workpiece_per_k``: expansion coefficient of the workpieces, 1/K, the same for all axes.
    """

    scale_per_k: float | None
    u_scale_per_k: float | None
    temperature_c: float | None
    u_temperature_k: float
    laser_per_k: float
    workpiece_per_k: float | None = None
    u_workpiece_per_k: float | None = None


class ConfigTable(BaseModel):
    """A table of the machine file: no unknown key, no NaN, immutable."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True, defer_build=True)


class Item(ConfigTable):
    """The machine as a certificate identifies it."""

    maker: str = Field(default="", max_length=200)
    model: str = Field(default="", max_length=200)
    serial: str = Field(default="", max_length=200)
    place: str = Field(default="", max_length=200, description="where it stands, e.g. hall 3")


class Issuer(ConfigTable):
    """Who issues calibration certificates (ISO/IEC 17025, 7.8): with it reports become certificates, on paper, page and as DCC."""

    laboratory: str = Field(min_length=1, max_length=200)
    city: str = Field(min_length=1, max_length=200)
    country: str = Field(pattern="^[A-Z]{2}$", description="ISO 3166-1, two letters")
    person: str = Field(min_length=1, max_length=200, description="who is responsible")
    address: str = Field(default="", max_length=400, description="of the laboratory: street and number")
    accreditation: str = Field(default="", max_length=200, description="body and number of the accreditation; empty: none is claimed")
    procedure: str = Field(default="", max_length=200, description="the laboratory's own procedure with its edition")
    prefix: str = Field(default="", max_length=20, description="prefix of each certificate's number, e.g. CAL-")
    customer: str = Field(default="", max_length=200, description="owner of the machine; empty: the laboratory itself")
    customer_address: str = Field(default="", max_length=400)
    place: Literal["laboratory", "customer", "laboratoryBranch", "customerBranch", "other"] = Field(
        default="customer", description="where machines are measured, as seen from the laboratory"
    )


@dataclass(frozen=True, slots=True)
class Rules:
    """Rules from a machine file, as reports and pages use them.

    ``limits_um``: limits of figures, named as in `abbe.service.verification.verify.figure_rows`; ``calibrated_until``: last day of the
    certificate, by instrument; ``temperature_c``: allowed range of the air; ``materials``: expansion of the scales, by axis;
    ``instruments``: identity and certificate, by instrument; ``issuer``, ``item``: for a certificate, None without a laboratory.
    """

    limits_um: dict[str, float] = field(default_factory=dict)
    calibrated_until: dict[str, date] | None = None
    temperature_c: tuple[float, float] | None = None
    materials: dict[str, AxisMaterial] = field(default_factory=dict)
    instruments: dict[str, str] = field(default_factory=dict)
    issuer: Issuer | None = None
    item: Item | None = None


def machine_from_doc(doc: dict[str, Any]) -> Machine:
    """Return the nominal geometry of a machine object (docs/schemas/machine.schema.json); pivots and tool default to zero.

    Raises
    ------
    ValueError
        A key is missing or impossible; the message names it.
    """
    import numpy as np  # here: lists of what is stored need no numpy

    from abbe.models.machine import AXES, Machine

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
    """Return the machine object (docs/schemas/machine.schema.json) for a nominal geometry."""
    return {
        "name": name,
        "chain": machine.chain,
        "vertical_axis": vertical_axis,
        "stroke_mm": {a: [float(v) for v in machine.stroke_mm[k]] for k, a in enumerate("XYZ")},
        "pivots_mm": {a: [float(v) for v in machine.pivots_mm[k]] for k, a in enumerate("XYZ")},
        "tool_mm": [float(v) for v in machine.tool_mm],
    }
