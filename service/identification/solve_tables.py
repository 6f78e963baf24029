"""Further results of a solution: the errors that each kind of table leaves, the 3-D grid as a file, and a Monte Carlo check of U."""

from __future__ import annotations

import numpy as np

from abbe.models.arrays import F2
from abbe.models.compensation.achievable import achievable
from abbe.models.compensation.grid import GridTable, compensable_nodes, grid_table, nodes_mm, quantise_grid
from abbe.models.geometry.volume import volume_frame
from abbe.models.uncertainty.campaign_trials import LIMITS, campaign_trials
from abbe.models.uncertainty.monte_carlo import VALIDATION_SHARE, adaptive, validate
from abbe.models.uncertainty.prediction import predict_deviation, worst_point
from abbe.models.uncertainty.scales import SCALE_TEXTS, without_scales
from abbe.models.uncertainty.sources import error_sources
from abbe.service.domain.solution_file import MonteCarloCheck, TableRow
from abbe.service.errors import TableRefused
from abbe.service.identification.artefact_answer import deviation_of_artefacts
from abbe.service.identification.solve import ProgressText
from abbe.service.identification.solve_report import Assessment, point, solution_verdict

DEVIATION_HEADER = "x_mm,y_mm,z_mm,dx_um,dy_um,dz_um,U_dx_um,U_dy_um,U_dz_um"
GRID_HEADER = "x_mm,y_mm,z_mm,dx_um,dy_um,dz_um,u_dx_um,u_dy_um,u_dz_um,compensated"
SEED, TRIALS = 101, 400_000


def table_rows(found: Assessment, lsb_mm: float) -> list[TableRow]:
    """Return the errors of distances that each kind of table leaves, µm, with standard uncertainties; tables rounded to ``lsb_mm``."""
    out = []
    for row in achievable(found.sources.solution, lsb_mm=lsb_mm, sources=found.sources):
        d = row.distances
        values = {k: getattr(d, k.replace("_um", "_mm")) * 1e3 for k in ("rms_um", "u_rms_um", "q95_um", "u_q95_um", "max_um", "u_max_um")}
        out.append(TableRow(kind=row.kind, entries=row.entries, unknown_um=d.unknown_mm * 1e3, **values))
    return out


def machine_grid(found: Assessment, nodes: int, lsb_mm: float) -> GridTable:
    """Return the 3-D grid of corrections where the error exceeds its uncertainty, rounded to ``lsb_mm``.

    Raises
    ------
    TableRefused
        The solution's verdict or an open flag forbids it, or nothing can be compensated.
    """
    if found.solved.flags:
        first = found.solved.flags[0]
        raise TableRefused(
            f"no grid from a solution with open flags: run {first.run}: {first.what}", f"{first.remedy}; nothing was written"
        )
    verdict = solution_verdict(found)
    if verdict.sign == "bad":
        free = found.scale_free
        usable = free is not None and solution_verdict(free).sign != "bad"
        remedy = "leave the scales out (--without-scale), or measure more" if usable else "measure more"
        raise TableRefused(f"no grid from a solution that is {verdict.word}: {verdict.reasons[0]}", f"{remedy}; nothing was written")
    counts = (nodes, nodes, nodes)
    mask = compensable_nodes(found.joint, counts, inputs=found.sources.inputs, scales=found.left_out)
    table = quantise_grid(grid_table(found.sources.solution, counts, compensable=mask, sources=found.sources), lsb_mm)
    if not table.compensated.any():
        raise TableRefused("the error is nowhere larger than its uncertainty: there is nothing to compensate", "nothing was written")
    return table


def grid_text(table: GridTable) -> str:
    """Return the grid as CSV, one node per line, X slowest. ``dx_um`` to ``dz_um``: added to the command; ``u_``: standard uncertainty."""
    values = np.column_stack([table.correction_mm.reshape(-1, 3) * 1e3 + 0.0, table.u_mm.reshape(-1, 3) * 1e3])
    rows = zip(nodes_mm(table.position_mm), values, table.compensated.reshape(-1), strict=True)
    lines = [",".join([*(f"{v:.10g}" for v in p), *(f"{v:.6g}" for v in d), str(int(c))]) for p, d, c in rows]
    return "\n".join([GRID_HEADER, *lines]) + "\n"


def scale_free(found: Assessment) -> Assessment:
    """Return the assessment of everything but the scales.

    Raises
    ------
    TableRefused
        The scales are not the least certain part of the solution.
    """
    if found.scale_free is None:
        raise TableRefused("these runs determine the scales as well as the rest: keep the scales", "run again and omit --without-scale")
    return found.scale_free


def deviation_text(found: Assessment, points_mm: F2) -> str:
    """Return the deviation at points, shape (n, 3), as CSV with a line for each point, and the verdict of the solution as a last comment.

    ``dx_um`` to ``dz_um``: tool relative to workpiece, best-fit rigid motion over the strokes removed (for artefacts
    a comment states the frame; a direction that was not sensed is empty); ``U_``: expanded uncertainty, 95 %.
    """
    notes = [f"# verdict: {solution_verdict(found).word}"]
    if found.joint.only_artefacts:
        deviation, expanded, frame = deviation_of_artefacts(found.joint, points_mm)
        found_faults = "; ".join(flag.line for flag in found.solved.flags)
        notes = [f"# frame: {frame}", f"# verdict: {found_faults}" if found_faults else notes[0]]
    else:
        sources = error_sources(found.joint, found.solved.inputs.as_measured())
        if found.left_out is not None:
            sources = without_scales(sources, found.left_out)
            notes.insert(0, f"# frame: {SCALE_TEXTS[found.left_out]} removed, too")
        p = predict_deviation(sources, points_mm, frame=volume_frame(found.joint.machine))
        deviation, expanded = p.deviation_mm, p.expanded_mm
    rows = zip(points_mm, np.column_stack([deviation, expanded]) * 1e3, strict=True)
    lines = [",".join([*(f"{v:.10g}" for v in at), *("" if np.isnan(v) else f"{v:.6g}" for v in values)]) for at, values in rows]
    return "\n".join([DEVIATION_HEADER, *lines, *notes]) + "\n"


def monte_carlo(found: Assessment, progress: ProgressText) -> MonteCarloCheck:
    """Check the 95 % intervals at the point with the largest U by Monte Carlo trials (GUM-S1); stated limits are drawn as rectangular."""
    p, at = found.prediction, worst_point(found.prediction)
    trials = campaign_trials(found.sources, p.points_mm[at : at + 1], frame=volume_frame(found.joint.machine), distributions=LIMITS)
    draw, done = trials.linear(), 0

    def counted(rng: np.random.Generator, n: int) -> F2:
        nonlocal done
        done += n
        progress(f"Monte Carlo: {done} trials")
        return draw(rng, n)

    drawn = adaptive(counted, np.random.default_rng(SEED), digits=1, share=VALIDATION_SHARE, largest=TRIALS)
    valid = validate(p.deviation_mm[at], p.expanded_mm[at], drawn).valid
    half = 0.5 * (drawn.symmetric.high - drawn.symmetric.low) * 1e3
    stated = p.expanded_mm[at] * 1e3
    intervals = "; ".join(f"{a} stated ± {s:.2f}, found ± {h:.2f}" for a, s, h in zip("XYZ", stated, half, strict=True))
    if valid.all():
        claim = "the stated uncertainty is right to one digit"
    else:
        claim = "the stated uncertainty is larger than needed" if (stated >= half)[~valid].all() else "the stated uncertainty is too small"
    return MonteCarloCheck(
        trials=drawn.trials,
        at_mm=point(p.points_mm[at]),
        stated_um=point(stated),
        found_um=point(half),
        valid=[bool(v) for v in valid],
        settled=bool(drawn.settled.all()),
        text=f"Monte Carlo (GUM Supplement 1, {drawn.trials} trials) at the worst known point, 95 % intervals in µm: {intervals}: {claim}.",
    )
