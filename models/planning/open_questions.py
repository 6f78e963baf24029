"""What a planned campaign cannot tell, in words, before anything is measured."""

from __future__ import annotations

from collections.abc import Iterable

from abbe.models.planning.information import Problem
from abbe.models.solvers.assessment import observability
from abbe.models.solvers.observations import RunData


def not_observable(what: Problem, runs: Iterable[RunData]) -> tuple[str, ...]:
    """Sentences about what the runs of a plan leave open, with cause and cure, in the words of the solver's own report.

    First what would stay hidden in the work with this tool, then what only another tool would show, then what to add.
    """
    tools = what.tools
    found = observability(
        what.machine,
        tuple(runs),
        terms=what.terms,
        priors=what.priors,
        sigma_mm={"bar": tools.bar_noise_mm, "laser": tools.laser_noise_mm},
        floor_mm={"bar": tools.floor_mm, "laser": tools.floor_mm},
    )
    out = [g.text for g in found.hidden if not g.harmless]
    silent = sum(g.count for g in found.hidden if g.harmless)
    if silent:
        tool = ", ".join(f"{v:g}" for v in what.machine.tool_mm)
        out.append(
            f"What {silent} of the error motions' {len(what.terms)} degrees of freedom do is not seen: they move nothing with the tool "
            f"({tool}) mm, but do with another. All of this holds for this tool length only."
        )
    return (*out, *(a.text for a in found.advice))
