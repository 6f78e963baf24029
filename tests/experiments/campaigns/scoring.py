"""One campaign judged: which intervals hold the truth, and which claims are wrong.

Identifiable: a smooth term or a lost motion that the solution's rank analysis covers (Legendre orders up to ``solution.order``), that takes
part in no combination it lists as hidden, and of whose prior variance the data took at least half (``data_share``); its interval is
estimate +- 1.96 u. Predicted deviation: `abbe.models.uncertainty.prediction` with its own coverage factor, stated inputs true to the
population (no temperatures are wrong here), at 100 random points of the volume in the frame without rigid motion over these points.
"""

import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from abbe.models.compensation.grid import compensable_nodes, grid_table, nodes_mm
from abbe.models.geometry.volume import RigidFree, remove_rigid
from abbe.models.solvers.joint import JointSolution, solve_joint
from abbe.models.uncertainty.inputs import StatedInputs
from abbe.models.uncertainty.prediction import predict_deviation
from abbe.models.uncertainty.sources import error_sources
from tests.experiments.campaigns.population import Case, Kind, draw_case
from tests.experiments.campaigns.traces import Bent, Traces, traces, typical_size

INPUTS = StatedInputs(u_scale_temperature_k=0.0, u_bar_temperature_k=0.0)
"""No temperature is wrong in the population."""
SHARE = 0.5
"""Data share from which on a parameter counts as stated observable."""
NO_TRACE = 0.02
"""Independent data share (errors of typical size) below which a parameter leaves no trace: 0.14 sigma over all readings together."""
HIDDEN_TRACE = 1e-3
"""Trace of a combination stated hidden, over what its parts would show. False statements left 1e-2 to 0.5."""
FAR_OFF = 6.0
TABLE_NODES = (5, 5, 5)
POINTS = 100


@dataclass(frozen=True)
class Judged:
    """Findings about one campaign; arrays are flat, mm and rad.

    ``refused``: the solver's message if it would not solve. ``wrong``: claims that are not true, in words.
    """

    seed: int
    kind: str
    chain: str
    order: int
    seconds: float
    names: list[str]
    z: list[float]
    u: list[float]
    share: list[float]
    identifiable: list[bool]
    point_z: list[float]
    point_u_mm: list[float]
    point_inside: list[bool]
    noise_mm: dict[str, float]
    outliers: int
    flagged: int
    refused: str
    wrong: list[str]


def judge(seed: int, kind: Kind) -> dict[str, Any]:
    """Draw, solve and judge one campaign: the fields of `Judged`, as a dict that can be written down."""
    case = draw_case(seed, kind)
    start = time.perf_counter()
    try:
        solution = solve_joint(case.machine, case.runs)
    except ValueError as exc:
        empty: dict[str, Any] = {name: [] for name in ("names", "z", "u", "share", "identifiable", "point_z", "point_u_mm", "point_inside")}
        return vars(Judged(seed, kind, case.machine.chain, 0, 0.0, **empty, noise_mm={}, outliers=0, flagged=0, refused=str(exc), wrong=[]))
    seconds = time.perf_counter() - start
    names, z, u, share, identifiable = parameters(case, solution)
    point_z, point_u, inside = predictions(case, solution)
    stated = [n for n, ok in zip(names, identifiable, strict=True) if ok]
    wrong = [f"{n}: {v:+.1f} sigmas off" for n, v, ok in zip(names, z, identifiable, strict=True) if ok and abs(v) > FAR_OFF]
    seen = traces(case, tuple(names))
    wrong += no_trace(seen, stated) + not_hidden(solution, seen) + unseen_entries(case, solution, seen)
    return vars(
        Judged(
            seed, kind, case.machine.chain, solution.order, seconds, names, _short(z), _short(u), _short(share), identifiable,
            _short(point_z), _short(point_u), inside.tolist(), solution.noise_mm, len(solution.outliers),
            sum(t.flagged for t in solution.residual_tests), "", wrong,
        )
    )  # fmt: skip


def parameters(case: Case, solution: JointSolution) -> tuple[list[str], np.ndarray, np.ndarray, np.ndarray, list[bool]]:
    """Names, z, u, data share and whether stated identifiable, of all smooth terms and lost motions."""
    e, n = solution.estimate, len(solution.terms) + 3
    names = list(e.names[:n])
    highest = max(t.order for t in solution.terms)
    u = np.sqrt(np.diag(e.covariance)[:n])
    error = e.theta[:n] - case.truth.parameters(names, highest)
    hidden = solution.identifiability.involved
    covered = {t.name for t in solution.terms if t.order <= solution.order} | set(names[-3:])
    identifiable = [name in covered and name not in hidden and float(s) >= SHARE for name, s in zip(names, e.data_share[:n], strict=True)]
    return names, error / u, u, e.data_share[:n], identifiable


def predictions(case: Case, solution: JointSolution) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """z, u and whether inside the stated interval, 3 components at 100 points (shared out over the tools that were used)."""
    sources = error_sources(solution, INPUTS)
    rng = np.random.default_rng([case.seed, 9])
    stroke, found = case.machine.stroke_mm, []
    for tool in case.tools_mm:
        points = rng.uniform(stroke[:, 0], stroke[:, 1], (POINTS // len(case.tools_mm), 3))
        p = predict_deviation(sources, points, tool_mm=tool, frame=RigidFree(points))
        error = p.deviation_mm - remove_rigid(points, case.truth.deviation_mm(points, tool))
        found.append((error / p.u_mm, p.u_mm, np.abs(error) <= p.expanded_mm))
    z, u, inside = (np.concatenate([f[k].ravel() for f in found]) for k in range(3))
    return z, u, inside


def no_trace(seen: Traces, stated: list[str]) -> list[str]:
    """Parameters stated observable along which the simulated machine can be bent without any reading noticing."""
    share = dict(zip(seen.names, seen.share(), strict=True))
    return [f"{n}: stated observable, leaves no trace (share {share[n]:.1e})" for n in stated if share[n] < NO_TRACE]


def not_hidden(solution: JointSolution, seen: Traces) -> list[str]:
    """Parameters of which a combination is stated hidden, although the simulated machine shows every combination of them."""
    traced = [(c.text, seen.least([n for n, _ in c.weights])) for c in solution.identifiability.hidden]
    return [f"stated hidden, leaves a trace of {t:.1e}: {text}" for text, t in traced if t > HIDDEN_TRACE]


def unseen_entries(case: Case, solution: JointSolution, seen: Traces) -> list[str]:
    """Nodes that the 3-D grid compensates although what no reading shows may be larger there than the whole correction.

    Unseen: directions of parameter space that change all readings together by less than 0.1 sigma; errors of typical size. A node counts if
    that is more than the correction without rigid motion, more than three stated uncertainties, and more than 0.1 um.
    """
    table = grid_table(solution, TABLE_NODES, compensable=compensable_nodes(solution, TABLE_NODES, inputs=INPUTS))
    points = nodes_mm(table.position_mm)
    basis = seen.hidden_basis(0.1)
    bent = Bent(case.truth.rig.machine(), points)
    smooth = [n for n in seen.names if not n.startswith("backlash")]
    moved = np.stack([(bent.moved(n, typical_size(case, n))[0] - bent.straight[0]).ravel() for n in smooth], axis=1) @ basis[: len(smooth)]
    free = np.stack([remove_rigid(points, m.reshape(-1, 3)) for m in moved.T], axis=2) if basis.shape[1] else np.zeros((len(points), 3, 1))
    unseen = np.sqrt((free**2).sum(axis=(1, 2)))
    stated = np.linalg.norm(table.u_mm.reshape(-1, 3), axis=1)
    size = np.linalg.norm(remove_rigid(points, solution.deviation_mm(points)), axis=1)
    bad = table.compensated.ravel() & (unseen > np.maximum(3.0 * stated, size)) & (unseen > 1e-4)
    return [f"table: {int(bad.sum())} of {bad.size} nodes compensated in an unobserved region"] if bad.any() else []


def _short(values: np.ndarray) -> list[float]:
    return [float(f"{v:.5g}") for v in values]
