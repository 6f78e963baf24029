"""What a discovery has found, as it is stored, reported and drawn. Gaps in µm, predictions in mm."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from abbe.models.discovery.answer import Agreement, Fitted, Localization, NextTest, Unjudged, Unseen, Verdict
from abbe.service.domain.discovery_file import FoundThinning
from abbe.service.domain.packed_arrays import PackedCovariance, PackedReadings

Kind = Literal["mean", "variance"]
"""Whether an effect moves the readings or makes them noisier."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GapUm:
    """Rms of measured minus predicted before and after what was found, and the noise that no model takes out, µm."""

    before_um: float
    after_um: float
    floor_um: float

    @property
    def closed(self) -> float | None:
        """Share of the gap above the noise that is gone: 1 to the noise, 0 nothing, below 0 worse; None where there was no gap."""
        if self.before_um <= self.floor_um:
            return None
        left = max(self.after_um - self.floor_um, 0.0) / (self.before_um - self.floor_um)
        return float(1.0 - left) if self.after_um > self.floor_um else 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class RunFit:
    """One run: rms of its residuals before and after, µm (None: sealed), and the noise of its instrument."""

    test: str
    role: str
    readings: int
    floor_um: float
    rms_before_um: float | None = None
    rms_after_um: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class ParameterFound:
    """A further parameter of an effect, with its standard uncertainty where one is known."""

    value: float
    u: float | None
    unit: str


@dataclass(frozen=True, slots=True, kw_only=True)
class RivalEffect:
    """Another effect that the runs cannot exclude, and by how much less evidence (natural logarithm) it explains them."""

    label: str
    title: str
    less_evidence: float


@dataclass(frozen=True, slots=True, kw_only=True)
class EffectSize:
    """An effect with its size, and what its catalogue entry says of it; findings and model books hold the same.

    ``coefficients`` and ``covariance``: linear ones, in the units of the effect's columns. ``forms``: freedoms of form that it needed.
    ``needed``: rms of the judging runs without this effect over that with it, None where nothing judges. ``evidence``: gain in log
    evidence after its price.
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
    where: Localization = field(default_factory=Localization)

    @property
    def words(self) -> str:
        """Title and where it sits."""
        return f"{self.title} {self.key}".strip()


@dataclass(frozen=True, slots=True, kw_only=True)
class EffectFound(EffectSize):
    """An effect of a finding. ``proved``: runs that were never fitted confirm it; None while nobody has asked them."""

    alternatives: tuple[RivalEffect, ...] = ()
    signature: str = ""
    proved: bool | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Unnamed:
    """A structure without a name that was found beside named effects."""

    label: str
    evidence: float


@dataclass(frozen=True, slots=True, kw_only=True)
class RunSeries:
    """Of one run, mm: the prediction with what was found, and the residuals before and after (None: sealed)."""

    predicted: PackedReadings | None = None
    before: PackedReadings | None = None
    after: PackedReadings | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class RefittedModel:
    """Parameters of the present model, refitted together with what was found."""

    names: tuple[str, ...]
    values: tuple[float, ...]
    covariance: PackedCovariance


@dataclass(frozen=True, slots=True, kw_only=True)
class ChangeRival:
    """Another change that explains nearly as much: natural logarithm of how much less likely it is."""

    name: str
    less_evidence: float


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionChange:
    """An error motion that has changed. ``part``: linear (scale, squareness), or the shape, whose rms over the stroke is the value.

    ``u``: standard uncertainty; ``rivals``: what these runs cannot tell it from; ``halves``: by how many of two halves of the runs it was
    chosen without the other.
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
    """What has changed since an earlier solution.

    ``gap``, ``judged``: None where too few set-ups judge; ``judged``: log of how much more likely runs are with what they did not choose;
    ``hidden_um_m``: how much each scale and squareness may have changed all the same; ``beside``: effects that were found in the same runs
    and may be the same thing; ``proved``: runs that did not choose the changes bear them out; ``trouble``: why nothing could be compared.
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
    """Everything that is kept of a discovery.

    Attributes
    ----------
    case : name of the campaign.
    gaps : by role of the runs.
    effects : what is stood by. suspects : names that fit the fitted runs and that the judging runs do not confirm; then the verdict is
        "unknown".
    proved, proof : whether runs that were never fitted confirm the names, and by which rule.
    where : where the gap of the present model lives.
    rejected : labels that were tried, and why not.
    confounded_with : rivals of the names that the price rule does not exclude. beside : structures without a name beside them.
    agreement, unjudged, unseen : of runs that were never fitted, where nothing is missing.
    fitted : values of the present simulation that these runs show.
    thinning : what became of long runs before the search; None: they were searched as they were read.
    predictions : of sealed runs, mm.
    changed : what has changed since an earlier solution, where one could be compared.
    """

    format: Literal["abbe-finding/1"] = "abbe-finding/1"
    case: str = ""
    verdict: Verdict
    p_value: float = 1.0
    noise_um: Mapping[str, float] = field(default_factory=dict)
    gaps: Mapping[str, GapUm] = field(default_factory=dict)
    runs: Mapping[str, RunFit] = field(default_factory=dict)
    effects: tuple[EffectFound, ...] = ()
    suspects: tuple[EffectFound, ...] = ()
    proved: bool = False
    proof: str = ""
    where: Localization = field(default_factory=Localization)
    next_test: NextTest | None = None
    rejected: tuple[tuple[str, str], ...] = ()
    confounded_with: tuple[str, ...] = ()
    beside: tuple[Unnamed, ...] = ()
    agreement: tuple[Agreement, ...] = ()
    unjudged: tuple[Unjudged, ...] = ()
    unseen: tuple[Unseen, ...] = ()
    fitted: tuple[Fitted, ...] = ()
    thinning: FoundThinning | None = None
    predictions: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    series: Mapping[str, RunSeries] = field(default_factory=dict)
    model: RefittedModel | None = None
    changed: ChangedSince | None = None
