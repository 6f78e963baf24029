"""Result of a discovery, in mm, rad and s; the service writes it as JSON (docs/schemas/discovery.schema.json) and as text."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:  # lists of stored results parse these records, and need no arrays
    from abbe.models.arrays import F1, F2

Verdict = Literal["none", "named", "unknown"]


@dataclass(frozen=True)
class Significance:
    """Result of one localization test, with family-wise p-value. ``kind``: "run", "test", "axis", "direction", "feed", "time", "position",
    "frequency", "temperature" or "instrument"; ``value``: which run, axis, ... as text."""

    kind: str
    value: str
    statistic: float
    p: float


@dataclass(frozen=True)
class Localization:
    """Location of a gap or an effect; None or empty: not located in this respect. The fields are those of ``where`` in
    docs/schemas/discovery.schema.json. ``shape``: shape of the deviation, as text. ``table``: all tests."""

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
    """One named effect.

    Attributes
    ----------
    name, key : name in the catalogue; axis or error motion that it concerns.
    strength, u_strength : strength and standard uncertainty in the effect's unit (um, urad, ms, K, K/h, mrad), signed where a sign has
        meaning.
    parameters : non-linear parameters by name, (value, standard uncertainty); the uncertainty is NaN if it is unknown.
    coefficients, covariance : linear coefficients of the effect's columns and their covariance; column times coefficient is mm.
    evidence : gain in log evidence (half the chi-square) after the price of the effect.
    alternatives : rivals that the data cannot exclude, (label, missing log evidence), best first.
    location : where its signal is largest.
    forms : deviations from the effect's formula that were added (`abbe.models.effects.effect.Form`), by name.
    needed : rms of the holdout runs without this effect, divided by their rms with it; 1 or less: not needed. None: no holdout run, or
    the effect is a variance effect, which changes no mean reading.
    sensor_doubt : why the temperature column of the warming part probably belongs to another part; empty if there is no doubt.
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
    location: Localization = field(default_factory=Localization)
    forms: tuple[str, ...] = ()
    needed: float | None = None
    sensor_doubt: str = ""

    @property
    def label(self) -> str:
        """Label of the effect: ``name:key``, or the name alone without a key."""
        return f"{self.name}:{self.key}" if self.key else self.name


@dataclass(frozen=True)
class NextTest:
    """Proposed measurement, ``adds`` as in docs/schemas/discovery.schema.json. ``separates``: labels of the suspects that it separates; for
    a structure without a name, possible causes. Expected separation: None if unknown. ``like``: the run to repeat or vary, if any."""

    adds: tuple[str, ...]
    separates: tuple[str, ...]
    expected_separation_sigma: float | None
    minutes: float
    why: str
    like: str = ""


@dataclass(frozen=True)
class Gap:
    """Rms residual of one role's runs without and with the found effects, and the noise floor, mm."""

    before_mm: float
    after_mm: float
    floor_mm: float


@dataclass(frozen=True)
class Fitted:
    """A significant error that the present simulation already includes: ``name``, ``key``, value and standard uncertainty in ``unit``."""

    name: str
    key: str
    value: float
    u: float
    unit: str


@dataclass(frozen=True)
class BlindSpot:
    """A blind spot of a campaign: ``what`` its runs cannot show, why (``because``), and the measurement that could show it (``adds``)."""

    what: str
    because: str
    adds: str


@dataclass(frozen=True)
class Agreement:
    """Agreement of one holdout run with the simulation.

    Attributes
    ----------
    run : label of the run.
    times : rms of its residuals (or of their block sums, if worse) over the rms expected from noise and prediction uncertainty.
    p : p-value, family-wise over all holdout runs of the campaign.
    """

    run: str
    times: float
    p: float


@dataclass(frozen=True)
class Unjudged:
    """A holdout run that cannot be judged: its label, and ``why``."""

    run: str
    why: str


@dataclass(frozen=True)
class Discovery:
    """Complete result of one discovery.

    Attributes
    ----------
    verdict : "none": the present model explains the runs; "named": named effects are missing; "unknown": something is missing that the
        catalogue does not explain.
    effects : the named effects, strongest evidence first.
    rejected : labels found but not named, each with the reason: structures without a name, effects of less evidence, residues of effects.
    beside : structures without a name that explain a further part of the gap besides the named effects, (label, evidence), strongest first.
    confounded_with : rivals of the named effects that the data do not exclude.
    location : location of the gap of the present model (for "unknown": of the structure without a name).
    gaps : gap of the runs of each role ("identify", "holdout").
    alone : the result without any effect; only for named effects with a ``p_value`` of `abbe.models.discovery.lack.CHANCE` or more.
    left_out : gap of the fitted runs, each predicted without its block (`abbe.models.discovery.agreement`); None if there are holdout runs.
    residual_before_mm, residual_after_mm : residuals without and with the effects, by run label.
    predicted_before_mm, predicted_mm : predictions without and with the effects, by run label; also of sealed runs.
    noise_mm : noise of one reading of "bar" and "laser"; from repeats where these scatter less than the fit's residuals.
    p_value : p-value of the whole finding.
    theta, theta_names, theta_covariance : unknowns of the present simulation, fitted together with the effects.
    agreement : how holdout runs agree with their prediction, if nothing was found; the worst first.
    unjudged : holdout runs that cannot be judged.
    unseen : blind spots of the runs, if nothing was found.
    fitted : significant errors that the present simulation already includes (the scale of a single axis).
    doubt : probable fault in the data of the runs in ``location``, as text; if there is one, no effect was searched.
    """

    verdict: Verdict
    effects: tuple[NamedEffect, ...]
    location: Localization
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
    unseen: tuple[BlindSpot, ...] = ()
    fitted: tuple[Fitted, ...] = ()
    doubt: str = ""
    left_out: Gap | None = None
    alone: Discovery | None = None
