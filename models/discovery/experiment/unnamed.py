"""Experiments for a structure without a name: the measurement that would show its cause, by the kind of structure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from abbe.models.discovery.answer import NextTest
from abbe.models.discovery.case import Case
from abbe.models.discovery.experiment.candidates import BAR_MIN, LASER_MIN, RUN_MIN, WAIT_MIN, offers
from abbe.models.discovery.generic.unnamed_structures import PREFIX
from abbe.models.discovery.unnamed import Structure
from abbe.models.effects.path import Path

REPEATS = 3
"""Runs of a repeat in one set-up."""
PERIODS = 10
"""Periods for which an instrument is read at standstill."""


@dataclass(frozen=True)
class _Plan:
    """``adds``: what is proposed, the first that the campaign does not hold; ``always``: the last one can be proposed even if it does, else
    the run is repeated; ``between``: what it tells apart; ``why``: for people, ``{run}``, ``{standstill}`` filled in."""

    adds: tuple[str, ...]
    between: tuple[str, str]
    why: str
    always: bool = False


_AGAIN = _Plan(
    ("longer_session",),
    ("something of the machine", "something of that session"),
    f"{{run}} again, later, {REPEATS} times in one set-up that nobody touches: what comes back belongs to the machine, what does not "
    "belonged to that session",
)
_BEAT = replace(_AGAIN, why=f"{_AGAIN.why}; the instrument read at standstill{{standstill}} tells whether it needs motion")
_PERIOD = _Plan(
    ("second_feed",),
    ("a period of time", "a period of position"),
    "at another feed a period of time keeps its seconds, one of position its millimetres; the instrument read at standstill{standstill} "
    "tells whether it needs motion",
)
_BUMP = _Plan(
    ("second_radius",),
    ("a place of the machine", "a moment of that run"),
    "a denser path with another bar, whose sphere passes through the same place: what is there again belongs to the place",
    always=True,
)
_LOBES = _Plan(
    ("ballbar",),
    ("a ball of the bar", "the machine"),
    "{run} again with the bar turned a quarter about its length, or with another ball in the cup: lobes that go with it are the ball's",
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
    "the same places from the other side: what turns its sign with the direction turns again",
)
_PLANS = {
    "step": _AGAIN, "slip": _AGAIN, "settling": _AGAIN, "burst": _AGAIN, "place": _AGAIN, "surge": _PERIOD, "wave": _PERIOD,
    "bump": _BUMP, "lobes": _LOBES, "smooth": _SMOOTH, "odd": _ODD,
}  # fmt: skip


def propose_unnamed(case: Case, structures: Sequence[Structure]) -> NextTest | None:
    """The measurement that would show what the strongest structure without a name is.

    Parameters
    ----------
    structures : by evidence (`abbe.models.discovery.unnamed.structures`).

    Returns
    -------
    NextTest or None
        None without structures. ``separates`` says in words what it may be. How far the two come apart is not known: nobody knows what
        the structure would do elsewhere, so there are no sigmas.
    """
    if not structures:
        return None
    kind = structures[0].label.partition(":")[0].removeprefix(PREFIX)
    like = _like(case, structures[0])
    open_ = {o.adds: o.minutes for o in offers(case)}
    plan, adds = _chosen(kind, like, set(open_))
    minutes = _repeat_minutes(like) if adds == "longer_session" else open_.get(adds, _once_minutes(like))
    period = structures[0].where.period_s
    standstill = "" if period is None else f" for {PERIODS * period:.0f} s"
    why = plan.why.format(run=f"run {like.label}", standstill=standstill)
    return NextTest((adds,), plan.between, None, float(minutes), why, like.label)


def _chosen(kind: str, like: Path, open_: set[str]) -> tuple[_Plan, str]:
    """The plan for a kind of structure and what it adds; where that is there already, a repeat."""
    plan = _PLANS[kind]
    adds = next((a for a in plan.adds if a in open_), None)
    if kind == "bump" and like.kind != "bar":  # no sphere to pass through the place
        return _AGAIN, "longer_session"
    if adds is None and plan.always:
        return plan, plan.adds[-1]
    if adds is None:
        plan = _BEAT if kind == "surge" else _AGAIN
        return plan, "longer_session"
    return plan, adds


def _like(case: Case, structure: Structure) -> Path:
    """The run that is measured again: of those that show it a helix, if there is one, for a machine does that alone; near its moment."""
    paths = [r.path for r in case.of("identify", "holdout")]
    where = structure.where
    shown = [p for p in paths if p.label in where.runs] or paths
    if where.time_s is not None:
        middle = 0.5 * sum(where.time_s)
        shown = sorted(shown, key=lambda p: max(float(p.at.t_s[0]) - middle, middle - float(p.at.t_s[-1]), 0.0))
    return next((p for kind in ("ballbar_helix", "ballbar_circle") for p in shown if p.test == kind), shown[0])


def _run_minutes(like: Path) -> float:
    return float(np.ptp(like.at.t_s)) / 60.0 + RUN_MIN


def _once_minutes(like: Path) -> float:
    return (BAR_MIN if like.kind == "bar" else LASER_MIN) + _run_minutes(like)


def _repeat_minutes(like: Path) -> float:
    """A wait, one set-up, the repeats."""
    return WAIT_MIN + _once_minutes(like) + (REPEATS - 1) * _run_minutes(like)
