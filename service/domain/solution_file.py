"""A solution (``abbe-solution/1``): what `abbe solve --json` prints, the store keeps and every reader of a stored solution works with."""

from __future__ import annotations

import base64
from collections.abc import Iterable
from typing import Literal

import numpy as np
from pydantic import Field, ValidationError

from abbe.models.arrays import F1, F2
from abbe.models.geometry.bases import Term
from abbe.service.domain.document import Doc
from abbe.service.domain.machine import FileObject, MachineObject, Point
from abbe.service.errors import Unusable

Status = Literal["observed", "weak", "not observable"]
Digest = str


class Versions(FileObject):
    """Versions of the programs that solved the campaign."""

    abbe: str
    numpy: str
    scipy: str
    revision: str | None = None


class TableInForce(FileObject):
    """A compensation table that runs were measured with: CRC-32 of its image; whether the controller reported that it acts."""

    crc: int
    acting: bool | None = None


def distinct(tables: Iterable[Doc]) -> list[TableInForce]:
    """Return the tables of runs, sorted by CRC. ``acting``: whether the table corrects, as the controller states; None in older runs."""
    acting: dict[int, bool | None] = {}
    for table in tables:
        crc, acts = int(table["crc"]), table.get("acting")
        acting[crc] = acting.get(crc) if acts is None else bool(acts)
    return [TableInForce(crc=crc) if (acts := acting[crc]) is None else TableInForce(crc=crc, acting=acts) for crc in sorted(acting)]


class Inputs(FileObject):
    """SHA-256 digests of each run's data, of the machine's geometry, and of all inputs with the model; and the tables in force."""

    digest: Digest
    machine: Digest = ""
    runs: dict[str, Digest]
    tables: list[TableInForce] = Field(default_factory=list)


class ParameterValue(FileObject):
    """One unknown: value and standard uncertainty in mm, rad or mm/s; share of its information that comes from the readings."""

    value: float
    u: float
    data_share: float
    status: Status


class MeanValue(FileObject):
    """Mean over the volume: mm/mm for scales, rad for squareness."""

    value: float
    u: float


class MotionValue(FileObject):
    """One error motion over its stroke: rms standard uncertainty, mm or rad; reason why it gets no table of its own, or empty."""

    status: Status
    u: float
    data_share: float
    reason: str


class Rank(FileObject):
    """Number of singular values above 1e-9 and 1e-3 of the largest, and number of coefficients."""

    rank: int
    of: int
    effective_rank: int


class ObservabilityNumber(FileObject):
    """Factor by which these runs can reduce the error of a typical machine, at the worst place and at the median place."""

    number: float
    median: float
    verdict: Literal["good", "usable with care", "mostly assumption"]
    text: str


class CorrelationValue(FileObject):
    """Two parameters with correlated errors."""

    first: str
    second: str
    r: float


class RunResult(FileObject):
    """Fit of one run, µm."""

    readings: int
    rms_um: float
    expected_um: float
    outliers: int


class NoiseFound(FileObject):
    """Standard deviation of one reading, µm, as estimated with the solution and from repeats alone (null: nothing was repeated)."""

    sigma_um: float
    repeats_um: float | None


class OutlierFound(FileObject):
    """A reading that counts less: size in standard deviations, weight 0 to 1.

    ``index``: number of the value in the solution, from 0; ``rows``: first and last row of the run's columns, from 1, that went into it.
    """

    run: str
    index: int
    rows: list[int] = Field(default_factory=list)
    t_s: float | None = None
    size_sigma: float
    weight: float


class ResidualTestResult(FileObject):
    """One test of one run's residuals; ``text``: the finding, empty if nothing was found."""

    run: str
    test: str
    statistic: float
    p: float
    p_adjusted: float
    flagged: bool
    text: str


class WorstPoint(FileObject):
    """Point with the most uncertain deviation: components and their uncertainties, µm; half-axis of the 95 % region of the vector."""

    at_mm: Point
    deviation_um: Point
    u_um: Point
    expanded_um: Point
    expanded_vector_um: float


class BudgetLineValue(FileObject):
    """One source of uncertainty, rms over the volume, and its share of the variance.

    ``type``: how its size was found, A from readings, B stated or assumed (GUM 4.2, 4.3); ``dof``: its degrees of freedom, null for a
    stated size. Both are absent in solutions of earlier versions.
    """

    source: str
    text: str = Field(alias="words")
    u_um: float
    share: float
    type: Literal["A", "B"] | None = None
    dof: float | None = None


class WithoutScale(FileObject):
    """The map without the scales that are the largest part of its uncertainty: the common scale, or the scale of each axis.

    ``error_um``: rms of the deviation; ``rms_um``: rms of its standard uncertainty; ``expanded_vector_um``: 95 % limit of the vector at
    the worst point.
    """

    scales: Literal["common", "axes"]
    error_um: float
    rms_um: float
    expanded_vector_um: float
    compensable_share: float


class Uncertainty(FileObject):
    """Uncertainty of the predicted deviation over the volume.

    ``compensable_share``: share of the volume where the error exceeds its uncertainty. ``without_scale``: what is known without the scales,
    if they are the largest part of the uncertainty.
    """

    frame: str
    worst_point: WorstPoint
    rms_um: float
    budget: list[BudgetLineValue]
    compensable_share: float
    without_scale: WithoutScale | None = None


class VerdictValue(FileObject):
    """Usability of the solution, its limits, and the best that the layout of the campaign allows."""

    word: Literal["good", "usable with care", "mostly assumption"]
    text: str
    reasons: list[str]
    layout: str


ENCODING = "base64 of float64, little endian, lower triangle by rows"


class PackedMatrix(FileObject):
    """A symmetric matrix: ``data`` is base64 of its lower triangle by rows, float64, little endian."""

    encoding: str
    shape: list[int]
    data: str

    @classmethod
    def packed(cls, matrix: F2) -> PackedMatrix:
        """Pack the lower triangle of a symmetric matrix."""
        lower = matrix[np.tril_indices(len(matrix))]
        return cls(encoding=ENCODING, shape=list(matrix.shape), data=base64.b64encode(lower.astype("<f8").tobytes()).decode())

    def unpacked(self) -> F2:
        """Return the whole matrix."""
        n = self.shape[0]
        out = np.zeros((n, n))
        out[np.tril_indices(n)] = np.frombuffer(base64.b64decode(self.data), dtype="<f8")
        return out + np.tril(out, -1).T


class StoredPrediction(FileObject):
    """Coefficients with their full uncertainty, from which predictions can be repeated.

    Deviation at points = field @ coefficients, covariance = field @ covariance @ field^T, where field holds the deviation per unit of each
    term (`abbe.models.geometry.volume.unit_deviation`, with the machine's tool and the requested frame).

    ``terms``: motion, Legendre order, axis (0 to 2) and component (0 to 2 translation, 3 to 5 rotation) of each; ``coefficients`` in mm or
    rad; ``scatter_mm``: standard deviation that a single approach of a point adds per component.
    """

    terms: list[tuple[str, int, int, int]]
    coefficients: list[float]
    covariance: PackedMatrix
    scatter_mm: float

    def unpacked(self) -> tuple[tuple[Term, ...], F1, F2]:
        """Return the terms, their coefficients and the covariance of these."""
        return tuple(Term(*t) for t in self.terms), np.asarray(self.coefficients, dtype=np.float64), self.covariance.unpacked()


class TableRow(FileObject):
    """Errors of distances that remain when a kind of table is used, over the inner 80 % of every stroke, µm, with standard uncertainties.

    ``entries``: count of numbers in the table. ``q95_um``: 95 % of the errors are below. ``unknown_um``: rms of the part that no table
    can remove.
    """

    kind: str
    entries: int
    rms_um: float
    u_rms_um: float
    q95_um: float
    u_q95_um: float
    max_um: float
    u_max_um: float
    unknown_um: float


class MonteCarloCheck(FileObject):
    """GUM Supplement 1 at the worst point: half-widths of the 95 % intervals per component, µm, as stated and by trials."""

    trials: int
    at_mm: Point
    stated_um: Point
    found_um: Point
    valid: list[bool]
    settled: bool
    text: str


class MachineModel(FileObject):
    """Version of the machine's model, its effects that were removed from the readings, and those that no table corrects."""

    version: int
    removed: list[str] = Field(alias="taken_out")
    not_for_tables: list[str]


class LostMotion(FileObject):
    """Lost motion of an axis, mm, with its standard uncertainty."""

    value: float
    u: float


class TableRemoval(FileObject):
    """The table in force during the runs, whose side effects were subtracted from the readings, and the lost motion used for that."""

    crc: int | None = None
    lost_motion_mm: dict[str, LostMotion]


class SolutionFile(FileObject):
    """A solved campaign (``abbe-solution/1``). Every ``u`` is a standard uncertainty (k = 1); ``expanded_um`` has 95 % coverage.

    ``solution_id``, ``run_ids`` and ``same_as`` (earlier solutions of the same readings and model) are present in a stored solution.
    """

    format: Literal["abbe-solution/1"]
    model: str = Field(description="model key: model/basis and order, and who chose the order")
    order: int
    versions: Versions
    inputs: Inputs
    parameters: dict[str, ParameterValue]
    mean_over_volume: dict[str, MeanValue]
    mean_over_volume_note: str
    holds_at: str | None = Field(default=None, description="scales' temperature at which solution and tables hold")
    reached_mm: dict[str, tuple[float, float]] = Field(
        default_factory=dict, description="lowest and highest position of each axis in the runs; the map beyond rests on the prior"
    )
    motions: dict[str, MotionValue]
    rank: Rank
    rough: list[str] = Field(
        default_factory=list,
        description="error motions with short parts that the smooth model does not follow: size, length or period, spacing of a table",
    )
    artefacts: list[str] = Field(
        default_factory=list,
        description="errors that the poses of an artefact hide, the pose that would show them; separate fit of each workpiece",
    )
    not_observable: list[str]
    advice: list[str]
    observability: ObservabilityNumber
    correlations: list[CorrelationValue]
    chi2: float
    dof: float
    variance_factor: float
    runs: dict[str, RunResult]
    noise: dict[str, NoiseFound]
    outliers: list[OutlierFound]
    residual_tests: list[ResidualTestResult]
    flags: list[str]
    uncertainty: Uncertainty
    verdict: VerdictValue | None = None
    prediction: StoredPrediction | None = None
    tables: list[TableRow] | None = None
    monte_carlo: MonteCarloCheck | None = None
    ten_parameter_helix: dict[str, dict[str, MeanValue]]
    ten_parameter_helix_note: str
    step_diagonals: dict[str, dict[str, float]]
    step_diagonals_note: str
    machine_model: MachineModel | None = None
    table_removal: TableRemoval | None = Field(default=None, alias="table_taken_out")
    table_not_removed: str | None = Field(
        default=None, alias="table_not_taken_out", description="why the side effects of a table in force are still in the readings"
    )
    campaign: str | None = None
    machine: MachineObject | None = None
    solution_id: int | None = None
    run_ids: list[int] | None = None
    same_as: list[int] | None = None


def stored_solution(doc: object, number: int) -> SolutionFile:
    """The document of a stored solution.

    Raises
    ------
    Unusable
        Another version of Abbe stored the solution in another form.
    """
    try:
        return SolutionFile.read(doc)
    except ValidationError:
        raise Unusable(
            f"solution {number} is not in the format abbe-solution/1: another version of Abbe stored it", "solve the campaign again"
        ) from None
