"""Declaration of a physical effect, for discovery, reports and the self-test. `models.discovery.residues` knows what resembles it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal

from abbe.models.arrays import F1, F2
from abbe.models.effects.path import Path

Values = Mapping[str, float]
"""Values of the non-linear parameters of an effect, by name."""
Signal = Callable[[tuple[Path, ...], str, Values], list[F2]]
"""Maps runs, key and non-linear parameters to one array (n, k) per run: mm per unit of each of k coefficients. Runs that cannot show the
effect get zeros."""
Family = Literal["drive", "structure", "thermal", "instrument", "geometry"]
Remedy = Literal["table", "control parameter", "mechanics", "warm up or sensor", "set-up"]
"""Way to remove an effect: a compensation table, a parameter of the control, a fitter's work, temperature control, a better set-up."""

PRIOR_SHARE = 0.3
"""Standard uncertainty of a non-linear parameter before any reading, as a share of its range, about as for a uniform distribution."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """A non-linear parameter: physical bounds, usual value and its source, and start values of the search."""

    name: str
    unit: str
    low: float
    high: float
    typical: float
    source: str
    starts: tuple[float, ...]

    @property
    def prior_sd(self) -> float:
        """Return the standard uncertainty of the parameter before any reading."""
        return PRIOR_SHARE * (self.high - self.low)


@dataclass(frozen=True, slots=True)
class Form:
    """A deviation of an effect from its textbook form: further columns that the search may add once the effect itself is found.

    ``signal`` takes the key and the non-linear parameters of the effect. A form is never reported as an effect of its own.
    """

    name: str
    signal: Signal


@dataclass(frozen=True)
class Effect:
    """A physical effect, with its first-order signal and the texts for its report.

    Attributes
    ----------
    name : str
        E.g. ``"backlash"``; the label is ``name:key`` or, without keys, the name alone.
    title : str
        The usual technical term, for people.
    family : Family
        Part of the machine to which the effect belongs.
    keys : tuple of str
        Axes, components or planes at which the effect may occur; ``("",)`` if it has no key.
    unit : str
        Unit of the strength: ``"um"``, ``"urad"``, ``"ms"``, ``"K"``, ``"K/h"`` or ``"mrad"``.
    per_unit : float
        The stated strength is ``strength(coefficients, values) / per_unit``.
    typical : tuple of float
        Usual range of the absolute strength, in ``unit``.
    shape : tuple of Parameter
        Non-linear parameters.
    signal : Signal
        Columns of the first-order reading.
    strength : function (coefficients (k,), non-linear values) -> float
        Signed strength in ``unit``: linear in the coefficients, or a norm of them.
    needs : str
        What a campaign must contain to show the effect.
    signature : str
        How the effect looks in the readings.
    remedy, remedy_text : Remedy, str
        Remedy in one word, and as advice to the operator.
    source : str
        Paper, standard or model behind it.
    forms : tuple of Form
    unseen : tuple of float
        Ratio of the whole strength to the strength of the columns, and its standard uncertainty. The ratio differs from 1 if the present
        model absorbs a part of the effect (e.g. the line of a straightness), or if a campaign ends before it (the slow part of a warm-up);
        the stated strength includes this part.
    kind : "mean" | "variance"
        Whether the effect shifts the readings or adds noise (stick-slip, vibration with an unknown phase, outliers). The columns of a
        "variance" effect are the extra variance of each reading, mm^2 per unit, and never negative. The search has a test of its own for
        each effect of this kind, so an effect from outside is of the kind "mean".
    one_sign : bool
        Whether all coefficients have the same sign, positive or negative: the set-ups share the law of the error, not its size.
    absorbed_by : tuple of str
        Entries of ``current_model.includes``: with any of them, the present model contains the effect, so that it is not a candidate.
    blind : tuple of str
        Tests that cannot show the effect.
    variant_of : str
        Name of a simpler effect that this effect contains. This effect replaces the simpler one only on clear evidence.
    beside : tuple of str
        Names of other effects. This effect is tried only if one of them was found at the same key; empty: always.
    separated_by : dict
        Maps a rival (name, or name:key) to the tests that separate the two (``next_test.adds``).
    """

    name: str
    title: str
    family: Family
    keys: tuple[str, ...]
    unit: str
    per_unit: float
    typical: tuple[float, float]
    shape: tuple[Parameter, ...]
    signal: Signal
    strength: Callable[[F1, Values], float]
    needs: str
    signature: str
    remedy: Remedy
    remedy_text: str
    source: str
    forms: tuple[Form, ...] = ()
    unseen: tuple[float, float] = (1.0, 0.0)
    kind: Literal["mean", "variance"] = "mean"
    one_sign: bool = False
    absorbed_by: tuple[str, ...] = ()
    blind: tuple[str, ...] = ()
    variant_of: str = ""
    beside: tuple[str, ...] = ()
    separated_by: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    def label(self, key: str) -> str:
        """Return ``name:key``, or the name alone if the key is empty."""
        return f"{self.name}:{key}" if key else self.name
