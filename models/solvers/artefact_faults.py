"""Faults in the measurement of an artefact: exchanged features, a pose that is a quarter turn off, an artefact that moved, a false
trigger, a wrong radius, a part that twists. Each fault is named, and corrected if the readings determine the correction."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from abbe.models.arrays import F1
from abbe.models.solvers.artefact import LETTERS, ArtefactPoints, step_columns
from abbe.models.solvers.artefact_shares import form_amounts
from abbe.models.solvers.components import KINDS
from abbe.models.solvers.engine import CampaignFit, CampaignProblem, Score
from abbe.models.solvers.joint import JointSolution
from abbe.models.solvers.observability.poses import NAMED, SWIRL
from abbe.models.solvers.observations import RunData

Settle = Callable[[tuple[RunData, ...]], tuple[CampaignProblem, CampaignFit]]
OTHER_PLACE_MM = 1.0
"""A feature found farther than this from its nominal place is taken for the feature whose nominal place is there, if there is one."""
NOISY, STRONG = 4.0, 25.0
"""`NOISY`: poses are doubted if their points scatter by this multiple of the repeatability. `STRONG`: least gain of log evidence that
proves a fault.
"""
STEP_MM, STEP_RAD = 0.02, 1e-4
"""Prior size of a motion of the artefact during a run."""
QUIETER, GROSS_SIGMA = 1.5, 50.0
"""`QUIETER`: a run is split if the split divides the scatter of its points by this factor or more. `GROSS_SIGMA`: largest size, in
standard deviations, with which one point counts in this scatter."""
DOUBTED = 0.5
"""A point whose robust weight is below this is doubted."""
STEPS = np.array([STEP_MM] * 3 + [STEP_RAD] * 3)
FALSE_TRIGGER_MM, FALSE_TRIGGERS = 0.01, 3
"""A point that is off by more than `FALSE_TRIGGER_MM` is a false trigger, unless the run has more than `FALSE_TRIGGERS` such points."""
MOST = 0.3
"""Least share of an artefact's form that the rotation growing with r^2 must explain, for a twist to be named."""
RADIUS_MM, TWIST_MM, SIGMA = 8e-3, 6e-3, 4.0
"""Smallest error of the radius and smallest twist that are named; number of standard uncertainties by which they must differ from zero."""


@dataclass(frozen=True, slots=True)
class ArtefactFault:
    """A fault of one run and its correction, as text."""

    run: str
    what: str
    done: str


def undone(runs: tuple[RunData, ...], settle: Settle) -> tuple[tuple[RunData, ...], list[ArtefactFault]]:
    """Return the runs with exchanged features, quarter turns and motions corrected, and the faults; ``settle`` solves runs."""
    runs, found = relabelled(runs)
    problem, fit = settle(runs)
    for _ in range(len(runs)):
        if _noise(fit) < NOISY:
            break
        turned = _quarter_turn(runs, fit, settle)
        if turned is None:
            break
        runs, problem, fit, fault = turned
        found.append(fault)
    for _ in range(len(runs)):
        stepped = _step(problem, fit)
        if stepped is None:
            break
        parted, label = stepped
        parted, new_problem, new = _moved_step(parted, *settle(parted), label, settle)
        if _scatter(problem, fit, label) < QUIETER * _scatter(new_problem, new, label):  # rough motions of the machine look like steps, too
            break
        runs, problem, fit = parted, new_problem, new
        found.append(_motion(problem, fit, label))
    return runs, found


def relabelled(runs: tuple[RunData, ...]) -> tuple[tuple[RunData, ...], list[ArtefactFault]]:
    """Give points that were found at the place of another feature the name of that feature."""
    known = {f: n for r in runs if r.points for f, n in zip(r.points.feature, r.points.nominal_mm, strict=True)}
    names, places = list(known), np.array(list(known.values())).reshape(-1, 3)
    out, found = [], []
    for run in runs:
        p = run.points
        if p is None or p.source == "length" or np.abs(run.deviation_mm).max() < OTHER_PLACE_MM:
            out.append(run)
            continue
        feature, nominal, deviation, wrong = list(p.feature), p.nominal_mm.copy(), run.deviation_mm.copy(), set[str]()
        for rows in _points(run):
            k = p.component[rows]
            at = nominal[rows[0], k] + deviation[rows]
            nearest = int(np.argmin(np.linalg.norm(places[:, k] - at, axis=1)))
            if np.linalg.norm(places[nearest, k] - at) < OTHER_PLACE_MM and names[nearest] != feature[rows[0]]:
                wrong |= {names[nearest], feature[rows[0]]}
                deviation[rows] = at - places[nearest, k]
                for row in rows:
                    feature[row], nominal[row] = names[nearest], places[nearest]
        out.append(replace(run, deviation_mm=deviation, points=replace(p, feature=tuple(feature), nominal_mm=nominal)))
        if wrong:
            found.append(ArtefactFault(run.label, f"the labels of features {' and '.join(sorted(wrong))} are exchanged", "exchanged back"))
    return tuple(out), found


def _points(run: RunData) -> list[np.ndarray[tuple[int], np.dtype[np.intp]]]:
    """Rows of each point: same feature at the same time."""
    assert run.points is not None
    keys = [(f, float(t)) for f, t in zip(run.points.feature, run.t_s, strict=True)]
    return [np.array([i for i, key in enumerate(keys) if key == one]) for one in dict.fromkeys(keys)]


def _noise(fit: CampaignFit) -> float:
    """Scatter of points as a multiple of their stated repeatability."""
    return float(np.exp(0.5 * fit.components.eta[KINDS.index("artefact")]))


def _scatter(problem: CampaignProblem, fit: CampaignFit, label: str) -> float:
    """Rms residual of a run in units of its stated noise, including excluded points; gross points count little."""
    i = next(k for k, r in enumerate(problem.runs) if r.label == label)
    size = problem.split(np.abs(fit.residual_mm) / problem.sigma)[i]
    return float(np.sqrt(np.mean(np.minimum(size, GROSS_SIGMA) ** 2)))


def _quarter_turn(
    runs: tuple[RunData, ...], fit: CampaignFit, settle: Settle
) -> tuple[tuple[RunData, ...], CampaignProblem, CampaignFit, ArtefactFault] | None:
    """Turn one run by quarter turns, so that all forms agree best; None if this does not make the solution clearly better."""
    tried = [(i, quarter, turned_run(run, quarter)) for i, run in enumerate(runs) for quarter in (1, 2, 3)]
    changed = [(i, quarter, (*runs[:i], other, *runs[i + 1 :])) for i, quarter, other in tried if other is not None]
    if not changed:
        return None
    i, quarter, best = min(changed, key=lambda one: _disagreement(one[2]))
    problem, new = settle(best)
    if sum(r.deviation_mm.size for r in runs) * float(np.log(_noise(fit) / _noise(new))) < STRONG:
        return None
    what = f"the artefact lay rotated by {90 * quarter} degrees against the stated pose"
    return best, problem, new, ArtefactFault(runs[i].label, what, "solved so")


def _disagreement(runs: tuple[RunData, ...]) -> float:
    """Sum of squares of the differences between the forms in the runs, without best-fit affine maps; machine errors hardly add to it."""
    seen: dict[tuple[str, int], list[float]] = {}
    for p, deviation in ((r.points, r.deviation_mm) for r in runs if r.points is not None and r.points.source != "length"):
        for k in np.unique(p.component):
            mine = p.component == k
            affine = np.column_stack([np.ones(int(mine.sum())), p.nominal_mm[mine]])
            left = deviation[mine] - affine @ np.linalg.lstsq(affine, deviation[mine], rcond=None)[0]
            for row, value in zip(np.flatnonzero(mine), left, strict=True):
                seen.setdefault((p.feature[row], int(k)), []).append(float(value))
    return sum(len(v) * float(np.var(v)) for v in seen.values())


def turned_run(run: RunData, quarter: int) -> RunData | None:
    """Return a run as if the artefact lay some quarter turns further about its centre; None if a feature then lies at no nominal place."""
    p = run.points
    if p is None or p.source == "length":
        return None
    turn = np.linalg.matrix_power(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), quarter)
    places = dict(zip(p.feature, p.nominal_mm, strict=True))
    names, known = list(places), np.array(list(places.values()))
    middle = 0.5 * (known.min(axis=0) + known.max(axis=0))
    under = (p.nominal_mm - middle) @ turn + middle
    away = np.linalg.norm(under[:, None] - known, axis=2)
    nearest = np.argmin(away, axis=1)
    if away.min(axis=1).max() > OTHER_PLACE_MM or p.normal.any():
        return None
    matrix = p.matrix @ turn
    along = p.matrix.T[p.component] @ matrix
    component = np.argmax(np.abs(along), axis=1)
    deviation = run.deviation_mm * np.sign(along[np.arange(len(component)), component])
    feature = tuple(names[i] for i in nearest)
    return replace(
        run, deviation_mm=deviation, points=replace(p, matrix=matrix, component=component, feature=feature, nominal_mm=known[nearest])
    )


def _step(problem: CampaignProblem, fit: CampaignFit) -> tuple[tuple[RunData, ...], str] | None:
    """Split a run at the time after which the artefact lies elsewhere; None without strong evidence."""
    score, runs, best = Score.of(problem, fit), problem.runs, (STRONG, 0, 0.0)
    for i, run in enumerate(runs):
        if run.points is None or run.points.source == "length" or np.isfinite(run.points.step_s):
            continue
        for t in np.unique(run.t_s)[3:-3]:
            columns = [np.zeros((r.deviation_mm.size, 6)) if r is not run else step_columns(run.points, run.t_s >= t) * STEPS for r in runs]
            gain = score.gain_rescaled(np.concatenate(columns))
            best = max(best, (gain, i, float(t)))
    gain, i, t = best
    if gain <= STRONG:
        return None
    run = runs[i]
    assert run.points is not None
    return (*runs[:i], replace(run, points=replace(run.points, step_s=t)), *runs[i + 1 :]), run.label


def _moved_step(
    runs: tuple[RunData, ...], problem: CampaignProblem, fit: CampaignFit, label: str, settle: Settle
) -> tuple[tuple[RunData, ...], CampaignProblem, CampaignFit]:
    """Move a step past neighbouring points that the fit left out (they may lie on its other side), if a new fit leaves out fewer points."""
    i = next(k for k, r in enumerate(runs) if r.label == label)
    run, weight = runs[i], problem.split(fit.weight)[i]
    assert run.points is not None
    times = np.unique(run.t_s)
    bad = np.array([weight[run.t_s == t].min() < DOUBTED for t in times])
    at = int(np.searchsorted(times, run.points.step_s))
    first, last = at, at
    while first > 0 and bad[first - 1]:
        first -= 1
    while last < len(times) - 1 and bad[last]:
        last += 1
    best = (runs, problem, fit)
    for other in {first, last} - {at}:
        changed = (*runs[:i], replace(run, points=replace(run.points, step_s=float(times[other]))), *runs[i + 1 :])
        new, found = settle(changed)
        if (found.weight < DOUBTED).sum() < (best[2].weight < DOUBTED).sum():
            best = (changed, new, found)
    return best


def _motion(problem: CampaignProblem, fit: CampaignFit, label: str) -> ArtefactFault:
    run = next(r for r in problem.runs if r.label == label)
    assert run.points is not None
    size = float(np.linalg.norm(fit.theta[[problem.names.index(f"step_{run.setup}_{k}") for k in LETTERS]]))
    point = int(np.searchsorted(np.unique(run.t_s), run.points.step_s)) + 1
    what = f"the artefact moved before point {point} (t_s {run.points.step_s:.0f}) by {1e3 * size:.0f} µm"
    return ArtefactFault(label, what, "parted there")


def seen(joint: JointSolution) -> list[ArtefactFault]:
    """Return the faults that a solution shows: false triggers, a wrong radius of the stylus, a twist of the artefact."""
    return [*_false_triggers(joint), *_radius(joint), *_twist(joint)]


def _false_triggers(joint: JointSolution) -> list[ArtefactFault]:
    out = []
    for run, fitted in zip(joint.data, joint.runs, strict=True):
        if run.points is None:
            continue
        bad = sorted({run.points.feature[o.index] for o in joint.outliers if o.run == run.label and o.weight == 0.0
                      and abs(fitted.residual_mm[o.index]) > FALSE_TRIGGER_MM})  # fmt: skip
        if 0 < len(bad) <= FALSE_TRIGGERS:
            worst = 1e3 * max(abs(fitted.residual_mm[o.index]) for o in joint.outliers if o.run == run.label)
            out.append(ArtefactFault(run.label, f"a false trigger at {', '.join(bad)}: the reading is off by {worst:.0f} µm", "left out"))
    return out


def _radius(joint: JointSolution) -> list[ArtefactFault]:
    if "stylus_probe" not in joint.estimate.names:
        return []
    value, u = joint.estimate.value("stylus_probe"), joint.estimate.u("stylus_probe")
    if abs(value) < max(RADIUS_MM, SIGMA * u):
        return []
    run = next(r.label for r in joint.data if r.points is not None and r.points.normal.any())
    way = "smaller" if value < 0.0 else "larger"
    what = f"the radius of the stylus, with its pre-travel, is {1e3 * abs(value):.0f} ± {2e3 * u:.0f} µm {way} than stated"
    return [ArtefactFault(run, what, "solved for")]


def _twist(joint: JointSolution) -> list[ArtefactFault]:
    """Report artefacts with a twist: most of their form is a rotation about their centre that grows with r^2."""
    out, e = [], joint.estimate
    mine = [(r, r.points) for r in joint.data if r.points is not None and r.points.source != "length"]
    for name in dict.fromkeys(p.artefact for _, p in mine):
        poses = [p for _, p in mine if p.artefact == name]
        places = {f: n for p in poses for f, n in zip(p.feature, p.nominal_mm, strict=True)}
        amount = form_amounts(poses[0], places, e.names)[list(NAMED).index(SWIRL)]
        if not amount.any() or len(poses) < 2:  # one pose cannot tell the part from the machine (`plate_fit`)
            continue
        value, u = float(amount @ e.theta), float(np.sqrt(amount @ e.covariance @ amount))
        form = np.array([n.startswith(f"form_{name}_") for n in e.names])
        usual = float(np.linalg.norm((amount * joint.prior_sd)[form]))
        if abs(value) > max(TWIST_MM, SIGMA * u, 3.0 * usual) and _share(poses[0], places, e.theta, e.names, value) > MOST:
            what = (
                f"a rotation that grows with r², {1e3 * value:+.1f} ± {2e3 * u:.1f} µm at the rim, turns with the part in "
                f"{len(poses)} poses: as far as these poses show, this is a form of the plate (a twist), not a motion of the machine"
            )
            out.append(ArtefactFault(mine[0][0].label, what, "left out of the machine"))
    return out


def _share(p: ArtefactPoints, places: dict[str, F1], theta: F1, names: tuple[str, ...], value: float) -> float:
    """Share of the swirl in the form's sum of squares; 1 for a workpiece, whose form is smooth."""
    at = {n: i for i, n in enumerate(names)}
    rows = [[at.get(f"form_{p.artefact}_{f}_{k}") for k in "xy"] for f in places]
    if any(row is None for pair in rows for row in pair):
        return 1.0
    q = (np.array(list(places.values())) - p.middle_mm)[:, :2] / p.reach_mm
    affine = np.column_stack([np.ones(len(q)), q])
    swirl = np.stack([-q[:, 1], q[:, 0]], axis=1) * (q**2).sum(axis=1, keepdims=True)
    form = theta[np.array(rows, dtype=np.int64)] + swirl * (theta[at[f"twist_{p.artefact}_0"]] if f"twist_{p.artefact}_0" in at else 0.0)
    free, left = (v - affine @ np.linalg.lstsq(affine, v, rcond=None)[0] for v in (swirl, form))
    return float(value**2 * (free**2).sum() / max(float((left**2).sum()), 1e-18))
