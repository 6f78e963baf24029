"""Find readings under the wrong label: two runs that fit if their readings are exchanged, or one that fits if its readings are reversed.

Also find tools whose stated vector has the wrong sign in one component. Both precede the search for effects, because exchanged readings
resemble hysteresis, lags and lost motion of several axes. A wrong sign of the tool or of a pivot that all runs share changes no reading:
the error motions along the axes absorb its effect on the rotations.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations, islice

import numpy as np

from abbe.models.arrays import F1
from abbe.models.discovery.baseline import baseline_of
from abbe.models.discovery.whitened_problem import WhitenedProblem, whiten
from abbe.models.effects.path import Path
from abbe.models.machine import AXES

REMAINS = 0.6
"""Readings count as mixed up only if their correction leaves less than this share of the misfit of the whole campaign."""
ALONE = 0.5
"""Readings count as mixed up only if no correction of other runs explains this share of what the best correction explains."""
AT_ONCE = 16
"""Number of corrections tried together; all pairs of 26 runs would take 300 MB."""
SAME_MM = 0.5
"""Tool vectors that differ by less are one tool; for a component below this size no wrong sign is searched."""
EXCESS = 0.4
"""A tool's sign counts as wrong only if its correction leaves less than this share of the misfit above the noise."""
CLEAR = 60.0
"""A tool's sign counts as wrong only if its correction lowers chi-square by more than this."""


@dataclass(frozen=True)
class MixedUp:
    """Runs with wrong readings, the kind of mistake (``how``), and the share of the campaign's misfit that remains after its correction."""

    runs: tuple[str, ...]
    how: str
    remains: float


def mixed_up(problem: WhitenedProblem) -> MixedUp | None:
    """Find the runs of a problem whose readings are exchanged or reversed; None if no correction explains most of the misfit.

    ``problem``: whitened differences between readings and present simulation, before any search.
    """
    projection, changes = problem.projection, _tried(problem)
    tried, left = list[tuple[tuple[str, ...], str]](), list[float]()
    while some := list(islice(changes, AT_ONCE)):
        columns = problem.white(np.column_stack([change for _, _, change in some]))
        y = projection.y[:, None] + columns
        coordinates = projection.y_coordinates[:, None] + projection.coordinates(columns)
        left += (((y * y).sum(axis=0) - (coordinates * coordinates).sum(axis=0)) / max(projection.chi2, 1e-300)).tolist()
        tried += [(runs, how) for runs, how, _ in some]
    if not tried:
        return None
    best = int(np.argmin(left))
    runs, how = tried[best]
    others = [v for v, (names, _) in zip(left, tried, strict=True) if not set(names) & set(runs)]
    if left[best] > REMAINS or 1.0 - min(others, default=1.0) > ALONE * (1.0 - left[best]):
        return None
    return MixedUp(runs, how, left[best])


def _tried(problem: WhitenedProblem) -> Iterator[tuple[tuple[str, ...], str, F1]]:
    """Yield runs, their supposed mistake, and the change of all stacked readings, mm, that corrects it."""
    ends = np.cumsum(problem.lengths)
    at = [slice(end - n, end) for n, end in zip(problem.lengths, ends, strict=True)]
    read = [r.data().deviation_mm for r in problem.runs]
    for k, run in enumerate(problem.runs):
        change = np.zeros(problem.gap.size)
        change[at[k]] = read[k][::-1] - read[k]
        yield (run.path.label,), "in the reverse order", change
    for i, j in combinations(range(len(at)), 2):
        one, other = problem.runs[i].path, problem.runs[j].path
        if one.n == other.n and one.kind == other.kind:
            change = np.zeros(problem.gap.size)
            change[at[i]], change[at[j]] = read[j] - read[i], read[i] - read[j]
            yield (one.label, other.label), "exchanged", change


def wrong_tool(problem: WhitenedProblem) -> MixedUp | None:
    """Find the tool that explains most of the misfit if one component of its vector changes sign; None if none does.

    If two tools explain the misfit equally, both are named: reversed tool vectors with reversed rotations give the same readings. A
    campaign with a single tool is not judged. ``problem``: as for `mixed_up`. Every tool and component is tried by a new fit of the
    simulation.
    """
    tools = {_tool(p) for p in problem.paths}
    noise, plain = float(problem.use @ (1.0 - problem.projection.leverage)), _misfit(problem, problem)
    if len(tools) < 2 or plain - noise < CLEAR:
        return None
    tried = {(t, a): _misfit(_turned(problem, t, a), problem) for t in tools for a in range(3) if abs(t[a]) > 1}
    if not tried:
        return None
    least, axis = min((left, a) for (_, a), left in tried.items())
    alike = {t for (t, a), left in tried.items() if a == axis and left < least + CLEAR}
    others = min((left for (t, a), left in tried.items() if t not in alike), default=plain)
    if plain - least < CLEAR or least - noise > EXCESS * (plain - noise) or plain - others > ALONE * (plain - least):
        return None
    runs = tuple(p.label for p in problem.paths if _tool(p) in alike)
    return MixedUp(
        runs, f"taken with {'a tool' if len(alike) < 2 else 'tools'} whose tool_mm has the wrong sign in {AXES[axis]}", least / plain
    )


def _tool(path: Path) -> tuple[float, ...]:
    return tuple(np.round(path.machine.tool_mm / SAME_MM).tolist())


def _turned(problem: WhitenedProblem, tool: tuple[float, ...], axis: int) -> WhitenedProblem:
    """Return the problem with one component of a tool's vector negated, in all runs with this tool."""
    sign = np.where(np.arange(3) == axis, -1.0, 1.0)
    runs = []
    for run in problem.case.runs:
        machine = run.path.machine
        if _tool(run.path) == tool:
            machine = replace(machine, tool_mm=sign * machine.tool_mm)
        runs.append(replace(run, path=replace(run.path, machine=machine)))
    case = replace(problem.case, runs=tuple(runs))
    return whiten(case, baseline_of(case))


def _misfit(problem: WhitenedProblem, scale: WhitenedProblem) -> float:
    """Chi-square of a problem's residuals with the noise of the problem ``scale``."""
    left = problem.projection.residual * problem.sd_mm() / scale.sd_mm()
    return float((scale.use * left) @ left)
