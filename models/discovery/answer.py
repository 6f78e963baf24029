"""What a discovery found, in mm, rad and s; the border turns it into the answer of run-format.md 5 and into words."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from abbe.models.arrays import F1, F2

Verdict = Literal["none", "named", "unknown"]


@dataclass(frozen=True)
class Significance:
    """One test of where the gap lives: ``kind`` ("run", "test", "axis", "direction", "feed", "time", "position", "frequency",
    "temperature", "instrument"), ``value`` (which one, for people), statistic, and family-wise p-value."""

    kind: str
    value: str
    statistic: float
    p: float


@dataclass(frozen=True)
class Where:
    """Where a gap or an effect lives. None or empty: not located in that respect. Fields as in run-format.md 5 ``where``;
    ``shape``: what it looks like there, for people."""

    tests: tuple[str, ...] = ()
    axes: tuple[str, ...] = ()
    directions: tuple[int, ...] = ()
    runs: tuple[str, ...] = ()
    time_s: tuple[float, float] | None = None
    position_mm: tuple[float, float, float] | None = None
    radius_mm: float | None = None
    period_s: float | None = None
    period_mm: float | None = None
    angular_lobes: int | None = None
    depends_on: tuple[str, ...] = ()
    shape: str = ""
    table: tuple[Significance, ...] = ()


@dataclass(frozen=True)
class NamedEffect:
    """One effect that was named.

    Attributes
    ----------
    name, key : of the catalogue.
    strength, u_strength : in the unit of run-format.md 5 (um, urad, ms, K, K/h, mrad), signed where a sign has meaning.
    parameters : non-linear ones by name with their standard uncertainty, (value, u); u is NaN where none is known.
    coefficients, covariance : linear ones, in the units of the effect's columns.
    evidence : gain in log evidence (half the chi-square) after its price.
    alternatives : rivals the data cannot exclude, by evidence, (label, how much less evidence).
    where : where its signal is largest.
    forms : freedoms of form that it needed.
    needed : rms of the runs that only judge without this effect over that with it, all else as it is: 1 or less, and they do not need it.
        None: nothing judges, or it moves no reading.
    """

    name: str
    key: str
    strength: float
    u_strength: float
    parameters: Mapping[str, tuple[float, float]]
    coefficients: F1
    covariance: F2
    evidence: float
    alternatives: tuple[tuple[str, float], ...] = ()
    where: Where = field(default_factory=Where)
    forms: tuple[str, ...] = ()
    needed: float | None = None

    @property
    def label(self) -> str:
        """``name:key``."""
        return f"{self.name}:{self.key}" if self.key else self.name


@dataclass(frozen=True)
class NextTest:
    """What to measure next: ``adds`` of run-format.md 5, which suspects it separates (labels; of a structure without a name, what it may
    be, in words), expected separation (None: not known) and time it takes; ``like``: the run that is measured again or varied, if one is
    meant."""

    adds: tuple[str, ...]
    separates: tuple[str, ...]
    expected_separation_sigma: float | None
    minutes: float
    why: str
    like: str = ""


@dataclass(frozen=True)
class Gap:
    """Rms of one role's residuals over its noise floor before and after, and the three in mm: rms_before, rms_after, floor."""

    before_mm: float
    after_mm: float
    floor_mm: float


@dataclass(frozen=True)
class Fitted:
    """A value of the present simulation that these runs show: ``name`` and ``key``, value and standard uncertainty in ``unit``."""

    name: str
    key: str
    value: float
    u: float
    unit: str


@dataclass(frozen=True)
class Unseen:
    """What a campaign cannot show: ``what`` it is, ``because`` of what, the addition of run-format.md 5 that would show it."""

    what: str
    because: str
    adds: str


@dataclass(frozen=True)
class Agreement:
    """How one run that was never fitted agrees with the simulation.

    Attributes
    ----------
    run : its label.
    times : rms of its residual, or of sums over its neighbouring readings where that tells more, over what noise and the prediction's own
        uncertainty allow; about 1 is agreement.
    p : how often runs that agree would give one that is as far off, over all such runs of the campaign together.
    """

    run: str
    times: float
    p: float


@dataclass(frozen=True)
class Unjudged:
    """One run that was never fitted and that nothing can be said of: its label, and ``why``."""

    run: str
    why: str


@dataclass(frozen=True)
class Discovery:
    """Everything one discovery found.

    Attributes
    ----------
    verdict : "none": the present model explains the runs; "named"; "unknown": something is missing that the catalogue does not explain.
    effects : in order of evidence. rejected : labels that were tried and why not, for the protocol: structures without a name, names beside
        an unknown, what another effect's formula leaves.
    beside : structures without a name found beside names, (label, evidence), by evidence: what of the gap they close is not the names'.
    confounded_with : rivals of the names that the price rule does not exclude.
    where : where the gap of the present model lives (for "unknown": where the missing thing lives).
    gaps : by role ("identify", "holdout").
    residual_before_mm, residual_after_mm, predicted_mm, predicted_before_mm : by run label; predictions also of sealed runs.
    noise_mm : one reading of each run's instrument, by "bar", "laser"; of repeats where they say less than what the fit left.
    p_value : of the whole finding (how often noise alone gives as much).
    theta, theta_names, theta_covariance : the refitted model without the effects.
    agreement : of runs that only judge, where nothing was found; the worst first. unjudged : those of them that cannot be judged.
    unseen : where nothing was found: what these runs could not have shown.
    fitted : what the present simulation took up that people want to know (the scale of a single axis): not missing, and yet there.
    """

    verdict: Verdict
    effects: tuple[NamedEffect, ...]
    where: Where
    next_test: NextTest | None
    gaps: Mapping[str, Gap]
    residual_before_mm: Mapping[str, F1]
    residual_after_mm: Mapping[str, F1]
    predicted_mm: Mapping[str, F1]
    predicted_before_mm: Mapping[str, F1]
    noise_mm: Mapping[str, float]
    p_value: float
    theta_names: tuple[str, ...]
    theta: F1
    theta_covariance: F2
    rejected: tuple[tuple[str, str], ...] = ()
    confounded_with: tuple[str, ...] = ()
    beside: tuple[tuple[str, float], ...] = ()
    agreement: tuple[Agreement, ...] = ()
    unjudged: tuple[Unjudged, ...] = ()
    unseen: tuple[Unseen, ...] = ()
    fitted: tuple[Fitted, ...] = ()
