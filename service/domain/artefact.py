"""Artefacts and runs of their points in the exchange formats; also the source of docs/schemas/artefact-run.schema.json."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from abbe.service.domain.machine import FileObject, Name, Point, RunFileHead

ARTEFACT_TEST = "artefact_points"
MACHINE_PROBE = "machine-probe"
SQUARE = 1e-6
"""Largest deviation of a stated matrix from a rotation, per component."""


def _check_rotation(matrix: tuple[Point, Point, Point]) -> tuple[Point, Point, Point]:
    a, b, c = matrix
    for i, one in enumerate(matrix):
        for k, two in enumerate(matrix):
            if abs(sum(p * q for p, q in zip(one, two, strict=True)) - (i == k)) > SQUARE:
                raise ValueError("expected a rotation: rows of length 1, perpendicular to each other")
    cross = (b[1] * c[2] - b[2] * c[1], b[2] * c[0] - b[0] * c[2], b[0] * c[1] - b[1] * c[0])
    if sum(p * q for p, q in zip(a, cross, strict=True)) < 0.0:
        raise ValueError("expected a rotation, got a reflection: exchange two rows or change a sign")
    return matrix


class Touched:
    """A feature of the artefact, or the qualification sphere (``u_sphere_mm`` is not None), that is or was touched."""

    __slots__ = ()
    feature: str
    u_sphere_mm: float | None

    @property
    def qualifies(self) -> bool:
        """Whether this is the qualification sphere."""
        return self.u_sphere_mm is not None

    @property
    def what(self) -> str:
        """Its name, for people."""
        return f"{'qualification sphere' if self.qualifies else 'feature'} {self.feature}"


class PoseObject(FileObject):
    """Stated pose of an artefact: axis position = origin + matrix times nominal place."""

    origin_mm: Point
    matrix: Annotated[tuple[Point, Point, Point], AfterValidator(_check_rotation)]


class Feature(FileObject):
    """One hole, ball or wall: nominal place and sensed axes of the artefact; for a wall, its outward normal; for probing, its radius."""

    id: Name
    nominal_mm: Point
    sensed: Literal["x", "y", "z", "xy", "xz", "yz", "xyz"] = "xyz"
    normal: Point | None = None
    radius_mm: float | None = Field(None, gt=0.0)


class CalibratedLength(FileObject):
    """Distance of two features from a certificate, with expanded uncertainty U = k u."""

    from_: str = Field(alias="from")
    to: str
    length_mm: float = Field(gt=0.0)
    U_mm: float = Field(ge=0.0)
    k: float = Field(2.0, gt=0.0)
    temperature_C: float = 20.0  # noqa: N815


class Obstacle(FileObject):
    """A box beside the features that the probe must not meet, such as a clamp or a wall: two corners in the artefact's axes."""

    id: Name
    low_mm: Point
    high_mm: Point

    @model_validator(mode="after")
    def _a_box(self) -> Self:
        if any(low >= high for low, high in zip(self.low_mm, self.high_mm, strict=True)):
            raise ValueError(f"obstacle {self.id}: every coordinate of low_mm must be below the same coordinate of high_mm")
        return self


class QualificationSphere(FileObject):
    """A sphere that is fixed on the table: axis position at which the stylus tip is at its centre, and its radius with U = k u."""

    id: Name
    centre_mm: Point
    radius_mm: float = Field(gt=0.0)
    U_mm: float = Field(ge=0.0)
    k: float = Field(2.0, gt=0.0)


class ArtefactObject(FileObject):
    """A plate, bar or workpiece with its features and known lengths; ``obstacles``: other objects beside them."""

    kind: str
    features: list[Feature]
    expansion_per_K: float = 11.5e-6  # noqa: N815
    u_expansion_per_K: float = 1e-6  # noqa: N815
    reference_temperature_C: float = 20.0  # noqa: N815
    calibrated_lengths: list[CalibratedLength] = Field(default_factory=list)
    obstacles: list[Obstacle] = Field(default_factory=list)

    @model_validator(mode="after")
    def _known(self) -> Self:
        names = [f.id for f in self.features]
        twice = next((n for n in names if names.count(n) > 1), None)
        if twice is not None:
            raise ValueError(f"features: id {twice!r} appears twice, expected different ones")
        for one in self.calibrated_lengths:
            for end in (one.from_, one.to):
                if end not in names:
                    raise ValueError(f"calibrated_lengths: no feature has the id {end!r}")
        return self


class ArtefactSetupObject(FileObject):
    """Position of the artefact, and the sensor that found its points.

    ``tool_radius_mm``: radius of cutter or stylus, stated or measured on a qualification sphere; ``u_tool_radius_mm``: standard uncertainty
    of a measured radius.
    """

    setup_id: str
    t_set_s: float
    artefact: Name
    source: Literal["machine-probe", "workpiece-on-cmm"]
    tool_mm: Point
    pose: PoseObject
    tool_radius_mm: float | None = Field(None, gt=0.0)
    u_tool_radius_mm: float | None = Field(None, ge=0.0)


Numbers = list[float]
Sensed = list[float | None]
Signs = list[Literal[-1, 0, 1]]


class PointColumns(FileObject):
    """Points, one list per column, all of the same length; a direction that was not sensed is null."""

    t_s: Numbers
    x_mm: Numbers
    y_mm: Numbers
    z_mm: Numbers
    feature: list[Name]
    deviation_x_mm: Sensed
    deviation_y_mm: Sensed
    deviation_z_mm: Sensed
    u_mm: list[Annotated[float, Field(gt=0.0)]]
    temperature_C: Sensed | None = None  # noqa: N815
    touch_start_deg: Sensed | None = None
    from_x: Numbers | None = None
    from_y: Numbers | None = None
    from_z: Numbers | None = None
    valid: list[Literal[0, 1]] | None = None


class ArtefactRunFile(RunFileHead):
    """One run of an artefact's points (``abbe-run/1``, test ``artefact_points``)."""

    test: Literal["artefact_points"]
    setup: ArtefactSetupObject
    columns: PointColumns
