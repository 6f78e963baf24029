"""Describe structures without a name (deviations that no effect of the catalogue explains) and propose experiments for them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from abbe.models.discovery.answer import Localization, NextTest
from abbe.models.discovery.case import Case
from abbe.models.discovery.experiment.additions import BAR_MIN, LASER_MIN, RUN_MIN, WAIT_MIN, offers
from abbe.models.discovery.generic.unnamed_structures import PREFIX, is_unnamed, location_of
from abbe.models.discovery.selection import Selection
from abbe.models.discovery.variance.scatter_effects import VarianceFinding
from abbe.models.discovery.whitened_problem import WhitenedProblem
from abbe.models.effects.path import Path

TITLES = {
    "unnamed_burst": "short disturbance of the reading",
    "unnamed_place": "readings of the laser off near one place",
    "unnamed_rough": "readings of the ball-bar that scatter more at one place",
}
"""Titles of the variance structures."""
INSTRUMENTS = {"bar": "ball-bar", "laser": "laser"}
REPEATS = 3
"""Number of repeats of a run in one set-up."""
PERIODS = 10
"""Number of periods for which an instrument is read at standstill."""


@dataclass(frozen=True)
class Structure:
    """A structure without a name; ``title``: its kind as text."""

    label: str
    title: str
    evidence: float
    location: Localization


def structures(case: Case, found: Sequence[Selection], loud: Sequence[VarianceFinding]) -> tuple[Structure, ...]:
    """Return the structures without a name among mean effects (``found``) and variance effects (``loud``), strongest evidence first."""
    out = [
        Structure(f.pick.label, f.pick.effect.title, f.score / 2.0, location_of(f.pick.effect, f.pick.key, f.pick.values, case))
        for f in found
        if f.pick.unnamed
    ]
    out += [Structure(f.label, TITLES[f.name], f.evidence, f.location) for f in loud if is_unnamed(f.name)]
    return tuple(sorted(out, key=lambda s: (-s.evidence, s.label)))


def wandering(problem: WhitenedProblem) -> tuple[Structure, ...]:
    """Return the instruments with unusually autocorrelated noise, as unnamed structures without axis, place and period."""
    out = []
    for kind, colour in problem.colours.items():
        if colour.gain > 0.0:
            tests = tuple(dict.fromkeys(p.test for p in problem.paths if p.kind == kind))
            over = 1.0 / (1.0 - colour.memory)
            title = (
                f"noise of the {INSTRUMENTS[kind]} is not white:"
                f" {colour.share:.0%} of its variance is correlated over about {over:.0f} readings"
            )
            out.append(Structure(f"{PREFIX}wander:{kind}", title, colour.gain, Localization(tests, depends_on=("time",), shape=title)))
    return tuple(out)


def lacking(location: Localization) -> Structure:
    """Return a lack of fit (`abbe.models.discovery.lack`) as a structure without a name."""
    axis = f":{location.axes[0]}" if len(location.axes) == 1 else ""
    if location.shape:
        return Structure(f"{PREFIX}smooth{axis}", location.shape, 0.0, location)
    return Structure(f"{PREFIX}place{axis}", "residuals larger than noise", 0.0, location)


def describe_structure(structure: Structure, *, beside: bool) -> str:
    """Return e.g. ``evidence 144, without a name: step of one axis, at 870 to 930 s``; ``beside``: named effects were found too."""
    parts = [f"evidence {structure.evidence:.0f}, without a name: {structure.title}", *_place(structure.location)]
    return ", ".join(parts) + ("; the named effects do not explain this part of the gap" if beside else "")


def _place(location: Localization) -> list[str]:
    out = []
    if location.time_s is not None:
        out.append(f"at {location.time_s[0]:.0f} to {location.time_s[1]:.0f} s")
    if location.position_mm is not None:
        x, y, z = location.position_mm
        out.append(f"around X {x:.0f} Y {y:.0f} Z {z:.0f} mm")
    if location.period_s is not None:
        out.append(f"period {location.period_s:.1f} s")
    if location.period_mm is not None:
        out.append(f"pitch {location.period_mm:.1f} mm")
    if location.angular_lobes is not None:
        out.append(f"{location.angular_lobes} lobes")
    return out


@dataclass(frozen=True)
class _Plan:
    """Experiment for a kind of structure: the first addition of ``adds`` that the campaign lacks. If the campaign has all of them, the last
    is proposed again (with ``always``), or else a repetition of the run. ``between``: the two causes that the experiment separates;
    ``why``: text with ``{run}`` and ``{standstill}``."""

    adds: tuple[str, ...]
    between: tuple[str, str]
    why: str
    always: bool = False


_AGAIN = _Plan(
    ("longer_session",),
    ("something of the machine", "something of that session"),
    f"measure {{run}} again later, {REPEATS} times in one undisturbed set-up: if the deviation recurs, it belongs to the machine, "
    "otherwise to that session",
)
_PERIOD = _Plan(
    ("second_feed",),
    ("a wave in time", "a wave over the position"),
    "at another feed, a wave in time keeps its period in seconds, a wave over the position keeps it in millimetres; reading the instrument "
    "at standstill{standstill} shows whether the wave needs motion",
)
_BUMP = _Plan(
    ("second_radius",),
    ("a place of the machine", "a moment of that run"),
    "a denser path with another bar whose sphere passes through the same place: a deviation that recurs there belongs to the place",
    always=True,
)
_LOBES = _Plan(
    ("ballbar",),
    ("a ball of the bar", "the machine"),
    "measure {run} again with the bar turned a quarter about its length, or with another ball in the cup: lobes that change belong to the "
    "ball",
    always=True,
)
_SMOOTH = _Plan(
    ("single_axis_laser", "laser_diagonals", "planar_circles", "second_radius"),
    ("the axis", "the way it was measured"),
    "the same axis by other means: an error of the axis shows in both",
)
_ODD = _Plan(
    ("opposite_direction", "single_axis_laser", "planar_circles"),
    ("the direction of motion", "the order of the readings"),
    "the same positions from the other side: if the direction is the cause, the deviation changes its sign again",
)
_BEAT = replace(_AGAIN, why=f"{_AGAIN.why}; reading the instrument at standstill{{standstill}} shows whether it needs motion")
_STANDSTILL = _Plan(
    ("longer_session",),
    ("the instrument", "the machine"),
    "read the instrument at standstill for as long as {run} took: if the reading wanders there too, the cause is the instrument, its "
    "mounting or the air",
    always=True,
)
_PLANS = {
    "step": _AGAIN, "slip": _AGAIN, "settling": _AGAIN, "burst": _AGAIN, "place": _AGAIN, "surge": _PERIOD, "wave": _PERIOD,
    "bump": _BUMP, "lobes": _LOBES, "smooth": _SMOOTH, "odd": _ODD,
    "rough": _LOBES, "wander": _STANDSTILL,
}  # fmt: skip


def propose_unnamed(case: Case, structures: Sequence[Structure]) -> NextTest | None:
    """Propose the measurement that would show the cause of the strongest structure without a name.

    Parameters
    ----------
    structures : strongest evidence first (`abbe.models.discovery.unnamed.structures`).

    Returns
    -------
    NextTest or None
        None without structures. ``separates`` names two possible causes. The expected separation is unknown, because it is unknown how the
        structure continues elsewhere.
    """
    if not structures:
        return None
    kind = structures[0].label.partition(":")[0].removeprefix(PREFIX)
    like = _like(case, structures[0])
    open_ = {o.adds: o.minutes for o in offers(case)}
    plan, adds = _chosen(kind, like, set(open_))
    minutes = _repeat_minutes(like) if adds == "longer_session" else open_.get(adds, _once_minutes(like))
    period = structures[0].location.period_s
    standstill = "" if period is None else f" for {PERIODS * period:.0f} s"
    why = plan.why.format(run=f"run {like.label}", standstill=standstill)
    return NextTest((adds,), plan.between, None, float(minutes), why, like.label)


def _chosen(kind: str, like: Path, open_: set[str]) -> tuple[_Plan, str]:
    """Return the plan for a kind of structure, and the addition to propose, out of those that the campaign lacks (``open_``)."""
    plan = _PLANS[kind]
    adds = next((a for a in plan.adds if a in open_), None)
    if kind == "bump" and like.kind != "bar":  # the plan needs a ball-bar
        return _AGAIN, "longer_session"
    if adds is None and plan.always:
        return plan, plan.adds[-1]
    if adds is None:
        plan = _BEAT if kind == "surge" else _AGAIN
        return plan, "longer_session"
    return plan, adds


def _like(case: Case, structure: Structure) -> Path:
    """Choose the run to repeat, of those that show the structure: a helix (runs unattended), else a circle, else any; nearest in time."""
    paths = [r.path for r in case.of("identify", "holdout")]
    location = structure.location
    shown = [p for p in paths if p.label in location.runs] or paths
    if location.time_s is not None:
        middle = 0.5 * sum(location.time_s)
        shown = sorted(shown, key=lambda p: max(float(p.at.t_s[0]) - middle, middle - float(p.at.t_s[-1]), 0.0))
    return next((p for kind in ("ballbar_helix", "ballbar_circle") for p in shown if p.test == kind), shown[0])


def _run_minutes(like: Path) -> float:
    return float(np.ptp(like.at.t_s)) / 60.0 + RUN_MIN


def _once_minutes(like: Path) -> float:
    return (BAR_MIN if like.kind == "bar" else LASER_MIN) + _run_minutes(like)


def _repeat_minutes(like: Path) -> float:
    """Minutes for the wait, one set-up and `REPEATS` runs."""
    return WAIT_MIN + _once_minutes(like) + (REPEATS - 1) * _run_minutes(like)
