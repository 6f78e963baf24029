"""Findings of a discovery, as they are stored, reported and drawn, and the arrays in them. Gaps in µm, predictions in mm."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Literal, Self

from pydantic import Field

from abbe.models.discovery.answer import Agreement, BlindSpot, Fitted, Localization, NextTest, Unjudged, Verdict
from abbe.service.domain.discovery_file import FoundThinning

if TYPE_CHECKING:
    from abbe.models.arrays import F1, F2

READINGS = "base64 of float32, little endian, mm"
MATRIX = "base64 of float64, little endian, lower triangle by rows"


@dataclass(frozen=True, slots=True, kw_only=True)
class PackedReadings:
    """Residuals or predictions of one run, mm; float32 keeps 7 digits: one nanometre in 10 mm."""

    n: int
    data: str
    encoding: str = READINGS

    @classmethod
    def of(cls, values_mm: F1) -> Self:
        """Pack readings, shape (n,)."""
        import numpy as np

        return cls(n=int(values_mm.size), data=base64.b64encode(np.asarray(values_mm, dtype="<f4").tobytes()).decode())

    @property
    def values_mm(self) -> F1:
        """The readings, shape (n,)."""
        import numpy as np

        return np.frombuffer(base64.b64decode(self.data), dtype="<f4").astype(np.float64)


@dataclass(frozen=True, slots=True, kw_only=True)
class PackedCovariance:
    """A symmetric matrix, its lower triangle only."""

    n: int
    data: str
    encoding: str = MATRIX

    @classmethod
    def of(cls, matrix: F2) -> Self:
        """Pack a symmetric matrix, shape (n, n)."""
        import numpy as np

        lower = np.asarray(matrix, dtype=np.float64)[np.tril_indices(len(matrix))]
        return cls(n=len(matrix), data=base64.b64encode(lower.astype("<f8").tobytes()).decode())

    @property
    def matrix(self) -> F2:
        """The matrix, shape (n, n)."""
        import numpy as np

        out = np.zeros((self.n, self.n))
        out[np.tril_indices(self.n)] = np.frombuffer(base64.b64decode(self.data), dtype="<f8")
        return np.asarray(out + np.tril(out, -1).T)


Kind = Literal["mean", "variance"]
"""Whether an effect moves the readings or makes them noisier."""
Location = Annotated[Localization, Field(alias="where")]
"""Location of a gap or an effect; its key in documents is ``where``."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GapUm:
    """Rms of measured minus predicted without and with the finding, and the noise that no model removes, µm."""

    before_um: float
    after_um: float
    floor_um: float

    @property
    def closed(self) -> float | None:
        """Closed share of the gap above the noise: 1 all, 0 nothing, below 0 worse; None if there was no gap."""
        if self.before_um <= self.floor_um:
            return None
        left = max(self.after_um - self.floor_um, 0.0) / (self.before_um - self.floor_um)
        return float(1.0 - left) if self.after_um > self.floor_um else 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class RunResidual:
    """One run: rms of its residuals without and with the finding, µm (None: sealed), and the noise of its instrument."""

    test: str
    role: str
    readings: int
    floor_um: float
    rms_before_um: float | None = None
    rms_after_um: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class ParameterFound:
    """A further parameter of an effect, with its standard uncertainty if known."""

    value: float
    u: float | None
    unit: str


@dataclass(frozen=True, slots=True, kw_only=True)
class RivalEffect:
    """Another effect that the runs cannot exclude, and by how much its log evidence (natural logarithm) is smaller."""

    label: str
    title: str
    less_evidence: float


@dataclass(frozen=True, slots=True, kw_only=True)
class EffectSize:
    """An effect with its size and its catalogue entry; findings and model books share it.

    ``coefficients``, ``covariance``: values for the effect's linear columns, in their units. ``forms``: names of the extra shape terms
    that it needed. ``needed``: rms of the judging runs without this effect, divided by their rms with it; None if no run judges.
    ``evidence``: gain in log evidence (natural logarithm), less the price of an additional effect.
    """

    label: str
    name: str
    key: str
    title: str
    family: str
    kind: Kind
    strength: float
    u_strength: float
    unit: str
    parameters: Mapping[str, ParameterFound] = field(default_factory=dict)
    forms: tuple[str, ...] = ()
    needed: float | None = None
    coefficients: tuple[float, ...] = ()
    covariance: PackedCovariance | None = None
    evidence: float = 0.0
    remedy: str
    remedy_text: str = ""
    source: str = ""
    location: Location = field(default_factory=Localization)

    @property
    def full_title(self) -> str:
        """Title and place (axis or motion)."""
        return f"{self.title} {self.key}".strip()


@dataclass(frozen=True, slots=True, kw_only=True)
class EffectFound(EffectSize):
    """An effect of a finding.

    ``proved``: whether runs that were never fitted confirm it; None: not judged. ``sensor_doubt``: why the temperature column of the
    warming part probably belongs to another part; empty without doubt.
    """

    alternatives: tuple[RivalEffect, ...] = ()
    signature: str = ""
    proved: bool | None = None
    sensor_doubt: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Unnamed:
    """An unnamed structure found beside named effects."""

    label: str
    evidence: float


@dataclass(frozen=True, slots=True, kw_only=True)
class RunSeries:
    """Series of one run, mm: the prediction with the finding, and the residuals without and with it (None: sealed)."""

    predicted: PackedReadings | None = None
    before: PackedReadings | None = None
    after: PackedReadings | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class RefittedModel:
    """Parameters of the present model, refitted together with the finding."""

    names: tuple[str, ...]
    values: tuple[float, ...]
    covariance: PackedCovariance


@dataclass(frozen=True, slots=True, kw_only=True)
class ChangeRival:
    """Another change that explains nearly as much, and by how much its log evidence (natural logarithm) is smaller."""

    name: str
    less_evidence: float


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionChange:
    """An error motion that has changed. ``part``: linear (scale, squareness), or the shape, whose rms over the stroke is the value.

    ``u``: standard uncertainty; ``rivals``: changes that these runs cannot distinguish from it; ``halves``: number of halves of the runs
    (0 to 2) in which a separate search finds the change.
    """

    motion: str
    part: Literal["linear", "shape"]
    value: float
    u: float
    unit: Literal["um/m", "urad", "um"]
    evidence: float = 0.0
    rivals: tuple[ChangeRival, ...] = ()
    halves: int


@dataclass(frozen=True, slots=True, kw_only=True)
class ChangedSince:
    """Changes of the machine since an earlier solution.

    ``gap``, ``judged``: None if too few set-ups judge. ``judged``: natural logarithm of the factor by which the changes raise the
    likelihood of runs that were not used to find them. ``hidden_um_m``: possible undetected change of each scale and squareness.
    ``beside``: effects found in the same runs that may have the same cause. ``proved``: whether runs that were not used to find the changes
    confirm them. ``trouble``: why nothing could be compared.
    """

    since: int
    changes: tuple[MotionChange, ...] = ()
    gap: GapUm | None = None
    judged: float | None = None
    hidden_um_m: Mapping[str, float] = field(default_factory=dict)
    proved: bool = False
    beside: tuple[str, ...] = ()
    trouble: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """The stored result of a discovery.

    Attributes
    ----------
    case : name of the campaign.
    gaps : by role of the runs.
    effects : confirmed or unjudged. suspects : names that fit the fitted runs but are not confirmed by the judging runs; then the verdict
        is "unknown".
    proved, proof : whether runs that were never fitted confirm the names, and by which rule.
    location : where the gap of the present model shows (tests, axes, places, times).
    rejected : labels that were tried, and the reason against each.
    confounded_with : rivals that the evidence does not exclude.
    beside : unnamed structures beside the named effects.
    agreement : how runs that were never fitted agree with their prediction, if nothing is missing.
    unjudged, unseen : runs that cannot be judged, and blind spots, if nothing is missing.
    fitted : parameters of the present simulation that these runs measure.
    doubt : what is probably wrong with the data of the runs of ``location``; then no effect was searched for.
    left_out : gap of the fitted runs on blocks that are left out in turn; None if holdout runs judge.
    thinning : decimation of long runs before the search; None: they were searched as they were read.
    predictions : of sealed runs, mm.
    changed : changes since an earlier solution, if one could be compared.
    """

    format: Literal["abbe-finding/1"] = "abbe-finding/1"
    case: str = ""
    verdict: Verdict
    p_value: float = 1.0
    noise_um: Mapping[str, float] = field(default_factory=dict)
    gaps: Mapping[str, GapUm] = field(default_factory=dict)
    left_out: GapUm | None = None
    runs: Mapping[str, RunResidual] = field(default_factory=dict)
    effects: tuple[EffectFound, ...] = ()
    suspects: tuple[EffectFound, ...] = ()
    proved: bool = False
    proof: str = ""
    location: Location = field(default_factory=Localization)
    next_test: NextTest | None = None
    rejected: tuple[tuple[str, str], ...] = ()
    confounded_with: tuple[str, ...] = ()
    beside: tuple[Unnamed, ...] = ()
    agreement: tuple[Agreement, ...] = ()
    unjudged: tuple[Unjudged, ...] = ()
    unseen: tuple[BlindSpot, ...] = ()
    fitted: tuple[Fitted, ...] = ()
    doubt: str = ""
    thinning: FoundThinning | None = None
    predictions: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    series: Mapping[str, RunSeries] = field(default_factory=dict)
    model: RefittedModel | None = None
    changed: ChangedSince | None = None
