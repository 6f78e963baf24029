"""The exchange formats as pydantic models. They are also the source of docs/schemas/*.schema.json."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import ConfigDict, Field, model_validator

from abbe.service.domain.artefact import ArtefactObject
from abbe.service.domain.machine import FileObject, Interval, MeasuredFile, Name, Point, Role, RunFileHead


class SourceFile(FileObject):
    """One file that was imported.

    ``sha256``: digest of its bytes; ``said``: the facts that it states, as text; ``unknown``: facts that neither file nor answers state.
    """

    file: str
    format: str
    sha256: str = Field(pattern="^[0-9a-f]{64}$")
    said: dict[str, str] = Field(default_factory=dict)
    unknown: list[str] = Field(default_factory=list)


class OtherReadings(FileObject):
    """Readings of one axis that belong to no run, one list per column.

    ``angle``: readings of an angular instrument, rad; ``mean``: means of both directions as a file states them, mm; their ``direction``
    is 0. ``resolution``: smallest step of the readings, rad or mm.
    """

    kind: Literal["angle", "mean"]
    file: str
    setup_id: str
    axis: Literal["X", "Y", "Z"]
    position_mm: list[float]
    direction: list[Literal[1, 0, -1]]
    deviation: list[float]
    resolution: float = Field(0.0, ge=0.0)

    @model_validator(mode="after")
    def _equally_long(self) -> Self:
        if not len(self.position_mm) == len(self.direction) == len(self.deviation):
            raise ValueError("expected as many positions as directions and deviations")
        return self


class StatedFigure(FileObject):
    """One result that a file states. Its uncertainty is unknown: the file holds none."""

    file: str
    group: str
    symbol: str
    name: str
    value: float
    unit: str


RUN_FORMAT = "abbe-run/1"
CAMPAIGN_FORMAT = "abbe-campaign/1"

Test = Literal["ballbar_helix", "ballbar_circle", "laser_diagonal", "laser_linear"]
Known = Literal["rigid6", "rigid21", "setup_centre_offset", "bar_length_error", "mirror_tilt"]
"""Effects that a campaign may state for the present simulation of its machine."""
ASSUMED_MODEL: tuple[Known, ...] = ("rigid21", "setup_centre_offset", "bar_length_error", "mirror_tilt")
"""Effects that are assumed if a campaign states none. A stated empty list means: only linear errors and squareness."""
Numbers = list[float]
FileName = Annotated[str, Field(pattern=r"^[^/\\\x00]+\.json$")]
"""A plain file of the same folder: a campaign must not reach files elsewhere."""

SETUP_KEYS: dict[str, tuple[str, ...]] = {
    "ballbar_helix": ("centre_mm", "radius_mm", "turns"),
    "ballbar_circle": ("centre_mm", "radius_mm", "plane"),
    "laser_diagonal": ("diagonal", "start_mm", "end_mm", "increment_mm", "steps", "nominal_beam"),
    "laser_linear": ("axis", "start_mm", "end_mm"),
}
"""Keys that ``setup`` must have besides ``setup_id`` and ``t_set_s``."""


class SetupObject(FileObject):
    """Mounting of the instrument. The test determines which keys are needed."""

    setup_id: str
    t_set_s: float
    centre_mm: Point | None = None
    radius_mm: float | None = Field(None, gt=0.0)
    turns: float | None = None
    plane: Literal["XY", "YZ", "ZX", "XZ", "YX", "ZY"] | None = None
    length_calibrated: bool | None = None
    u_length_mm: float | None = Field(None, ge=0.0)
    tool_mm: Point | None = None
    diagonal: Literal["ppp", "npp", "pnp", "ppn"] | None = None
    axis: Literal["X", "Y", "Z"] | None = None
    start_mm: Point | None = None
    end_mm: Point | None = None
    increment_mm: Point | float | None = None
    steps: int | None = Field(None, gt=0)
    nominal_beam: Point | None = None
    order: str | None = None


class ColumnsObject(FileObject):
    """Readings, one list per column, all of the same length. Further columns carry their unit in the name."""

    model_config = ConfigDict(
        json_schema_extra={"additionalProperties": {"anyOf": [{"type": "array", "items": {"type": "number"}}, {"type": "null"}]}}
    )
    __pydantic_extra__: dict[str, Numbers | None]

    t_s: Numbers
    x_mm: Numbers
    y_mm: Numbers
    z_mm: Numbers
    feed_mm_min: Numbers
    direction: list[Literal[1, -1]]
    deviation_mm: Numbers | None
    temp_x_C: Numbers | None = None  # noqa: N815 - names of the format
    temp_y_C: Numbers | None = None  # noqa: N815
    temp_z_C: Numbers | None = None  # noqa: N815
    temp_spindle_C: Numbers | None = None  # noqa: N815
    temp_air_C: Numbers | None = None  # noqa: N815
    pressure_air_Pa: Numbers | None = None  # noqa: N815
    valid: list[Literal[0, 1]] | None = None


class RunFile(RunFileHead):
    """One measured sequence (``abbe-run/1``)."""

    test: Test
    setup: SetupObject
    columns: ColumnsObject

    @model_validator(mode="after")
    def _test_decides(self) -> Self:
        for key in SETUP_KEYS[self.test]:
            if getattr(self.setup, key) is None:
                raise ValueError(f"key 'setup.{key}' is missing, expected for a run of test {self.test!r}")
        if self.columns.deviation_mm is None and self.role != "sealed":
            raise ValueError(
                "columns.deviation_mm: expected a list of numbers, got null "
                f"(only a run of role 'sealed' may have null, this one is {self.role!r})"
            )
        return self


class CurrentModel(FileObject):
    """Effects that the present simulation of the machine includes."""

    includes: list[Known]
    errors: FileName | None = None


class CampaignSetup(FileObject):
    """One mounting that several runs can share."""

    kind: str
    t_set_s: float


class RunEntry(FileObject):
    """One run of the campaign and its file."""

    run_id: Name
    test: Test | Literal["artefact_points"]
    role: Role
    file: FileName


class CampaignFile(MeasuredFile):
    """Head of a campaign folder (``abbe-campaign/1``)."""

    format: Literal["abbe-campaign/1"]
    current_model: CurrentModel
    instruments: dict[str, FileObject]
    setups: dict[str, CampaignSetup]
    temperature_sensors: bool
    runs: list[RunEntry]
    artefacts: dict[str, ArtefactObject] = Field(default_factory=dict)
    origins: list[SourceFile] = Field(default_factory=list)
    readings: list[OtherReadings] = Field(default_factory=list)
    stated: list[StatedFigure] = Field(default_factory=list)

    @model_validator(mode="after")
    def _all_differ(self) -> Self:
        for what, names in (("run_id", [run.run_id for run in self.runs]), ("file", [run.file for run in self.runs])):
            twice = next((name for name in names if names.count(name) > 1), None)
            if twice is not None:
                raise ValueError(f"runs: {what} {twice!r} appears twice, expected different ones")
        if "campaign.json" in {run.file for run in self.runs} | {self.current_model.errors}:
            raise ValueError("runs: a file is named 'campaign.json', expected another name")
        return self


class PolynomialObject(FileObject):
    """value(x) = sum c_k (x - origin)^k, mm or rad."""

    kind: Literal["polynomial"]
    coefficients: Numbers
    origin_mm: float


class Tabulated(FileObject):
    """Values at positions; straight lines or one cubic spline (not-a-knot) in between, the end value outside."""

    kind: Literal["table"]
    position_mm: Numbers
    value: Numbers
    interpolation: Literal["linear", "cubic"]

    @model_validator(mode="after")
    def _equally_long(self) -> Self:
        if len(self.position_mm) != len(self.value):
            raise ValueError(f"expected as many values as positions, got {len(self.value)} and {len(self.position_mm)}")
        return self


class LegendreSeries(FileObject):
    """value(x) = sum c_k P_k(u), u from -1 to 1 over the stroke, mm or rad; the end value outside. An extension of the format by Abbe."""

    kind: Literal["legendre"]
    coefficients: Annotated[Numbers, Field(min_length=1)]
    stroke_mm: Interval


class Spline(FileObject):
    """B-spline, mm or rad, constant beyond knots[degree] and knots[number of coefficients]. An extension of the format by Abbe."""

    kind: Literal["bspline"]
    knots_mm: Numbers
    coefficients: Annotated[Numbers, Field(min_length=2)]
    degree: Annotated[int, Field(ge=1, le=9)]

    @model_validator(mode="after")
    def _knots_fit(self) -> Self:
        wanted = len(self.coefficients) + self.degree + 1
        if len(self.knots_mm) != wanted:
            raise ValueError(
                f"expected {wanted} knots for {len(self.coefficients)} coefficients of degree {self.degree}, got {len(self.knots_mm)}"
            )
        return self


ErrorFunction = Annotated[PolynomialObject | Tabulated | LegendreSeries | Spline, Field(discriminator="kind")]


class Squareness(FileObject):
    """Squareness of the axes, rad."""

    C0Y: float
    B0Z: float
    A0Z: float


class ErrorsFile(FileObject):
    """A machine's error functions (``abbe-errors/1``). Keys of ``motions``: component, or component@reverse."""

    format: Literal["abbe-errors/1"]
    squareness_rad: Squareness
    motions: dict[Annotated[str, Field(pattern="^E[XYZABC][XYZ](@reverse)?$")], ErrorFunction]
    covariance: FileObject | None = None
    not_observable: list[FileObject] = Field(default_factory=list)
