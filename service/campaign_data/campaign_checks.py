"""Check every run of a campaign before a solution. Each issue is one line: the run, the mistake and the remedy.

The checks are geometry (are the points where the set-up says?), times, copies, and consistency of the readings with the other runs
(`abbe.models.solvers.plausibility`). An issue either refuses the campaign or becomes a flag beside the result.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from abbe.models.machine import Machine
from abbe.models.solvers.observations import RunData
from abbe.models.solvers.plausibility import SuspectRun, suspects
from abbe.service.campaign_data.run_geometry import geometry_mistake
from abbe.service.domain.document import Doc
from abbe.service.domain.run import BarSetup, Run
from abbe.service.errors import CampaignRefused


@dataclass(frozen=True, slots=True)
class CampaignIssue:
    """One mistake in one run, or in two runs that contradict each other.

    ``refuse``: the campaign must not be solved; otherwise the issue is a flag beside the result.
    """

    run: str
    what: str
    remedy: str
    refuse: bool

    @property
    def line(self) -> str:
        """Run, mistake and remedy in one line."""
        return f"run {self.run}: {self.what} - {self.remedy}"


FASTEST = 0.2
"""Smallest plausible ratio of a run's duration to the duration at its feed: a smaller one means a wrong unit of t_s or a wrong feed."""
SLOWEST = {"ballbar": 10.0, "laser": 200.0}
"""Largest ratio of a run's duration to the duration at its feed: a ball-bar run moves steadily, a laser run stops at every point."""
OVERLAP = 0.1
"""Largest allowed overlap of two runs as a share of the shorter one: clocks are not set to the second."""
TIME_UNITS = {1e3: "t_s holds ms", 1.0 / 60.0: "t_s holds minutes"}


def time_issues(runs: Sequence[Run]) -> list[CampaignIssue]:
    """Return flags of runs whose clocks disagree, whose t_s does not fit their feed, or which overlap other runs.

    Runs of files without times are not judged.
    """
    runs = [run for run in runs if not run.timing.counted]
    out = [f for run in runs for f in (*_clocks(run), *_against_feed(run))]
    known = {f.run for f in out}
    return out + _overlaps([r for r in runs if r.run_id not in known])


def _clocks(run: Run) -> list[CampaignIssue]:
    """Return the disagreement of a run's clocks, if any (`abbe.service.runs.sample_columns`)."""
    trouble = run.timing.trouble
    return [CampaignIssue(run.run_id, trouble, "look at the sync cable and the links, then measure it again", False)] if trouble else []


def _against_feed(run: Run) -> list[CampaignIssue]:
    points, t, feed = run.columns.q_mm, run.columns.t_s, run.columns.feed_mm_min
    if len(points) < 2 or not all(np.isfinite(v).all() for v in (points, t, feed)) or feed.min() <= 0.0:
        return []
    wanted = float((np.linalg.norm(np.diff(points, axis=0), axis=1) * 60.0 / feed[1:]).sum())
    if wanted <= 0.0:
        return []
    waited = np.sort(np.diff(t))[::-1][: len(run.timing.pieces)].sum()  # pauses between the pieces of a path
    ratio, slowest = float(t[-1] - t[0] - waited) / wanted, SLOWEST["ballbar" if run.is_bar else "laser"]
    if FASTEST <= ratio <= slowest:
        return []
    unit = next((text for factor, text in TIME_UNITS.items() if FASTEST <= ratio / factor <= slowest), "t_s or feed_mm_min is wrong")
    what = f"it took {ratio:.2g} times as long as its path takes at its feed_mm_min: {unit}"
    return [
        CampaignIssue(
            run.run_id, what, "write t_s in s of the campaign's clock and feed_mm_min in mm/min: Abbe needs them to judge drift", False
        )
    ]


def _overlaps(runs: Sequence[Run]) -> list[CampaignIssue]:
    """Flag runs whose times overlap: flag the run with the most overlaps, leave it out, and repeat until no overlap remains."""
    spans = {r.run_id: (float(r.columns.t_s[0]), float(r.columns.t_s[-1])) for r in runs if len(r.columns)}
    spans = {k: v for k, v in spans.items() if np.isfinite(v).all()}
    meets = {k: [m for m in spans if m != k and _share(spans[k], spans[m]) > OVERLAP] for k in spans}
    out = []
    while any(meets.values()):
        worst = max(meets, key=lambda k: len(meets[k]))
        others = meets.pop(worst)
        meets = {k: [m for m in v if m != worst] for k, v in meets.items()}
        what = f"its times (t_s) lie within the times of {_named(others)}: one machine cannot measure two runs at a time"
        out.append(CampaignIssue(worst, what, "write t_s in s of one clock for the whole campaign: Abbe needs this to judge drift", False))
    if len(out) > 1 and 2 * len(out) >= len(spans):
        what = f"its t_s and those of {len(out)} other runs overlap: every run seems to have a clock of its own"
        return [CampaignIssue(next(iter(spans)), what, out[0].remedy, False)]
    return out


def _share(a: tuple[float, float], b: tuple[float, float]) -> float:
    """Return the common time of two spans as a share of the shorter one."""
    shorter = min(a[1] - a[0], b[1] - b[0])
    return (min(a[1], b[1]) - max(a[0], b[0])) / shorter if shorter > 0.0 else 0.0


def _named(others: list[str]) -> str:
    return f"run {others[0]}" if len(others) == 1 else f"{len(others)} other runs ({others[0]}, ...)"


OTHER_FEED = 0.3
"""Largest relative difference between the stated feed of a ball-bar run and the median feed from its positions and times. Beyond it the
column is wrong."""
AGREE, ALIKE = 0.65, 4
"""Smallest share of runs whose direction agrees with their sense of rotation, and smallest number of runs of one kind: from these on the
column of the other runs is wrong."""


def column_issues(runs: Sequence[Run]) -> list[CampaignIssue]:
    """Flag ball-bar runs whose feed_mm_min or direction contradicts their positions and times; the search then uses positions and times."""
    out = []
    senses: dict[tuple[str, int], dict[str, float]] = {}
    for run in runs:
        if isinstance(run.setup, BarSetup) and len(run.columns) > 1:
            out += _feed_of_path(run)
            u = run.columns.q_mm - run.setup.centre_mm
            around = np.cross(u[:-1], u[1:]).sum(axis=0)
            axis = int(np.argmax(np.abs(around)))
            senses.setdefault((run.test, axis), {})[run.run_id] = float(np.sign(around[axis]) * np.median(run.columns.direction))
    for sense in senses.values():
        usual = float(np.sign(sum(sense.values())))
        if len(sense) >= ALIKE and sum(s * usual > 0.0 for s in sense.values()) >= AGREE * len(sense):
            what = "its column direction contradicts the sense of rotation of its positions; the two agree in the other runs of this kind"
            remedy = "correct the column; the search uses the positions"
            out += [CampaignIssue(name, what, remedy, False) for name, s in sense.items() if s * usual < 0.0]
    return out


def _feed_of_path(run: Run) -> list[CampaignIssue]:
    took, feed = np.diff(run.columns.t_s), float(np.median(run.columns.feed_mm_min))
    if not ((took > 0.0).all() and feed > 0.0) or _against_feed(run):
        return []
    driven = float(np.median(60.0 * np.linalg.norm(np.diff(run.columns.q_mm, axis=0), axis=1) / took))
    if driven <= 0.0 or abs(driven / feed - 1.0) <= OTHER_FEED:
        return []
    what = f"feed_mm_min states {feed:.0f}, but its positions and times give {driven:.0f} mm/min, which is used"
    return [CampaignIssue(run.run_id, what, "correct the column, or replace it by the column of the right run", False)]


COPIED_SHARE = 0.98
"""A run with at least this share of equal readings at equal positions is a copy: noise differs every time."""
VISIBLE_STEPS = 2.0
"""Rms second difference of the readings, in sensor steps, above which they show noise: rounding alone gives 0.7."""
NOTHING_MM = 1e-9


def copy_issues(runs: Sequence[Run]) -> list[CampaignIssue]:
    """Return issues of runs whose readings occur in an earlier run, regardless of their labels.

    If the readings show noise, equal readings are a copy whatever their times. Without noise (coarse sensor) even repeats can be equal:
    then only readings at the same times are a copy.
    """
    rows = [_rows(r) for r in runs]
    out = []
    for k, run in enumerate(runs):
        for j in range(k):
            if _copied(rows[j], rows[k]) and (_shows_noise(run) or _copied(_timed(runs[j], rows[j]), _timed(run, rows[k]))):
                what = f"its readings are the same as in run {runs[j].run_id}: one measurement would count twice"
                out.append(CampaignIssue(run.run_id, what, "leave it out (--without), or export it again", True))
                break
    return out


def _copied(one: Counter[Any], other: Counter[Any]) -> bool:
    """Whether nearly all rows of the shorter run occur in the other, equally often."""
    shorter = min(one.total(), other.total())
    return shorter > 0 and (one & other).total() >= COPIED_SHARE * shorter


def _rows(run: Run) -> Counter[Any]:
    """Count the readings by position and deviation, in steps of 10 nm and 0.01 nm; empty for a run with constant deviations."""
    y = run.columns.readings_mm
    if y.size == 0 or not np.isfinite(y).all() or float(np.ptp(y)) == 0.0:
        return Counter()
    steps = ((y, 1e8), *((along, 1e5) for along in run.columns.q_mm.T))
    return Counter(zip(*(np.rint(v * n).tolist() for v, n in steps), strict=True))


def _timed(run: Run, rows: Counter[Any]) -> Counter[Any]:
    """Count the readings by time, ms, and deviation."""
    columns = run.columns
    return Counter(zip(np.rint(columns.t_s * 1e3).tolist(), columns.readings_mm.tolist(), strict=True)) if rows else rows


def _shows_noise(run: Run) -> bool:
    """Whether the readings show noise, so that a repeated measurement would differ.

    Sign of noise: readings differ at places visited again or, without such places, their second differences exceed those from rounding.
    """
    y, columns = run.columns.readings_mm, run.columns
    states = map(tuple, np.column_stack([columns.q_mm, columns.direction]).tolist())
    places: dict[Any, list[float]] = {}
    for state, v in zip(states, y.tolist(), strict=True):
        places.setdefault(state, []).append(v)
    again = np.concatenate([np.diff(v) for v in places.values()])
    if again.size >= max(4, y.size // 4):
        return bool(np.mean(np.abs(again) > NOTHING_MM) > 0.5)
    steps = np.diff(np.unique(y))
    steps = steps[steps > NOTHING_MM]
    return bool(y.size > 2 and steps.size and np.sqrt(np.mean(np.diff(y, 2) ** 2)) > VISIBLE_STEPS * steps.min())


LARGEST_MM = 2.0
"""Largest plausible deviation: if many are larger, the unit is wrong; single larger ones are outliers."""
NO_READING_MM = 1000.0
"""No instrument can read a deviation this large, not even as a spike."""
SPIKES = 0.05
"""Largest share of a run's readings that can be single outliers."""
HALF = 0.5
FEWEST_BAR = 20
PER_TURN = 8
OTHER_RATIO = 8.0
"""A run is from another machine if its misfit exceeds `OTHER_MM` and this multiple of the expected misfit; a smaller misfit is a flag."""
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
        The message states the first such issue, and names the runs with further issues.
    """
    bad = [f for f in issues if f.refuse]
    if bad:
        runs = sorted({f.run for f in bad[1:]})
        noun, where = f"issue{'s' * (len(bad) > 2)}", f"run{'s' * (len(runs) > 1)} {', '.join(runs)}"
        more = f" (and {len(bad) - 1} more {noun}, in {where})" if runs else ""
        raise CampaignRefused(f"run {bad[0].run}: {bad[0].what}{more}", f"{bad[0].remedy}; nothing was stored")


def artefact_issues(machine: Doc, runs: Sequence[Run]) -> list[CampaignIssue]:
    """Return the issues of runs of artefacts that are found without a model: machine, positions."""
    return [issue for run in runs for issue in _other_machine(machine, run) or geometry_issues(machine, run)]


def check_files(machine: Doc, runs: Sequence[Run]) -> list[CampaignIssue]:
    """Return the issues that are found without a model: machine, geometry, units, times, copies, too few readings.

    ``machine``: the campaign's machine object; ``runs``: its runs with readings.
    """
    out = _twice([r.run_id for r in runs])
    for run in runs:
        out += _other_machine(machine, run) or geometry_issues(machine, run)
        out += _readings(run)
    return _nothing_measured(runs) + out + time_issues(runs) + column_issues(runs) + copy_issues(runs)


def _nothing_measured(runs: Sequence[Run]) -> list[CampaignIssue]:
    """Return issues of runs with constant readings: refused if all runs are constant, otherwise flagged."""
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
    """Return the issues of a run with points that do not lie where its set-up says, or that lie outside the strokes."""
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
            what = f"measured on another machine: {title} {_short(other)}, the campaign states {_short(ours)}"
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
    """Return the issues of times, size and number of one run's readings."""
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
    """Return the issue if too many deviations are too large: another unit, or a lost beam or bar. Robust weights handle single outliers."""
    size = np.where(valid, np.abs(y), 0.0)
    count, of, largest = int((size > LARGEST_MM).sum()), int(valid.sum()), float(size.max(initial=0.0))
    if largest > NO_READING_MM:
        row = int(np.argmax(size)) + 1
        return [
            CampaignIssue(
                label, f"{y[row - 1]:.3g} mm in row {row} is not a reading", "mark it with valid 0, or write deviation_mm in mm", True
            )
        ]
    if count > HALF * of:
        return [CampaignIssue(label, f"deviations up to {largest:.3g} mm: they look like µm", "write deviation_mm in mm", True)]
    if count > max(SPIKES * of, 1):
        seen = f"{count} of {of} readings are beyond {LARGEST_MM:g} mm, up to {largest:.3g} mm"
        what = f"{seen}: the unit is µm, or the bar or the beam was lost"
        return [CampaignIssue(label, what, "write deviation_mm in mm, or mark the lost readings with valid 0", True)]
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
        f"only {count} valid readings on {turns:g} turns, expected {wanted} or more: "
        "the fit of cup position, bar length and lost motion leaves too few for the errors of the machine"
    )
    return [CampaignIssue(run.run_id, what, "measure it again with a higher rate", False)]


def check_readings(machine: Machine, data: Sequence[RunData]) -> list[CampaignIssue]:
    """Return issues of runs whose readings contradict the other runs (`abbe.models.solvers.plausibility.suspects`)."""
    found = suspects(machine, data)
    return [_suspect(s, single=len(found) == 1) for s in found]


def _suspect(s: SuspectRun, *, single: bool) -> CampaignIssue:
    gross = s.misfit_mm > OTHER_RATIO * s.expected_mm and s.misfit_mm > OTHER_MM
    if s.tied:
        who = " or ".join(("it", *(f"run {name}" for name in s.tied)))
        what = f"contradicts the others ({_misfit(s)}); these runs cannot show whether {who} is wrong"
        return CampaignIssue(s.run, what, "measure them again", gross or s.cause != "other")
    if s.cause != "other":
        return CampaignIssue(s.run, f"{_READINGS[s.cause]} ({_misfit(s)})", "correct the file, or leave it out (--without)", True)
    if single and gross:
        what = f"fits none of the other runs ({_misfit(s)}), which fit each other: another machine, tool or table"
        return CampaignIssue(s.run, what, "leave it out (--without), or measure it again", True)
    what = f"does not fit the other runs ({_misfit(s)}): the machine changed, or its set-up or tool is not as stated"
    return CampaignIssue(s.run, what, "look at its residuals; measure it again, or leave it out (--without)", False)


def _misfit(s: SuspectRun) -> str:
    return f"off by {s.misfit_mm * 1e3:.2g} µm rms, expected {s.expected_mm * 1e3:.2g} µm"
