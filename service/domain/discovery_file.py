"""The answer of a discovery (``abbe-discovery/1``) as pydantic models: what `abbe discover --json` writes."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from abbe.models.discovery.answer import Fitted
from abbe.service.domain.machine import FileObject

Adds = Literal[
    "second_feed",
    "opposite_direction",
    "second_radius",
    "planar_circles",
    "laser_diagonals",
    "ballbar",
    "single_axis_laser",
    "angular_interferometer",
    "second_tool_length",
    "longer_session",
    "reference_length",
    "judging_run",
]


class FoundEffect(FileObject):
    """One named effect. ``parameters``: ``strength`` and its standard uncertainty ``u_strength`` in the effect's unit, and further ones.

    ``proved``: whether runs that were never fitted confirm the effect. ``sensor_doubt``: why the temperature column of the warming part
    probably belongs to another part.
    """

    name: str
    key: str
    parameters: dict[str, float]
    evidence: float
    alternatives: list[str]
    proved: bool | None = None
    sensor_doubt: str = ""


class FoundBeside(FileObject):
    """An unnamed structure beside named effects, e.g. ``unnamed_step:Z``."""

    label: str
    evidence: float


class FoundLocation(FileObject):
    """Location, time and variables of the missing effect; unknown fields are left out."""

    tests: list[str] = Field(default_factory=list)
    axes: list[str] = Field(default_factory=list)
    directions: list[int] = Field(default_factory=list)
    time_s: tuple[float, float] | None = None
    position_mm: tuple[float, float, float] | None = None
    radius_mm: float | None = None
    period_s: float | None = None
    period_mm: float | None = None
    angular_lobes: int | None = None
    depends_on: list[str] = Field(default_factory=list)
    shape: str = Field(default="", description="its shape, for people")


class FoundTest(FileObject):
    """The next measurement that the search proposes."""

    adds: list[Adds]
    plan: dict[str, object] | None = None
    minutes: float | None = None
    expected_separation_sigma: float | None = None
    like: str | None = None


class FoundAgreement(FileObject):
    """Test of a run that was never fitted. ``times``: rms divided by the allowed rms; ``p``: probability of so large an rms by chance."""

    run: str
    times: float = Field(ge=0)
    p: float = Field(ge=0, le=1)


class FoundUnseen(FileObject):
    """With the verdict "none": an effect that the campaign could not have shown, the reason, and the measurement that would show it."""

    what: str
    because: str
    adds: Adds


class FoundThinning(FileObject):
    """Decimation: long ball-bar runs were searched with fewer values than readings; effects hidden by this may still be present."""

    readings: int
    kept: int
    readings_per_value: int
    how: Literal["means", "picked"]
    interval_s: float
    highest_hz: float
    values_with_reversal: int
    unobservable: list[str] = Field(alias="not_seen")


class FoundLeftOut(FileObject):
    """Cross-validation if there are no holdout runs: rms residual, µm, of blocks of readings, each predicted by a fit to the other blocks.

    All blocks took part in choosing the names.
    """

    before_um: float = Field(ge=0)
    after_um: float = Field(ge=0)
    floor_um: float = Field(ge=0)


class DiscoveryFile(FileObject):
    """Effects that a campaign's simulation lacks, and the predictions of sealed runs, mm.

    ``effects``: named effects that are claimed. ``suspects``: names that fit the fitted runs but that the judging runs do not confirm;
    then the verdict is "unknown". ``proved``: whether the judging runs confirm the effects; ``proof``: the rule of this judgement, or
    why they cannot judge.
    """

    format: Literal["abbe-discovery/1"]
    case: str
    verdict: Literal["named", "none", "unknown"]
    effects: list[FoundEffect]
    suspects: list[FoundEffect] = Field(default_factory=list)
    proved: bool = False
    proof: str = ""
    confounded_with: list[str] = Field(default_factory=list)
    beside: list[FoundBeside] = Field(default_factory=list)
    location: FoundLocation = Field(alias="where")
    next_test: FoundTest | None = None
    agreement: list[FoundAgreement] = Field(default_factory=list)
    unseen: list[FoundUnseen] = Field(default_factory=list)
    fitted: list[Fitted] = Field(default_factory=list)
    doubt: str = ""
    thinning: FoundThinning | None = None
    rms_before_um: float | None = Field(None, ge=0)
    rms_after_um: float | None = Field(None, ge=0)
    holdout_rms_um: float | None = Field(None, ge=0)
    left_out: FoundLeftOut | None = None
    noise_floor_um: float | None = Field(None, ge=0)
    predictions: dict[str, list[float]]


Model = Literal["absolute", "since_start"]


class StandstillRms(FileObject):
    """Rms residual over all runs, µm, each run predicted from all others: without a model, with a model without lag, with lag."""

    raw: float = Field(ge=0)
    static: float = Field(ge=0)
    response: float = Field(ge=0)


class StandstillPrediction(FileObject):
    """Predicted displacement of every reading and its standard uncertainty, mm."""

    predicted_mm: list[float]
    u_mm: list[float]


class StandstillLeftOut(StandstillPrediction):
    """A fitted run, predicted from all others."""

    run: str


class StandstillSensor(FileObject):
    """Displacement per kelvin of one sensor, at once and after the lag, µm/K, with standard uncertainties."""

    sensor: str
    at_once_um_k: float = Field(alias="at_once_um_K")
    u_at_once_um_k: float = Field(alias="u_at_once_um_K", ge=0)
    settled_um_k: float = Field(alias="settled_um_K")
    u_settled_um_k: float = Field(alias="u_settled_um_K", ge=0)


class StandstillShift(FileObject):
    """Runs in a row, first to last, that are off by more than chance explains: size and standard uncertainty, µm, and p-value."""

    model: Model
    first: str
    last: str
    um: float
    u_um: float = Field(ge=0)
    p: float = Field(ge=0, le=1)


class StandstillFile(FileObject):
    """The part of a machine's displacement at standstill that temperatures explain (ISO 230-3).

    ``runs``: fitted runs in order of time. ``covered``: share of readings of left-out runs within U (k = 2) of their prediction. ``model``:
    the better predictor: temperatures as they are, or their changes since the start of a run. ``predictions``: predicted runs, which
    were not fitted.
    """

    format: Literal["abbe-standstill/1"]
    case: str
    runs: list[str]
    rms_um: StandstillRms
    covered: float = Field(ge=0, le=1)
    left_out: list[StandstillLeftOut]
    model: Model
    time_constant_s: float = Field(gt=0)
    u_time_constant_s: float = Field(ge=0)
    sensitivities: list[StandstillSensor]
    shifts: list[StandstillShift]
    predictions: dict[str, StandstillPrediction]
