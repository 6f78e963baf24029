"""Verification: figures of runs that were not used to identify, before against after, and against limits."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from models.verification import Figure, diagonal_figure, helix_figure
from service.errors import MeasurementFault
from service.runs.observations import run_data

COVERAGE = 2.0
WORSE_SHARE = 0.1
"""Any figure may get worse by its expanded uncertainty plus this share: of the worst diagonal before (diagonals), of itself (helix)."""

DIAGONALS = frozenset({"ppp", "npp", "pnp", "ppn"})

Verdict = Literal["pass", "fail", "cannot tell"]


@dataclass(frozen=True)
class Figures:
    """What one verification measured: body diagonals by name, and the helix."""

    diagonals: Mapping[str, Figure]
    helix: Figure | None

    @property
    def worst(self) -> Figure:
        """The body diagonal with the largest range."""
        return max(self.diagonals.values(), key=lambda f: f.value_mm)


def figures(runs: list[dict[str, Any]]) -> Figures:
    """Figures of a verification's runs (``abbe-run/1`` objects): plain body diagonals and at most one helix.

    Raises
    ------
    MeasurementFault
        Not all four body diagonals are there, or a run has too few valid readings.
    """
    diagonals, helix = {}, None
    for run in runs:
        if run["test"] == "laser_diagonal" and not run["setup"].get("order"):
            try:
                diagonals[str(run["setup"]["diagonal"])] = diagonal_figure(run_data(run))
            except ValueError as error:
                raise MeasurementFault(str(error), "measure it again") from None
        elif run["test"] == "ballbar_helix":
            helix = helix_figure(run_data(run))
    if set(diagonals) != DIAGONALS:
        lost = ", ".join(sorted(DIAGONALS - set(diagonals)))
        raise MeasurementFault(
            f"these runs are no verification: body diagonal {lost} is missing", "measure the verification campaign again"
        )
    return Figures(diagonals, helix)


@dataclass(frozen=True, slots=True)
class Decision:
    """Keep the new table or go back, and why."""

    keep: bool
    text: str


def _expanded(a: Figure, b: Figure) -> float:
    return COVERAGE * float(np.hypot(a.u_mm, b.u_mm))


def decide(before: Figures, after: Figures) -> Decision:
    """Keep only if the worst diagonal improved by more than its expanded uncertainty and no other figure got worse (reliability.md H11).

    "Worse" is more than the expanded uncertainty of the difference plus `WORSE_SHARE`: a diagonal that happened to be good because errors
    cancelled may come closer to the others, but only by a small part of what the worst one was.
    """
    worst = before.worst.value_mm
    gain, needed = worst - after.worst.value_mm, _expanded(before.worst, after.worst)
    change = f"worst body diagonal {worst * 1e3:.1f} → {after.worst.value_mm * 1e3:.1f} µm"
    if gain <= needed:
        return Decision(False, f"{change}: no improvement beyond its uncertainty of {needed * 1e3:.1f} µm")
    if (before.helix is None) != (after.helix is None):
        return Decision(False, f"{change}, but the helix was measured only once: the rest cannot be judged")
    pairs = [(f"diagonal {k}", before.diagonals[k], after.diagonals[k], worst) for k in sorted(DIAGONALS)]
    if before.helix is not None and after.helix is not None:
        pairs.append(("helix", before.helix, after.helix, before.helix.value_mm))
    for name, old, new, scale in pairs:
        worse = new.value_mm - old.value_mm
        if worse > _expanded(old, new) + WORSE_SHARE * scale:
            return Decision(False, f"{name} got worse by {worse * 1e3:.1f} µm, although the worst diagonal improved")
    return Decision(True, f"{change} (U = {needed * 1e3:.1f} µm)")


def judge(value_um: float, u_um: float, limit_um: float) -> Verdict:
    """Guard-banded verdict: pass below limit - U, fail above limit + U, else cannot tell (U = 2 u; ISO 14253-1)."""
    expanded = COVERAGE * u_um
    if value_um + expanded <= limit_um:
        return "pass"
    return "fail" if value_um - expanded > limit_um else "cannot tell"


def overall(verdicts: list[Verdict]) -> Verdict:
    """The worst of several verdicts; nothing judged is "cannot tell"."""
    if "fail" in verdicts:
        return "fail"
    return "cannot tell" if "cannot tell" in verdicts or not verdicts else "pass"


def figure_rows(found: Figures) -> dict[str, tuple[float, float]]:
    """Figures as (value, standard uncertainty) in µm, by the names used in limits, JSON and reports."""
    rows = {f"diagonal_{k}_um": (f.value_mm * 1e3, f.u_mm * 1e3) for k, f in found.diagonals.items()}
    rows["body_diagonal_um"] = (found.worst.value_mm * 1e3, found.worst.u_mm * 1e3)
    if found.helix is not None:
        rows["helix_rms_um"] = (found.helix.value_mm * 1e3, found.helix.u_mm * 1e3)
    return rows
