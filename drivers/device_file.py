"""The device file: a TOML file that describes the protocol of one kind of device (docs/schemas/device-file.schema.json).

The file states facts of the device's manual. `abbe.drivers.conformance`, not the file, decides what these facts prove.
"""

from __future__ import annotations

import hashlib
import re
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from abbe.drivers.errors import BadDeviceFile

FORMAT = "abbe-device/1"
BUILTIN = Path(__file__).with_name("described") / "files"
"""Folder of the built-in device files."""
Kind = Literal["displacement", "position", "temperature"]
Type = Literal["u16", "i16", "u32", "i32", "u64", "i64", "f32", "f64"]
SIZE: dict[Type, int] = {"u16": 1, "i16": 1, "u32": 2, "i32": 2, "f32": 2, "u64": 4, "i64": 4, "f64": 4}
"""Number of registers of a value, by its type."""
Order = Literal["ABCD", "CDAB", "BADC", "DCBA"]
Unit = Literal["nm", "um", "mm", "in", "degC", "degF", "Pa", "hPa", "%", "permille", "us", "ms", "s", "1"]
QUANTITIES: dict[str, tuple[Unit, ...]] = {
    "displacement": ("nm", "um", "mm", "in"),
    **dict.fromkeys(("x", "y", "z"), ("nm", "um", "mm", "in")),
    **dict.fromkeys(("temperature", "air_temperature"), ("degC", "degF")),
    "air_pressure": ("Pa", "hPa"),
    "air_humidity": ("%",),
    "signal": ("permille", "%"),
    "counter": ("1",),
    "time": ("us", "ms", "s"),
}
"""Values that a job can use, and their units. Other names are for `States` only."""
NEEDED: dict[Kind, tuple[str, ...]] = {"displacement": ("displacement",), "position": ("x", "y", "z"), "temperature": ("temperature",)}
Bad = Literal["beam lost", "signal low", "no reflector", "out of range", "fault"]
Condition = Literal["e-stop", "door open", "alarm", "moving", "in position", "nc program", "measure now"]
Register = Annotated[int, Field(ge=0, le=65535)]
Word = Annotated[int, Field(ge=0, le=65535)]


def _regular(text: str) -> str:
    try:
        re.compile(text)
    except re.error as error:
        raise ValueError(f"not a regular expression: {error}") from None
    return text


def _escaped(text: str) -> str:
    if not text.isascii():
        raise ValueError("only ASCII is sent; write control characters as \\r, \\n or \\u001b")
    return text


Pattern = Annotated[str, AfterValidator(_regular)]
Text = Annotated[str, AfterValidator(_escaped)]


class DeviceTable(BaseModel):
    """Base of all tables of a device file: unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False, defer_build=True)


class DeviceValue(DeviceTable):
    """One value: its place in the protocol, and the meaning of a count: value = sign * scale * count + offset, in ``unit``."""

    address: Register | None = Field(default=None, description="Modbus: first register, from 0; a line's values are groups of its pattern")
    type: Type = Field(default="f64", description="Modbus: type; the text of a line is a decimal number")
    order: Order | None = Field(default=None, description="Modbus: byte order of this value, if it differs from [modbus] order")
    unit: Unit = Field(default="1", description="unit of the value after scaling")
    scale: float = Field(default=1.0, gt=0, description="units per count")
    sign: Literal[1, -1] = Field(default=1, description="-1: the count grows the other way")
    offset: float = Field(default=0.0, description="in the unit")


class IdentityRegisters(DeviceTable):
    """Registers whose content identifies the device; two or more prove the byte order, if no other order gives the same content."""

    address: Register
    type: Type = "u16"
    holds: int | float
    order: Order | None = None

    @model_validator(mode="after")
    def _fits(self) -> Self:
        bits = 16 * SIZE[self.type]
        low = -(1 << bits - 1) if self.type[0] == "i" else 0
        if self.type[0] != "f" and not (isinstance(self.holds, int) and low <= self.holds < low + (1 << bits)):
            raise ValueError(f"{self.holds} is no {self.type}")
        return self


class Flag(DeviceTable):
    """Meaning of a set bit of a value, or of a value outside of limits (in its unit)."""

    value: str = Field(description="name of a value in [values]")
    bit: int | None = Field(default=None, ge=0, le=63)
    set: bool = Field(default=True, description="false: the meaning holds when the bit is 0")
    below: float | None = None
    above: float | None = None
    means: Bad | Condition

    @model_validator(mode="after")
    def _one_test(self) -> Self:
        if (self.bit is None) == (self.below is None and self.above is None):
            raise ValueError("expected bit, or below and/or above")
        return self


class Command(DeviceTable):
    """A command, sent once and never repeated, and how the device acknowledges it.

    Modbus: the words ``write`` go to registers from ``address`` on. ``numbered``: register with the number of the last executed command;
    the next number is then sent before ``write``. ``becomes``: content of register ``acknowledge`` afterwards. Line: ``send``, and the
    pattern of the ``answer``.
    """

    address: Register | None = None
    write: tuple[Word, ...] = ()
    function: Literal[3, 4] = Field(default=3, description="Modbus: function code with which `numbered` and `acknowledge` are read")
    numbered: Register | None = None
    acknowledge: Register | None = None
    becomes: Word = 0
    send: Text = ""
    answer: Pattern = ""
    within_s: float = Field(default=1.0, gt=0, le=30)


class ModbusTable(DeviceTable):
    """Modbus TCP or RTU. The address and unit stand in the URL."""

    order: Order = Field(description="bytes of a value of two registers: ABCD is high register first, CDAB low register first")
    function: Literal[3, 4] = Field(default=3, description="function code of reads")
    write_function: Literal[6, 16] = Field(default=16, description="function code of writes; 6 writes one register")
    baud: int | None = Field(default=None, ge=300, le=12_000_000, description="RTU; replaces the baud rate in the URL")
    parity: Literal["none", "even", "odd"] | None = None
    timeout_s: float = Field(default=1.0, gt=0, le=10)


class LineTable(DeviceTable):
    """Lines of text over a serial port or TCP. The port stands in the URL."""

    mode: Literal["poll", "stream"]
    ask: Text = Field(default="", description="poll: sent for every reading")
    ends: Text = Field(default="\r\n", min_length=1, description="end of every line of the device")
    pattern: Pattern = Field(description="regular expression of a whole line; its named groups are values")
    error: Pattern = Field(default="", description="regular expression of a line that reports an error")
    who: Text = Field(default="", description="sent to ask for the identity")
    answers: Pattern = Field(default="", description="regular expression of the identity; its group serial_no is the serial number")
    baud: int | None = Field(default=None, ge=300, le=12_000_000, description="serial; replaces the baud rate in the URL")
    parity: Literal["none", "even", "odd"] | None = None
    bits: Literal[7, 8] = 8
    stop: Literal[1, 2] = 1
    timeout_s: float = Field(default=1.0, gt=0, le=10)


class PromisedLimits(DeviceTable):
    """Limits promised by the manual. Absent: not promised."""

    rate_hz: float = Field(gt=0, le=1000, description="readings per second that the device allows")
    update_s: float | None = Field(default=None, gt=0, le=10, description="longest time for which the device shows an old value")
    range_mm: tuple[float, float] | None = Field(default=None, description="measuring range, after sign and offset")
    resolution: float | None = Field(default=None, gt=0, description="smallest step of the reading, in its unit")
    u: float | None = Field(default=None, gt=0, description="standard uncertainty of a reading by the manual, in its unit")


class DeviceFile(DeviceTable):
    """The protocol of one kind of device."""

    format: Literal["abbe-device/1"]
    kind: Kind
    name: str = Field(min_length=1, max_length=80, description="name of the device for people")
    source: str = Field(default="", description="manual and chapter that this file was written from")
    air: Literal["no light", "compensated", "vacuum"] = Field(
        default="no light",
        description="how a displacement sensor measures: without light; with light, corrected for the air; not corrected (refused)",
    )
    modbus: ModbusTable | None = None
    line: LineTable | None = None
    identity: tuple[IdentityRegisters, ...] = ()
    serial_no: DeviceValue | None = Field(default=None, description="Modbus: registers of the serial number")
    boot: DeviceValue | None = Field(default=None, description="Modbus: registers that change with every start of the device")
    values: dict[str, DeviceValue]
    flags: tuple[Flag, ...] = ()
    zero: Command | None = Field(default=None, description="sets the displacement to zero; absent: Abbe subtracts the reading")
    clear: Command | None = Field(default=None, description="clears a latched error")
    compensate: Command | None = Field(default=None, description="switches the correction for the air on")
    limits: PromisedLimits

    @model_validator(mode="after")
    def _whole(self) -> Self:
        if (self.modbus is None) == (self.line is None):
            raise ValueError("expected either [modbus] or [line], not both")
        for name in NEEDED[self.kind]:
            if name not in self.values:
                raise ValueError(f"a file of kind {self.kind!r} needs [values.{name}]")
        for name, value in self.values.items():
            if name in QUANTITIES and value.unit not in QUANTITIES[name]:
                raise ValueError(f"values.{name}.unit is {value.unit!r}, expected one of {', '.join(QUANTITIES[name])}")
        self._places()
        for flag in self.flags:
            if flag.value not in self.values:
                raise ValueError(f"a flag reads the value {flag.value!r}, which is not in [values]")
        return self

    def _places(self) -> None:
        if self.line is not None:
            groups = set(re.compile(self.line.pattern).groupindex)
            if missing := sorted(set(self.values) - groups):
                raise ValueError(f"line.pattern has no group (?P<{missing[0]}>...) for values.{missing[0]}")
            if (self.line.mode == "poll") != bool(self.line.ask):
                raise ValueError('line.ask: expected a request with mode = "poll", and none with mode = "stream"')
            if self.line.who and not self.line.answers:
                raise ValueError("line.who needs line.answers")
            return
        without = [name for name, value in self.values.items() if value.address is None]
        if without:
            raise ValueError(f"values.{without[0]} needs an address")
        places = [(value.address or 0, SIZE[value.type]) for value in core_values(self).values()]
        if max(first + size for first, size in places) - min(first for first, _ in places) > ONE_REQUEST:
            raise ValueError(f"values, counter, time and flags lie more than {ONE_REQUEST} registers apart: too far for one request")


ONE_REQUEST = 125
"""Registers that one Modbus request can read."""


def core_values(file: DeviceFile) -> dict[str, DeviceValue]:
    """Return the values that must come from one request, so that they belong to the same moment: measured, counter, time and flags."""
    names = {*NEEDED[file.kind], "counter", "time", "signal", *(flag.value for flag in file.flags)}
    return {name: value for name, value in file.values.items() if name in names}


def port_settings(file: DeviceFile) -> dict[str, Any]:
    """Return the settings of a serial line that the device file states; they replace those of the URL."""
    table = file.modbus or file.line
    return {key: value for key in ("baud", "parity") if (value := getattr(table, key)) is not None}


def find(name: str) -> Path:
    """Return the path of a device file. A name without dot and slash means the built-in file ``name.toml``."""
    return Path(name) if "." in name or "/" in name else BUILTIN / f"{name}.toml"


def load(name: str) -> tuple[DeviceFile, str]:
    """Read a device file (`find`); return it with the SHA-256 of its bytes, hexadecimal.

    Raises
    ------
    BadDeviceFile
        The file is missing, is not TOML, or contradicts itself; the message names the key.
    """
    path = find(name)
    try:
        data = path.read_bytes()
        doc = tomllib.loads(data.decode("utf-8"))
    except FileNotFoundError:
        known = ", ".join(sorted(p.stem for p in BUILTIN.glob("*.toml")))
        raise BadDeviceFile(str(path), "read device file", "it does not exist", f"give a path, or one of {known}") from None
    except UnicodeDecodeError:
        raise BadDeviceFile(str(path), "read device file", "it is not UTF-8 text", "give a readable TOML file in UTF-8") from None
    except (OSError, ValueError, RecursionError) as error:
        raise BadDeviceFile(str(path), "read device file", f"{error}", "give a readable TOML file in UTF-8") from None
    return checked(doc, str(path)), hashlib.sha256(data).hexdigest()


def checked(doc: dict[str, Any], where: str) -> DeviceFile:
    """Return the device file in a parsed TOML document; raises BadDeviceFile, which names ``where`` and the key."""
    try:
        return DeviceFile.model_validate(_tuples(doc))
    except ValidationError as error:
        first = min(error.errors(), key=lambda one: one["type"] != "extra_forbidden")
        key = ".".join(str(part) for part in first["loc"])
        own = {"extra_forbidden": "unknown key", "missing": "the key is missing"}
        text = own.get(first["type"], first["msg"].removeprefix("Value error, "))
        more = f" (and {error.error_count() - 1} more)" if error.error_count() > 1 else ""
        remedy = "docs/reference/device-file.md describes every key"
        raise BadDeviceFile(where, "read device file", f"{key + ': ' if key else ''}{text}{more}", remedy) from None


def _tuples(value: Any) -> Any:
    """Return a document with tuples in place of lists, as strict models require. These models accept TOML's integers as floats."""
    if isinstance(value, dict):
        return {key: _tuples(inner) for key, inner in value.items()}
    return tuple(_tuples(inner) for inner in value) if isinstance(value, list) else value
