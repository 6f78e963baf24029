"""Check every run of a campaign before a solution. Each issue is one line: the run, the mistake and the remedy.

The checks are geometry (are the points where the set-up says?), copies, and consistency of the readings with the other runs
(`abbe.models.solvers.plausibility`). An issue either refuses the campaign or becomes a flag beside the result.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from abbe.models.machine import Machine
from abbe.models.solvers.observations import RunData
from abbe.models.solvers.plausibility import SuspectRun, suspects
from abbe.service.campaign_data.campaign_issue import CampaignIssue
from abbe.service.campaign_data.copied_runs import copy_issues
from abbe.service.campaign_data.run_geometry import geometry_mistake
from abbe.service.campaign_data.run_times import time_issues
from abbe.service.domain.document import Doc
from abbe.service.domain.run import BarSetup, Run
from abbe.service.errors import CampaignRefused

LARGEST_MM = 2.0
"""Largest plausible deviation: many larger numbers are in another unit, single ones are outliers."""
NO_READING_MM = 1000.0
"""No instrument can read a deviation this large, not even as a spike."""
SPIKES = 0.05
"""Largest share of a run's readings that can be single outliers."""
HALF = 0.5
FEWEST_BAR = 20
PER_TURN = 8
OTHER_RATIO = 8.0
"""A run whose misfit exceeds this multiple of the expected one, and `OTHER_MM`, is from another machine; a smaller misfit is a flag."""
OTHER_MM = 4e-3

_READINGS = {
    "um": "its deviations fit the other runs when divided by 1000: deviation_mm holds µm",
    "inch": "its deviations fit the other runs when multiplied by 25.4: deviation_mm holds inches",
    "sign": "its deviations fit the other runs with the other sign",
    "mm_as_um": "its deviations fit the other runs when multiplied by 1000: deviation_mm holds m, or was divided once too often",
    "mm_as_inch": "its deviations fit the other runs when divided by 25.4: deviation_mm was multiplied by 25.4 once too often",
    "swap_xy": "its deviations fit the other runs with the columns x_mm and y_mm exchanged",
    "swap_yz": "its deviations fit the other runs with the columns y_mm and z_mm exchanged",
    "swap_xz": "its deviations fit the other runs with the columns x_mm and z_mm exchanged",
}


def refuse(issues: Sequence[CampaignIssue]) -> None:
    """Raise if an issue refuses the campaign.

    Raises
    ------
    CampaignRefused
        The first such issue, and the runs with further ones.
    """
    bad = [f for f in issues if f.refuse]
    if bad:
        more = f" (and {len(bad) - 1} more: {', '.join(sorted({f.run for f in bad[1:]}))})" if len(bad) > 1 else ""
        raise CampaignRefused(f"run {bad[0].run}: {bad[0].what}{more}", f"{bad[0].remedy}; nothing was stored")


def check_files(machine: Doc, runs: Sequence[Run]) -> list[CampaignIssue]:
    """Issues that need no model: machine, geometry, units, times, copies, too few readings.

    ``machine``: the campaign's machine object; ``runs``: with readings.
    """
    out = _twice([r.run_id for r in runs])
    for run in runs:
        out += _other_machine(machine, run) or geometry_issues(machine, run)
        out += _readings(run)
    return _nothing_measured(runs) + out + time_issues(runs) + copy_issues(runs)


def _nothing_measured(runs: Sequence[Run]) -> list[CampaignIssue]:
    """Runs with constant readings: refused if all runs are constant, otherwise flagged."""
    still = [r.run_id for r in runs if _constant(r)]
    if not still:
        return []
    if len(still) == len(runs):
        what = "in this run and all others every reading is the same: nothing was measured"
        return [CampaignIssue(still[0], what, "export the runs again, with their readings", True)]
    return [CampaignIssue(n, "all its readings are the same: nothing was measured", "leave it out (--without)", False) for n in still]


def _constant(run: Run) -> bool:
    y = run.columns.readings_mm
    return bool(y.size and (y == y[0]).all())


def geometry_issues(machine: Doc, run: Run) -> list[CampaignIssue]:
    """Issues of a run whose points do not lie where its set-up says, or not inside the strokes."""
    what = geometry_mistake(machine, run)
    return [CampaignIssue(run.run_id, what.text, what.remedy, what.refuse)] if what else []


def _twice(names: list[str]) -> list[CampaignIssue]:
    twice = sorted({n for n in names if names.count(n) > 1})
    return [CampaignIssue(n, "two runs have this run_id", "give each run its own", True) for n in twice]


def _other_machine(machine: Doc, run: Run) -> list[CampaignIssue]:
    theirs = run.machine
    for key, title in (("name", "name"), ("chain", "chain"), ("stroke_mm", "strokes"), ("pivots_mm", "pivots"), ("tool_mm", "tool")):
        ours, other = machine.get(key), theirs.get(key)
        if ours is not None and other is not None and not _same(ours, other):
            what = f"measured on another machine: {title} {_short(other)}, the campaign's is {_short(ours)}"
            return [CampaignIssue(run.run_id, what, "leave it out (--without), or correct its machine object", True)]
    return []


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, dict) and isinstance(b, dict):
        return all(_same(a.get(k), b.get(k)) for k in a.keys() | b.keys() if a.get(k) is not None and b.get(k) is not None)
    if isinstance(a, list | tuple) and isinstance(b, list | tuple):
        return len(a) == len(b) and all(_same(x, y) for x, y in zip(a, b, strict=True))
    if isinstance(a, int | float) and isinstance(b, int | float):
        return abs(a - b) <= 1e-6
    return bool(a == b)


def _short(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{k} {_short(v)}" for k, v in value.items())
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_short(v) for v in value) + "]"
    return f"{value:g}" if isinstance(value, int | float) else repr(value)


def _readings(run: Run) -> list[CampaignIssue]:
    """Issues of times, size and number of one run's readings."""
    label, y, t, valid = run.run_id, run.columns.readings_mm, run.columns.t_s, run.columns.valid
    if not (np.isfinite(y[valid]).all() and np.isfinite(t).all()):
        return [
            CampaignIssue(
                label, "a reading or a time is not a finite number", "mark it with valid 0 or leave the run out (--without)", True
            )
        ]
    if (np.diff(t) < 0).any():
        row = int(np.argmax(np.diff(t) < 0)) + 2
        return [CampaignIssue(label, f"t_s runs back at row {row}", "put the rows in the order in which they were measured", True)]
    return _too_large(label, y, valid) + _too_few(run, int(valid.sum()))


def _too_large(label: str, y: NDArray[np.float64], valid: NDArray[np.bool_]) -> list[CampaignIssue]:
    """Impossible deviations: most of them mean another unit, some a lost beam or bar; robust weights handle single ones."""
    size = np.where(valid, np.abs(y), 0.0)
    count, of, largest = int((size > LARGEST_MM).sum()), int(valid.sum()), float(size.max(initial=0.0))
    if largest > NO_READING_MM:
        row = int(np.argmax(size)) + 1
        return [
            CampaignIssue(
                label, f"{y[row - 1]:.3g} mm in row {row} is no reading", "mark it with valid 0, or write deviation_mm in mm", True
            )
        ]
    if count > HALF * of:
        return [CampaignIssue(label, f"deviations up to {largest:.3g} mm: they look like µm", "write deviation_mm in mm", True)]
    if count > max(SPIKES * of, 1):
        what = f"{count} of {of} readings are beyond {LARGEST_MM:g} mm, up to {largest:.3g} mm: µm, or the bar or the beam was lost"
        return [CampaignIssue(label, what, "write deviation_mm in mm, or mark what was lost with valid 0", True)]
    return []


def _too_few(run: Run, count: int) -> list[CampaignIssue]:
    """Flag a ball-bar run with few readings; `abbe.service.runs.observations` refuses fewer than 10."""
    if not isinstance(run.setup, BarSetup):
        return []
    turns = run.setup.turns or 1.0
    wanted = max(FEWEST_BAR, int(np.ceil(PER_TURN * turns)))
    if not 10 <= count < wanted:
        return []
    what = (
        f"only {count} valid readings on {turns:g} turns: cup, bar length and lost motion take most of what they tell ({wanted} are needed)"
    )
    return [CampaignIssue(run.run_id, what, "measure it again with a higher rate", False)]


def check_readings(machine: Machine, data: Sequence[RunData]) -> list[CampaignIssue]:
    """Issues of runs whose readings contradict the other runs (`abbe.models.solvers.plausibility.suspects`)."""
    found = suspects(machine, data)
    return [_suspect(s, alone=len(found) == 1) for s in found]


def _suspect(s: SuspectRun, *, alone: bool) -> CampaignIssue:
    gross = s.misfit_mm > OTHER_RATIO * s.expected_mm and s.misfit_mm > OTHER_MM
    if s.tied:
        who = " or ".join(("it", *(f"run {name}" for name in s.tied)))
        what = f"contradicts the others ({_misfit(s)}); whether {who} is wrong, these runs cannot tell"
        return CampaignIssue(s.run, what, "measure them again", gross or s.cause != "other")
    if s.cause != "other":
        return CampaignIssue(s.run, f"{_READINGS[s.cause]} ({_misfit(s)})", "correct the file, or leave it out (--without)", True)
    if alone and gross:
        what = f"fits none of the other runs ({_misfit(s)}), which fit each other: another machine, tool or table"
        return CampaignIssue(s.run, what, "leave it out (--without), or measure it again", True)
    what = f"does not fit the other runs ({_misfit(s)}): the machine changed, or its set-up or tool is not what it says"
    return CampaignIssue(s.run, what, "look at its residuals; measure it again, or leave it out (--without)", False)


def _misfit(s: SuspectRun) -> str:
    return f"off by {s.misfit_mm * 1e3:.2g} µm rms where {s.expected_mm * 1e3:.2g} are expected"
