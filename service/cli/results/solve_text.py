"""Output of `abbe solve`: the verdict first, in ten lines; parameters, comparisons, noise and limits of the runs in the details."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import typer

from abbe.service.cli.common import print_table

if TYPE_CHECKING:
    from abbe.service.domain.solution_file import SolutionFile
    from abbe.service.identification.solve import Solved
    from abbe.service.identification.solve_report import Assessment

SIDE_BY_SIDE = 3
"""Largest number of runs side by side in a table: more do not fit in 100 columns."""
NAMED = 4
"""Number of error motions in the summary."""


def print_solution(summary: Assessment, solution: SolutionFile, *, details: bool) -> None:
    """Print the summary and the requested results; with ``details``, print everything else, too."""
    for line in summary_lines(summary, solution):
        typer.echo(line)
    _tables(solution)
    if details:
        _details(summary, solution)


def summary_lines(summary: Assessment, solution: SolutionFile) -> list[str]:
    """Return at most ten lines: the verdict, how well the volume is known, the largest errors, and objections."""
    from abbe.service.identification.removal import table_line
    from abbe.service.identification.solve_report import worst_line

    o, lines = summary.observability, []
    if solution.verdict is not None:
        lines += [f"{solution.verdict.word.capitalize()}. {solution.verdict.text}", solution.verdict.layout]
    lines.append(
        f"campaign {solution.campaign}: model {solution.model}, {len(solution.runs)} runs; the readings determine {o.rank} "
        f"of {len(o.terms)} coefficients, {o.observed.effective_rank} of them well"
    )
    lines += [worst_line(summary), f"largest errors (U, k = 2): {_largest(summary)}", _holds(solution)]
    against = {
        "look at these runs": solution.flags,
        "rough": solution.rough,
        "artefacts": solution.artefacts,
        "these runs cannot tell": solution.not_observable,
    }
    lines += [f"{word}: {_first(found)}" for word, found in against.items() if found]
    if solution.table_removal is not None:
        lines.append(table_line(solution.table_removal))
    if solution.table_not_removed is not None:
        lines.append(f"look at this: {solution.table_not_removed}")
    if solution.solution_id is not None:
        same = ", ".join(map(str, solution.same_as or ()))
        lines.append(f"stored: solution {solution.solution_id}" + (f", the same readings and model as solution {same}" if same else ""))
    return lines


def _holds(solution: SolutionFile) -> str:
    """Say at which temperature the solution holds, and between which positions the runs measured."""
    from abbe.service.runs.coverage import reached_text

    reached = reached_text(solution.reached_mm)
    return f"holds at: {solution.holds_at}" + (f"; measured: {reached}" if reached else "")


def _first(found: list[str]) -> str:
    return found[0] if len(found) == 1 else f"{found[0]}; {len(found) - 1} more with --details"


def _largest(summary: Assessment) -> str:
    """Return the largest mean error motions and all lost motions, each with U."""
    motions = sorted(summary.mean, key=lambda p: -abs(p.value))[:NAMED]
    texts = [f"{p.name} {_figure(p.value * 1e6)} ± {2e6 * p.u:.2f} {'µm/m' if p.name[0] == 'E' else 'µrad'}" for p in motions]
    texts += [f"backlash {axis} {_figure(v * 1e3)} ± {2e3 * u:.2f} µm" for axis, (v, u) in summary.joint.backlash_mm().items()]
    return ", ".join(texts)


def _details(summary: Assessment, solution: SolutionFile) -> None:
    from abbe.service.identification.solve_report import noise_lines, outlier_lines, residual_lines

    _lines("look at these runs:", solution.flags)
    _parameters(summary)
    _comparison(summary)
    if solution.machine_model is not None:
        _lines(
            "model book: effects that tables cannot correct (lasting ones are subtracted):",
            solution.machine_model.not_for_tables,
        )
    _lines("noise found:", noise_lines(summary.joint))
    _lines("outliers:", outlier_lines(summary.solved))
    _lines("residuals that are not noise:", residual_lines(summary.joint))
    if solution.rough:
        _lines("rough:", solution.rough)
    if solution.artefacts:
        _lines("artefacts:", solution.artefacts)
    _lines("these runs cannot tell:", solution.not_observable)
    _lines("what would show more:", solution.advice)


def _lines(heading: str, lines: list[str]) -> None:
    typer.echo(heading if lines else f"{heading} none")
    for text in lines:
        typer.echo(f"- {text}")


def _parameters(summary: Assessment) -> None:
    from abbe.models.compensation.additive import SCALE_NOTE
    from abbe.service.identification.solve_report import HIDDEN_NOTE

    status = {m.name: m.status for m in summary.observability.motions}
    rows: list[list[str]] = []
    for p in summary.mean:
        unit = "µm/m" if p.name[0] == "E" else "µrad"
        what = f"mean over the volume; {HIDDEN_NOTE}" if status.get(p.name) == "not observable" else "mean over the volume"
        rows.append([p.name, _figure(p.value * 1e6), f"{2 * p.u * 1e6:.2f}", unit, what])
    for axis, (v, u) in summary.joint.backlash_mm().items():
        rows.append([f"backlash {axis}", _figure(v * 1e3), f"{2 * u * 1e3:.2f}", "µm", "lost motion"])
    print_table(["parameter", "value", "U (k = 2)", "unit", "what"], rows)
    typer.echo(f"scales (EXX, EYY, EZZ) are valid {SCALE_NOTE}")
    by_status = {s: ", ".join(n for n, v in status.items() if v == s) or "none" for s in ("observed", "weak", "not observable")}
    typer.echo("error motions, each by itself: " + "; ".join(f"{s}: {names}" for s, names in by_status.items()))


def _comparison(summary: Assessment) -> None:
    from abbe.service.identification.solve import HELIX_NOTE, STEP_NOTE

    solved = summary.solved
    labels = list(solved.helices)
    for at in range(0, len(labels), SIDE_BY_SIDE):
        some = labels[at : at + SIDE_BY_SIDE]
        columns = [_helix_row(solved.helices[label].estimate) for label in some]
        print_table(["ten parameters (± U, k = 2)", *some], [list(row) for row in zip(_helix_names(solved, some), *columns, strict=True)])
    if labels:
        typer.echo(HELIX_NOTE)
    for order, figures in solved.step_totals.items():
        print_table([f"step diagonals {order}", "value", "U (k = 2)", "unit"], _step_rows(figures))
    if solved.step_totals:
        typer.echo(STEP_NOTE)


def _helix_names(solved: Solved, labels: list[str]) -> list[str]:
    return [f"{n} ({_helix_unit(n)[1]})" for n in solved.helices[labels[0]].estimate.names]


def _figure(value: float) -> str:
    return f"{value:.2f}".replace("-0.00", "0.00") if abs(value) < 0.005 else f"{value:.2f}"


def _tables(solution: SolutionFile) -> None:
    if solution.tables:
        headings = ["error of distances left by this table (± U, k = 2)", "numbers", "rms (µm)", "95 % below (µm)", "largest (µm)"]
        rows = []
        for t in solution.tables:
            figures = ((t.rms_um, t.u_rms_um), (t.q95_um, t.u_q95_um), (t.max_um, t.u_max_um))
            rows.append([t.kind, str(t.entries), *(f"{value:.2f} ± {2 * u:.2f}" for value, u in figures)])
        print_table(headings, rows)
    if solution.monte_carlo is not None:
        typer.echo(solution.monte_carlo.text)


def _helix_unit(name: str) -> tuple[float, str]:
    return (1e3, "µm") if name.startswith(("offset", "bar", "backlash")) else (1e6, "µm/m" if name[0] == "E" else "µrad")


def _helix_row(estimate: Any) -> list[str]:
    scales = {n: _helix_unit(n)[0] for n in estimate.names}
    return [f"{estimate.value(n) * f:.1f} ± {2 * estimate.u(n) * f:.1f}" for n, f in scales.items()]


def _step_rows(figures: dict[str, float]) -> list[list[str]]:
    """Return table rows of the step-diagonal figures. Each key ends in its unit; ``u_`` + key holds its standard uncertainty."""
    rows = []
    for key in (k for k in figures if not k.startswith("u_")):
        name, _, unit = key.rpartition("_")
        rows.append([name.replace("_", " "), f"{figures[key]:.2f}", f"{2 * figures['u_' + key]:.2f}", {"um": "µm", "urad": "µrad"}[unit]])
    return rows
