"""Declaration of an effect: everything that discovery, reports and self-test need."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal

from abbe.models.arrays import F1, F2
from abbe.models.effects.path import Path

Values = Mapping[str, float]
"""Non-linear parameters of an effect by name."""
Signal = Callable[[tuple[Path, ...], str, Values], list[F2]]
"""Columns of all runs for one key: one array (n, k) per path, mm per unit of each of k coefficients; zeros where the run is blind to it."""
Family = Literal["drive", "structure", "thermal", "instrument", "geometry"]
Remedy = Literal["table", "control parameter", "mechanics", "warm up or sensor", "set-up"]
"""Who can take it out: a static table, a parameter of the control, a fitter, temperature control, mounting the instrument anew."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """One non-linear parameter: physical bounds, usual range with its source, and starts of a search."""

    name: str
    unit: str
    low: float
    high: float
    typical: float
    source: str
    starts: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Form:
    """A freedom of form that belongs to an effect once it is there (a machine's backlash is not a textbook's): more columns, lower price.

    ``signal`` as of the effect, for its key and its non-linear parameters. Never a name of its own.
    """

    name: str
    signal: Signal


@dataclass(frozen=True)
class Effect:
    """One physical effect.

    Attributes
    ----------
    name : str
        Of run-format.md 5, e.g. ``"backlash"``; a label is ``name:key`` or, without keys, the name alone.
    title : str
        The field's term, for people.
    family : which part of the machine it belongs to.
    keys : tuple of str
        Axes, components or planes at which it may occur; ``("",)`` if there is only one.
    unit : str
        Of the strength: ``"um"``, ``"urad"``, ``"ms"``, ``"K"``, ``"K/h"`` or ``"mrad"`` (run-format.md 5).
    per_unit : float
        Coefficient (of the columns of ``signal``) per unit of strength, where the strength is ``strength(coefficients) / per_unit``.
    typical : tuple of float
        Usual range of the strength's size, its unit, with its ``source``.
    shape : tuple of Parameter
        Non-linear parameters.
    signal : Signal
        First-order reading. Exactly zero for zero coefficients; linear in them.
    strength : function (coefficients (k,), non-linear values) -> float
        Signed strength in ``unit``. The strength is linear or a norm of the coefficients.
    forms : tuple of Form
    unseen : tuple of float
        Whole strength over that of the columns, and its standard uncertainty, where the columns leave out what the present model absorbs
        of the effect (the line of a straightness); the stated strength includes it.
    kind : "mean" | "variance"
        Whether it moves the readings or makes them noisier (stick-slip, vibration with an unknown phase, outliers); a "variance" effect's
        ``signal`` says where: its columns are non-negative weights of the extra variance per reading.
    absorbed_by : tuple of str
        Entries of ``current_model.includes`` that make it part of the present model (then it is not a candidate).
    needs : what a campaign must contain to show it, for people. blind : tests that cannot show it.
    signature, remedy_text : for people: how it looks, what to do at the machine.
    remedy : part of the machine or control that can remove it.
    variant_of : str
        Name of a simpler effect that this one contains, with a freedom of its own; preferred only if the evidence is clear.
    separated_by : dict
        Rival (name, or name:key) -> what to add (``next_test.adds`` of run-format.md 5) to tell the two apart.
    source : paper, standard or effects.md section.
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
    absorbed_by: tuple[str, ...] = ()
    blind: tuple[str, ...] = ()
    variant_of: str = ""
    separated_by: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    def label(self, key: str) -> str:
        """``name:key``, or the name alone."""
        return f"{self.name}:{key}" if key else self.name
