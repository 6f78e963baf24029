"""Scenario (TOML): the simulated machine, the size of its errors, and the connections of its devices."""

import dataclasses
import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, get_type_hints

AXES = ("X", "Y", "Z")
DEFAULT_PATH = Path(__file__).parent / "scenarios" / "vmc.toml"

Pair = tuple[float, float]
Triple = tuple[float, float, float]


class ScenarioError(ValueError):
    """The scenario file is unusable; the message is one line and names the key."""


@dataclass(frozen=True, slots=True)
class Strokes:
    """Travel of each axis, (lowest, highest) commanded coordinate in mm."""

    X: Pair = (0.0, 600.0)
    Y: Pair = (0.0, 500.0)
    Z: Pair = (0.0, 450.0)


@dataclass(frozen=True, slots=True)
class Pivots:
    """Pivot of each carriage in mm: work-side in the table frame, tool-side relative to the spindle reference point."""

    X: Triple = (300.0, 250.0, -150.0)
    Y: Triple = (300.0, 250.0, -250.0)
    Z: Triple = (0.0, 320.0, 260.0)


@dataclass(frozen=True, slots=True)
class MachineConfig:
    """The machine's nominal geometry."""

    chain: str = "w-X-Y-b-Z-t"
    stroke_mm: Strokes = field(default_factory=Strokes)
    pivots_mm: Pivots = field(default_factory=Pivots)
    tool_mm: Triple = (0.0, 0.0, -120.0)


@dataclass(frozen=True, slots=True)
class Magnitudes:
    """Sizes of the random draws: pairs are the ends of a uniform draw, ``*_sd_*`` standard deviations of a normal draw."""

    scale_sd_um_per_m: float = 40.0
    squareness_sd_urad: float = 25.0
    positioning_rms_um: Pair = (1.5, 5.0)
    straightness_rms_um: Pair = (1.0, 4.0)
    angle_rms_urad: Pair = (4.0, 14.0)
    angle_slope_sd_urad: float = 15.0
    backlash_um: Pair = (1.0, 5.0)
    cup_offset_um: Pair = (2.0, 30.0)
    bar_length_sd_um: float = 1.5
    bar_noise_um: Pair = (0.25, 0.6)
    laser_noise_factor: float = 0.6
    mirror_tilt_urad: Pair = (30.0, 300.0)
    beam_misalignment_urad: Pair = (100.0, 300.0)
    drift_sd_um: float = 1.0
    drift_tau_min: Pair = (40.0, 90.0)


@dataclass(frozen=True, slots=True)
class BallbarConfig:
    """Connection of the ball-bar's box: ``pty`` (serial line) or ``tcp``; port 0 = any free one."""

    transport: str = "pty"
    port: int = 0


@dataclass(frozen=True, slots=True)
class LaserConfig:
    """Connection of the laser: ``tcp`` (Modbus TCP) or ``rtu`` (Modbus RTU on a pty); port 0 = any free one."""

    transport: str = "tcp"
    port: int = 0


@dataclass(frozen=True, slots=True)
class PortConfig:
    """TCP port of a device on 127.0.0.1; 0 = any free one."""

    port: int = 0


@dataclass(frozen=True, slots=True)
class HiddenConfig:
    """One hidden effect (simulators/hidden); an empty ``name`` means none.

    ``key``: axis, component or plane; ``parameters``: ``strength`` in the effect's unit, and further ones that the effect needs; ``wild``:
    seed of its departures from the textbook form, 0: none.
    """

    name: str = ""
    key: str = ""
    wild: int = 0
    parameters: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class ArtefactConfig:
    """The plate that the fixture can put on the table: ``kind`` is ``hole_plate`` or ``ball_plate``; then sizes of its random draws."""

    kind: str = "hole_plate"
    columns: int = 4
    rows: int = 4
    pitch_mm: float = 75.0
    radius_mm: float = 10.0
    form_um: float = 15.0
    expansion_ppm: float = 11.5
    drift_um_per_h: float = 0.8
    clamping_um: float = 0.2
    u_length_um: float = 0.4


@dataclass(frozen=True, slots=True)
class ProbeConfig:
    """The touch probe: radius of its ball, mean pre-travel, lobing (amplitude), noise of the trip."""

    radius_mm: float = 3.0
    pretravel_um: float = 9.0
    lobing_um: float = 1.0
    noise_um: float = 0.3


@dataclass(frozen=True, slots=True)
class SphereConfig:
    """A qualification sphere fixed on the table: axis position at which the stylus tip is at its centre; radius 0: there is none."""

    centre_mm: Triple = (0.0, 0.0, 0.0)
    radius_mm: float = 0.0


@dataclass(frozen=True, slots=True)
class Scenario:
    """Everything that determines the simulated world. The same scenario gives the same world, bit for bit.

    ``boot_id``: boot id of the controller; 0: a new one at each start, as after switching the controller off and on.
    """

    seed: int = 1
    speed: float = 1.0
    boot_id: int = 0
    machine: MachineConfig = field(default_factory=MachineConfig)
    magnitudes: Magnitudes = field(default_factory=Magnitudes)
    ballbar: BallbarConfig = field(default_factory=BallbarConfig)
    laser: LaserConfig = field(default_factory=LaserConfig)
    cnc: PortConfig = field(default_factory=PortConfig)
    fixture: PortConfig = field(default_factory=PortConfig)
    hidden: HiddenConfig = field(default_factory=HiddenConfig)
    artefact: ArtefactConfig = field(default_factory=ArtefactConfig)
    probe: ProbeConfig = field(default_factory=ProbeConfig)
    sphere: SphereConfig = field(default_factory=SphereConfig)


def load(path: Path = DEFAULT_PATH) -> Scenario:
    """Read and check a scenario file.

    Raises
    ------
    ScenarioError
        File missing, not TOML, unknown key, wrong type or impossible value.
    """
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as exc:
        raise ScenarioError(f"{path}: {exc}") from exc
    return from_dict(data)


def from_dict(data: dict[str, Any]) -> Scenario:
    """Build and check a scenario out of parsed TOML; missing keys keep their defaults."""
    scenario: Scenario = _build(Scenario, data, "")
    check(scenario)
    return scenario


def check(scenario: Scenario) -> None:
    """Raise ScenarioError for values that no machine can have."""
    parse_chain(scenario.machine.chain)
    for axis in AXES:
        low, high = getattr(scenario.machine.stroke_mm, axis)
        if not high > low:
            raise ScenarioError(f"machine.stroke_mm.{axis}: the highest position must be above the lowest")
    if not scenario.speed > 0.0:
        raise ScenarioError("speed: must be above 0")
    if scenario.seed < 0:
        raise ScenarioError("seed: must not be negative")
    if not 0 <= scenario.boot_id < 2**32:
        raise ScenarioError("boot_id: must be 0..4294967295")
    for name, value, allowed in (
        ("ballbar.transport", scenario.ballbar.transport, ("pty", "tcp")),
        ("laser.transport", scenario.laser.transport, ("tcp", "rtu")),
        ("artefact.kind", scenario.artefact.kind, ("hole_plate", "ball_plate")),
    ):
        if value not in allowed:
            raise ScenarioError(f"{name}: {value!r} is none of {', '.join(allowed)}")
    _check_artefact(scenario.artefact, scenario.probe)
    for name in ("ballbar", "laser", "cnc", "fixture"):
        if not 0 <= getattr(scenario, name).port <= 65535:
            raise ScenarioError(f"{name}.port: must be 0..65535")


def _check_artefact(plate: ArtefactConfig, probe: ProbeConfig) -> None:
    if not (1 <= plate.columns <= 26 and 1 <= plate.rows <= 26):
        raise ScenarioError("artefact.columns, artefact.rows: must be 1..26")
    if not 0.0 < probe.radius_mm < plate.radius_mm < 0.5 * plate.pitch_mm:
        raise ScenarioError("artefact.radius_mm: the probe's ball must fit into a hole, and two features into a pitch")


def parse_chain(chain: str) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Split a chain such as ``w-X-Y-b-Z-t`` into axis indices (work side from workpiece to bed, tool side from bed to tool)."""
    parts = chain.split("-")
    inner = parts[1:-1]
    if len(parts) != 6 or parts[0] != "w" or parts[-1] != "t" or sorted(inner) != ["X", "Y", "Z", "b"]:
        raise ScenarioError(f"machine.chain: {chain!r} is not w-...-t with X, Y, Z and b once each")
    bed = inner.index("b")
    return tuple(AXES.index(a) for a in inner[:bed]), tuple(AXES.index(a) for a in inner[bed + 1 :])


def _build(kind: Any, data: Any, where: str) -> Any:
    """Turn a TOML table into the frozen dataclass ``kind``; ``where`` is the key path for messages."""
    if not isinstance(data, dict):
        raise ScenarioError(f"{where.rstrip('.')}: a table is expected")
    hints = get_type_hints(kind)
    known = {f.name for f in dataclasses.fields(kind)}
    for key in data:
        if key not in known:
            raise ScenarioError(f"unknown key: {where}{key}")
    return kind(**{key: _value(hints[key], value, where + key) for key, value in data.items()})


def _value(kind: Any, value: Any, where: str) -> Any:
    """Check one TOML value against the type of its field."""
    if dataclasses.is_dataclass(kind):
        return _build(kind, value, where + ".")
    if kind is str and isinstance(value, str):
        return value
    if kind is int and isinstance(value, int) and not isinstance(value, bool):
        return value
    if kind is float and _is_number(value):
        return float(value)
    if kind == dict[str, float] and isinstance(value, dict) and all(_is_number(v) for v in value.values()):
        return {name: float(v) for name, v in value.items()}
    if kind in (Pair, Triple):
        length = 2 if kind == Pair else 3
        if isinstance(value, list) and len(value) == length and all(_is_number(v) for v in value):
            return tuple(float(v) for v in value)
        raise ScenarioError(f"{where}: a list of {length} numbers is expected")
    raise ScenarioError(f"{where}: {value!r} is not of type {kind.__name__}")


def _is_number(value: Any) -> bool:
    """Whether a TOML value is a number (TOML booleans are not, though Python's are ints)."""
    return isinstance(value, int | float) and not isinstance(value, bool)
