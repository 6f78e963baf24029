"""Solve a campaign: runs to error parameters with uncertainty, and to what these runs cannot tell."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

import numpy as np

from models.compensation.summary import SCALE_NOTE, mean_linear
from models.solvers.helix import HelixSolution, fit_run
from models.solvers.joint import JointSolution, implausible, solve_joint
from models.solvers.observations import RunData, nominal_reading
from models.solvers.observe import bar_normals, setup_unknowns
from models.solvers.priors import U_WAVELENGTH, Priors
from models.solvers.step_diagonal import ORDER, closure_mm, increments, squareness_contrast, u_wang_four, wang_four
from service.errors import InstrumentsDisagree, NotObservable
from service.runs.observations import bar_noise_mm, run_data
from service.site import Site

LEGENDRE_ORDER = 9
LASER_SIGMA_MM = 3e-4
FLOOR_MM = 3e-4
"""What smooth functions of this order do not follow: neither instrument is trusted below it."""
SEEN_SHARE = 0.2
"""A parameter whose data explain less than this share of its prior variance is listed as not seen."""
HELIX_NOTE = (
    "Ten-parameter figures describe the machine about that sphere only, from that run alone; over the volume the joint solution is the one "
    "to use."
)
STEP_NOTE = (
    "Step-diagonal figures are the paper's, for comparison: their uncertainty holds reading noise and the laser's wavelength only. Tilt of "
    "the mirrors and angular errors of the axes bias them and are not in it; the joint solution knows both and is the one to use."
)


@dataclass(frozen=True)
class Solved:
    """Joint solution plus the papers' own solutions of the same runs, for comparison."""

    joint: JointSolution
    helices: dict[str, HelixSolution]
    step_totals: dict[str, dict[str, float]]
    noise_bar_mm: float


def solve_runs(site: Site, runs: list[dict[str, Any]]) -> Solved:
    """Solve ``abbe-run/1`` objects together (role ``identify`` only).

    Raises
    ------
    NotObservable
        There is no run to identify from, or only one kind of evidence for too many unknowns.
    """
    used = [r for r in runs if r["role"] == "identify"]
    if not used:
        raise NotObservable("no run of this campaign has the role identify", "measure an identification campaign first")
    bars = [r for r in used if r["test"].startswith("ballbar")]
    noise = float(np.median([bar_noise_mm(r) for r in bars])) if bars else 5e-4
    data = tuple(run_data(r) for r in used)
    joint = solve_joint(
        site.machine,
        data,
        order=LEGENDRE_ORDER,
        sigma_mm={"bar": max(noise, 1e-4), "laser": LASER_SIGMA_MM},
        floor_mm={"bar": FLOOR_MM, "laser": FLOOR_MM},
    )
    check_instruments(joint, data)
    helices = {run.label: fit_run(run, sigma_mm=max(noise, 1e-4)) for run in data if run.kind == "bar"}
    return Solved(joint, helices, step_diagonals(used), noise)


def check_instruments(joint: JointSolution, data: tuple[RunData, ...]) -> None:
    """Refuse a solution in which a bar, cup or mirror would have to be impossibly wrong.

    Raises
    ------
    InstrumentsDisagree
        Which set-up unknown, and by how much.
    """
    setup = setup_unknowns(data, Priors())
    found = implausible(joint, dict(zip(setup.names, (float(v) for v in setup.prior_sd), strict=True)))
    if found:
        name, times = found[0]
        raise InstrumentsDisagree(
            f"{name.replace('_', ' ')} would have to be {times:.0f} times its calibration uncertainty",
            "check the laser's air compensation, the bar's length and the mirror before measuring again; nothing was written",
        )


def step_diagonals(runs: list[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """The papers' step-diagonal figures per step order, each with its ``u_`` from noise and wavelength (see `STEP_NOTE`).

    End errors of the nine curves (um), largest closure (um; its u is that of one closure), squareness contrasts (urad).
    """
    out = {}
    for order in ("XYZ", "ZYX"):
        found = {r["setup"]["diagonal"]: r for r in runs if r["test"] == "laser_diagonal" and r["setup"].get("order", "") == order}
        if set(found) != set(ORDER):
            continue
        out[order] = _step_figures(found, order)
    return out


def _step_figures(found: dict[str, dict[str, Any]], order: str) -> dict[str, float]:
    n = int(found["ppp"]["setup"]["steps"])
    out_only = {k: np.asarray(r["columns"]["deviation_mm"][: 3 * n + 1]) for k, r in found.items()}
    inc = np.abs(np.asarray(found["ppp"]["setup"]["increment_mm"]))
    q = increments(out_only, order)
    curves, u = wang_four(q, inc), u_wang_four(inc, n, LASER_SIGMA_MM, U_WAVELENGTH)
    figures: dict[str, float] = {}
    for i, a in ((i, a) for a in range(3) for i in range(3)):
        key = f"E{'XYZ'[i]}{'XYZ'[a]}_end_um"
        figures |= {key: float(curves[i, a, -1]) * 1e3, f"u_{key}": float(u[i, a, -1]) * 1e3}
    figures["closure_max_um"] = float(np.abs(closure_mm(q)).max()) * 1e3
    figures["u_closure_max_um"] = float(np.sqrt(8.0)) * LASER_SIGMA_MM * 1e3  # four differences of two readings
    contrast = squareness_contrast({k: float(v[-1]) for k, v in out_only.items()}, inc * n, LASER_SIGMA_MM * np.sqrt(2.0))
    for name in ("xy", "xz", "yz"):
        figures[f"theta_{name}_urad"] = getattr(contrast, f"theta_{name}") * 1e6
        figures[f"u_theta_{name}_urad"] = getattr(contrast, f"u_{name}") * 1e6
    return figures


def not_observable(joint: JointSolution) -> list[str]:
    """In words: motions that the runs cannot tell apart (grouped over their orders), then parameters that rest on their prior."""
    groups: dict[tuple[str, ...], list[int]] = {}
    for combination in joint.identifiability.hidden:
        parts = [name.partition(".") for name, _ in combination.weights]
        motions = tuple(sorted({motion for motion, _, _ in parts}))
        groups.setdefault(motions, []).append(max(int(order or 0) for _, _, order in parts))
    texts = [_apart(motions, sorted(orders)) for motions, orders in groups.items()]
    names = [t.name for t, s in zip(joint.terms, joint.estimate.data_share, strict=False) if s < SEEN_SHARE]
    if names:
        texts.append(f"{len(names)} coefficients rest on their prior, the data hardly speak of them: {', '.join(names)}")
    if groups and joint.tool_count == 1:
        texts.append("all runs used one tool length: what is named above may act differently with another tool")
    return texts


def _apart(motions: tuple[str, ...], orders: list[int]) -> str:
    span = f"order {orders[0]}" if orders[0] == orders[-1] else f"orders {orders[0]} to {orders[-1]}"
    if len(motions) == 1:
        return f"{motions[0]} ({span}) leaves no trace in these runs"
    count = f"{len(orders)} combination{'s' if len(orders) > 1 else ''}"
    return f"{', '.join(motions[:-1])} and {motions[-1]} cannot be told apart ({span}, {count})"


def solution_doc(solved: Solved) -> dict[str, Any]:
    """The solution as it is stored: parameters with uncertainty in SI-like units, set-up, ranks, per-run residuals, versions."""
    joint = solved.joint
    e = joint.estimate
    return {
        "model": f"rigid21/legendre{LEGENDRE_ORDER}",
        "abbe": version("abbe"),
        "parameters": {n: {"value": e.value(n), "u": e.u(n), "data_share": float(s)} for n, s in zip(e.names, e.data_share, strict=True)},
        "mean_over_volume": {p.name: {"value": p.value, "u": p.u} for p in mean_linear(joint)},
        "mean_over_volume_note": f"scales (EXX, EYY, EZZ) hold {SCALE_NOTE}",
        "rank": {"rank": joint.identifiability.rank, "of": joint.identifiability.n_parameters},
        "not_observable": not_observable(joint),
        "variance_factor": e.variance_factor,
        "chi2": e.chi2,
        "dof": e.dof,
        "runs": {r.label: {"rms_um": r.rms_mm * 1e3} for r in joint.runs},
        "noise_bar_mm": solved.noise_bar_mm,
        "ten_parameter_helix": {
            label: {n: {"value": h.estimate.value(n), "u": h.estimate.u(n)} for n in h.estimate.names}
            for label, h in solved.helices.items()
        },
        "ten_parameter_helix_note": HELIX_NOTE,
        "step_diagonals": solved.step_totals,
        "step_diagonals_note": STEP_NOTE,
    }


def helix_misfit(solved: Solved, run: dict[str, Any]) -> float:
    """Rms of a held-out ball-bar run that the solution does not explain (cup and length refitted), mm."""
    data = run_data(run)
    n = bar_normals(data)
    lost = -0.5 * data.sign * np.array([v for v, _ in solved.joint.backlash_mm().values()])
    y = data.deviation_mm - nominal_reading(data) - np.einsum("ni,ni->n", n, solved.joint.deviation_mm(data.axes_mm, data.tool_mm) + lost)
    a = np.concatenate([n, np.ones((len(n), 1))], axis=1)
    return float(np.sqrt(np.mean((y - a @ np.linalg.lstsq(a, y, rcond=None)[0]) ** 2)))
