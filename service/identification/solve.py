"""Solve a campaign: from runs to error parameters with uncertainty, and the parameters that these runs cannot determine."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from abbe.models.paths import DIAGONALS, step_diagonal
from abbe.models.solvers.artefact import LEARNED
from abbe.models.solvers.artefact_faults import ArtefactFault, seen, undone
from abbe.models.solvers.assessment import map_against_prior
from abbe.models.solvers.helix import HelixSolution, fit_run
from abbe.models.solvers.joint import JointSolution, Model, implausible, settled_points, solve_joint
from abbe.models.solvers.observations import RunData, bar_normals, nominal_reading
from abbe.models.solvers.observe import setup_unknowns
from abbe.models.solvers.priors import U_WAVELENGTH, Priors
from abbe.models.solvers.step_diagonal import ORDER, closure_mm, increments, squareness_contrast, u_wang_four, wang_four
from abbe.models.uncertainty.inputs import StatedInputs
from abbe.service.campaign_data.campaign_checks import CampaignIssue, artefact_issues, check_files, check_readings, copy_issues, refuse
from abbe.service.campaign_data.provenance import measured_digest, removals_of
from abbe.service.domain.run import Run
from abbe.service.errors import CampaignRefused, InstrumentsDisagree, NotObservable
from abbe.service.runs.artefact_points import calibrated_lengths
from abbe.service.runs.coverage import reached_mm
from abbe.service.runs.observations import bar_noise_mm, run_data
from abbe.service.site import Site
from abbe.service.verification.reduction import holds_at, laser_inputs

LASER_SIGMA_MM = 3e-4
CALIBRATED = ("bar_length", "laser_scale", "cup_", "tilt_")
"""Prefixes of set-up unknowns that cannot be off by five uncertainties: they were calibrated, or such an error would be visible."""
LASER_REMEDY = "look at beam, mirror and temperature of that set-up, or search for a missing effect: `abbe discover`"
UNUSUAL = {
    "cosine": ("the relative length error (beam and mirror askew, or a wrong wavelength)", LASER_REMEDY),
    "bar_drift": ("the drift of the centre cup", "look at the cup's clamping, the spindle's temperature and t_s"),
    "drift": ("the drift of the laser", "look at the air, the warming of laser and mirror, and t_s"),
    "zero": ("the error of the first record", "look at the first record: was the machine standing still?"),
}
ALL_READINGS = 10**9
PER_UNKNOWN = 2
"""Readings that a campaign needs for every unknown without a prior."""
SIX, TWENTY_ONE = 6 + 3, 21 + 3 + 18 + 3
"""Unknowns of the smallest model: of rigid6, and of rigid21 with slope and curvature; both with the lost motion of three axes."""
HELIX_NOTE = (
    "Ten-parameter figures describe the machine on the sphere of their run only, from that run alone. "
    "For the volume use the joint solution."
)
STEP_NOTE = (
    "Step-diagonal figures follow the papers, for comparison. Their uncertainty covers only reading noise and the laser's wavelength, not "
    "mirror tilt and angular errors of the axes, which bias them. Use the joint solution, which includes both."
)
ProgressText = Callable[[str], None]
STEP_PLACE_MM = 0.1
"""Largest distance of a row from the end of its step; a farther row belongs to another step."""


@dataclass(frozen=True)
class Solved:
    """Joint solution and, for comparison, the same runs solved by published methods (ten-parameter helix, step diagonals).

    ``flags``: doubtful features of single runs that may be right. ``digests``: hash of every run's data as measured, by run label.
    ``tables``: the compensation table of each run, if its document states one. ``removed``: descriptions of effects subtracted from the
    readings. ``rows``: first and last row of the run's file (from 1) that each value was made of, shape (values, 2). ``holds_at``:
    temperature of the scales at which the result holds, as text. ``reached_mm``: lowest and highest position of each axis in the runs;
    beyond them the map is only the prior. ``inputs``: stated uncertainties that no reading shows. ``undone``: faults of runs of
    artefacts (exchanged features, a turn, a motion) that the solution corrected by itself.
    """

    joint: JointSolution
    helices: dict[str, HelixSolution]
    step_totals: dict[str, dict[str, float]]
    flags: tuple[CampaignIssue, ...] = ()
    digests: dict[str, str] = field(default_factory=dict)
    rows: dict[str, NDArray[np.int64]] = field(default_factory=dict)
    tables: dict[str, dict[str, Any]] = field(default_factory=dict)
    removed: tuple[str, ...] = ()
    holds_at: str = ""
    reached_mm: tuple[tuple[float, float], ...] = ()
    inputs: StatedInputs = field(default_factory=StatedInputs)
    undone: tuple[ArtefactFault, ...] = ()


def solve_runs(
    site: Site,
    runs: list[Run],
    *,
    model: Model | None = "rigid21",
    instruments: dict[str, Any] | None = None,
    progress: ProgressText | None = None,
) -> Solved:
    """Solve runs of the role ``identify`` together, after checking each for consistency.

    ``instruments``: of the campaign file; facts about laser and scales that they do not state widen the uncertainties (`laser_inputs`).

    ``model`` None: rigid21, or rigid6 with a flag if the readings are too few for it or do not support it (`map_against_prior`).

    Raises
    ------
    NotObservable
        No run has the role identify.
    CampaignRefused
        A run has another unit, exchanged axes or another machine, or is a copy; or the readings are too few for the model.
    InstrumentsDisagree
        The readings imply an impossible error of a bar, cup or mirror.
    """
    progress = progress or _silent
    used = [r for r in runs if r.identifies]
    if not used:
        raise NotObservable("no run of this campaign has the role identify", "measure an identification campaign first")
    progress(f"{len(used)} runs: units, axes, copies, machine")
    free = model is None
    model, smaller = (model, []) if model is not None else _affordable([run_data(r, blocks=ALL_READINGS) for r in used])
    flags = smaller + check_campaign(site, used, [r for r in runs if r.role == "holdout"], model)
    bars = [r for r in used if r.is_bar]
    noise = float(np.median([bar_noise_mm(r) for r in bars])) if bars else 5e-4
    data = tuple(run_data(r) for r in used)
    inputs = laser_inputs(instruments or {})
    priors = replace(Priors(), laser_scale=inputs.u_wavelength)
    touched, faults = [r for r in used if r.is_artefact], list[ArtefactFault]()
    points = (*data, *calibrated_lengths(used)) if touched else data
    if len(touched) == len(used):
        progress("points of artefacts: features, poses, motions")
        points, faults = undone(points, lambda runs: settled_points(site.machine, runs, priors))
    joint = solve_joint(site.machine, points, model=model, priors=priors, progress=progress)
    if len(touched) < len(used) and (
        beyond := beyond_the_prior(joint, instead="; solved for rigid6, scales and squareness only" if free else "")
    ):
        flags.append(beyond)
        joint = solve_joint(site.machine, points, model="rigid6", priors=priors, progress=progress) if free else joint
    flags += check_instruments(joint, points) + changing_scales(joint)
    flags += [CampaignIssue(f.run, f.what, f.done, False) for f in (*faults, *(seen(joint) if touched else ()))]
    spatial = {r.run_id for r in used if r.test == "ballbar_helix"}  # a circle does not determine ten parameters
    helices = {run.label: fit_run(run, sigma_mm=max(noise, 1e-4)) for run in data if run.label in spatial}
    digests = {r.run_id: measured_digest(r) for r in used}
    tables = {r.run_id: r.table.document for r in used if r.table.crc is not None}
    rows, removed, held = value_rows(used, data), tuple(removals_of(used)), holds_at(used, site.materials)
    return Solved(
        joint,
        helices,
        step_diagonals(used),
        tuple(flags),
        digests,
        rows,
        tables,
        removed,
        held,
        reached_mm(used),
        inputs,
        tuple(faults),
    )


def value_rows(runs: list[Run], data: tuple[RunData, ...]) -> dict[str, NDArray[np.int64]]:
    """Return, by run label, the first and last row (from 1) of the run's file that went into each value, shape (values, 2).

    Long runs are averaged in blocks. A row belongs to the value with the nearest mean time; invalid rows belong to none.
    """
    out = {}
    for run, values in zip(runs, data, strict=True):
        t, rows = run.columns.t_s, np.flatnonzero(run.columns.valid)
        if rows.size == values.t_s.size:
            out[run.run_id] = np.stack([rows, rows], axis=1) + 1
            continue
        edges = np.searchsorted(t[rows], 0.5 * (values.t_s[1:] + values.t_s[:-1]))
        first, last = np.concatenate([[0], edges]), np.concatenate([edges, [rows.size]]) - 1
        out[run.run_id] = np.stack([rows[np.minimum(first, rows.size - 1)], rows[np.maximum(last, first)]], axis=1) + 1
    return out


def _silent(_: str) -> None:
    return None


def check_campaign(site: Site, used: list[Run], others: list[Run], model: Model) -> list[CampaignIssue]:
    """Return the flags of the runs to solve; ``others`` are only checked for copies.

    Raises
    ------
    CampaignRefused
        A run is wrong; the message names the run, the mistake and the remedy.
    """
    plain = [r for r in used if not r.is_artefact]
    flags = check_files(site.doc, plain) + artefact_issues(site.doc, [r for r in used if r.is_artefact])
    known = {f.run for f in flags}
    flags += [f for f in copy_issues([*plain, *(r for r in others if not r.is_artefact)]) if f.run not in known]
    refuse(flags)
    data = [run_data(r, blocks=ALL_READINGS) for r in used]
    check_enough(data, model)
    flags += check_readings(site.machine, [r for r in data if r.kind != "artefact"])
    refuse(flags)
    return flags


def check_enough(data: list[RunData], model: Model) -> None:
    """Refuse a campaign with fewer than `PER_UNKNOWN` readings for every unknown without a prior.

    Raises
    ------
    CampaignRefused
        The message states the number of readings, the number needed, and the run with the fewest.
    """
    count, unknowns = sum(r.deviation_mm.size for r in data), _unknowns(data, model)
    if count < PER_UNKNOWN * unknowns:
        fewest = min(data, key=lambda r: r.deviation_mm.size)
        raise CampaignRefused(
            f"{count} readings are too few for the {unknowns} unknowns of {model} and the set-ups ({PER_UNKNOWN * unknowns} are needed); "
            f"run {fewest.label} has the fewest, {fewest.deviation_mm.size}",
            "measure more positions" + (", or use --model rigid6" if model != "rigid6" else "") + "; nothing was stored",
        )


def _unknowns(data: list[RunData], model: Model) -> int:
    return (TWENTY_ONE if model == "rigid21" else SIX) + sum({"bar": 4, "laser": 2, "artefact": 3}[r.kind] for r in data)


def _affordable(data: list[RunData]) -> tuple[Model, list[CampaignIssue]]:
    """Return the largest model that the readings support, and a flag if it is not rigid21."""
    count, wanted = sum(r.deviation_mm.size for r in data), PER_UNKNOWN * _unknowns(data, "rigid21")
    if count >= wanted:
        return "rigid21", []
    what = f"{count} readings in all are too few for rigid21 ({wanted} are needed): solved for rigid6, scales and squareness only"
    return "rigid6", [CampaignIssue(min(data, key=lambda r: r.deviation_mm.size).label, what, "measure more positions", False)]


def beyond_the_prior(joint: JointSolution, *, instead: str = "") -> CampaignIssue | None:
    """Return a flag if the runs do not support 21 error motions: the solved motions are larger, or less certain, than the priors.

    ``instead``: what Abbe does about it, the end of the flag's text.
    """
    found = None if joint.model == "rigid6" else map_against_prior(joint)
    if found is None or found.carried:
        return None
    worst = max(joint.runs, key=lambda run: run.rms_mm / run.expected_mm)
    why = "smooth motions do not fit these readings" if found.read else f"no run measured more than {found.measured_mm * 1e3:.0f} µm rms"
    what = (
        f"21 error motions would be {found.predicted_mm * 1e3:.0f} ± {2e3 * found.u_mm:.0f} µm rms over the volume; a usual "
        f"machine has {found.prior_mm * 1e3:.0f} µm: {why}{instead}"
    )
    return CampaignIssue(worst.label, what, "look for the pitch of a screw or a kink of a rail: measure the axes in fine steps", False)


def check_instruments(joint: JointSolution, data: tuple[RunData, ...]) -> list[CampaignIssue]:
    """Refuse a solution with an impossible error of a bar, cup, mirror or the laser's scale; other large set-up errors are flags.

    Raises
    ------
    InstrumentsDisagree
        The message states the set-up unknown and the size of its error.
    """
    setup = setup_unknowns(data, Priors())
    own = tuple(f"{kind}_" for kind in (*LEARNED, "stylus", "shear", "scale"))  # of artefacts: found by `seen`, or free
    sizes = {n: float(v) for n, v in zip(setup.names, setup.prior_sd, strict=True) if not n.startswith(own)}
    found = implausible(joint, sizes)
    hard = [(name, times) for name, times in found if name.startswith(CALIBRATED)]
    if hard:
        name, times = hard[0]
        raise InstrumentsDisagree(
            f"the error of {name.replace('_', ' ')} would have to be {times:.0f} times the standard uncertainty that Abbe assumes for it",
            "check the laser's air compensation, the bar's length, the cup and the mirror before measuring again; nothing was written",
        )
    return [_unusual(name, times, data) for name, times in found]


def changing_scales(joint: JointSolution) -> list[CampaignIssue]:
    """Return a flag for each scale that changed during the campaign, for example because a ball screw warms up."""
    first = min(joint.data, key=lambda run: run.t_s[0]).label
    issues = []
    for one in joint.scale_drifts:
        change = f"the scale of {'XYZ'[one.axis]} changed by {1e6 * one.change:+.1f} ± {2e6 * one.u:.1f} µm/m during the campaign"
        issues.append(CampaignIssue(first, f"{change}: U includes it", "let the machine warm up, then measure again", False))
    return issues


def _unusual(name: str, times: float, data: tuple[RunData, ...]) -> CampaignIssue:
    """Return a flag for a set-up error that is unusually large but possible."""
    title, remedy = next(
        (entry for prefix, entry in UNUSUAL.items() if name.startswith(prefix)), (name.replace("_", " "), "look at that set-up")
    )
    run = _longest_contained([r.label for r in data], name)
    setup = None if run else _longest_contained([r.setup for r in data], name)
    if run:
        return CampaignIssue(run, f"{title} is {times:.0f} times what is usual", remedy, False)
    first = next((r.label for r in data if r.setup == setup), name)
    return CampaignIssue(first, f"{title} of set-up {setup} is {times:.0f} times what is usual", remedy, False)


def _longest_contained(names: list[str], unknown: str) -> str | None:
    """Return the longest of the names that occurs in ``unknown`` as a whole word between underscores: B1 does not occur in cup_B12_x."""
    found = [n for n in names if re.search(rf"_{re.escape(n)}(_|$)", unknown)]
    return max(found, key=len) if found else None


def step_diagonals(runs: list[Run]) -> dict[str, dict[str, float]]:
    """Return step-diagonal results of Wang's method by step order, with u (keys ``u_..``) from noise and wavelength (see `STEP_NOTE`).

    These are the end errors of the nine curves (um), the largest closure (um, with the u of one closure) and squareness contrasts (urad).
    """
    out = {}
    for order in ("XYZ", "ZYX"):
        found = {r.laser.diagonal: r for r in runs if r.test == "laser_diagonal" and r.laser.order == order}
        if set(found) != set(ORDER) or not all(_whole_way_out(r, order) for r in found.values()):
            continue
        out[order] = _step_figures(found, order)
    return out


def _whole_way_out(run: Run, order: str) -> bool:
    """Whether the first 3 n + 1 rows are valid and at the ends of the steps in this order."""
    setup, n = run.laser, run.laser.steps
    first = run.columns.rows(slice(3 * n + 1))
    points = first.q_mm
    if setup.increment_mm is None or len(points) < 3 * n + 1 or not first.valid.all():
        return False
    span = n * np.abs(setup.increment_mm) * DIAGONALS[setup.diagonal]
    nominal = step_diagonal(points[0], points[0] + span, n, order, back=False)
    return float(np.abs(points - nominal).max()) < STEP_PLACE_MM


def _step_figures(found: dict[str, Run], order: str) -> dict[str, float]:
    setup = found[ORDER[0]].laser
    assert setup.increment_mm is not None  # `_whole_way_out` needed it
    n, inc = setup.steps, np.abs(setup.increment_mm)
    out_only = {k: r.columns.readings_mm[: 3 * n + 1] for k, r in found.items()}
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


def helix_misfit(solved: Solved, run: Run) -> float:
    """Return the rms residual of a held-out ball-bar run after refitting cup and length, mm."""
    data = run_data(run)
    n = bar_normals(data)
    lost = -0.5 * data.sign * np.array([v for v, _ in solved.joint.backlash_mm().values()])
    y = data.deviation_mm - nominal_reading(data) - np.einsum("ni,ni->n", n, solved.joint.deviation_mm(data.axes_mm, data.tool_mm) + lost)
    a = np.concatenate([n, np.ones((len(n), 1))], axis=1)
    return float(np.sqrt(np.mean((y - a @ np.linalg.lstsq(a, y, rcond=None)[0]) ** 2)))
