"""Verification: figures of runs that identification did not use, compared before and after a push, judged against limits; and the check
as a document: the same for the store, for MQTT, for the status page and for JSON clients."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from abbe.drivers.errors import DriverError
from abbe.models.verification import VerificationFigure, diagonal_figure, helix_figure, pose_figure, reversal_figure, same_pose
from abbe.service.config_schema import MachineFile
from abbe.service.domain.run import ArtefactSetup, Run
from abbe.service.domain.schedule import Schedule
from abbe.service.domain.verification import CheckFailure, CheckResult, Verdict
from abbe.service.errors import AbbeError, MeasurementFault, TableRefused
from abbe.service.runs.coverage import check_judged
from abbe.service.runs.observations import run_data

if TYPE_CHECKING:
    from abbe.models.solvers.joint import JointSolution

COVERAGE = 2.0
WORSE_SHARE = 0.1
"""Share by which a figure may get worse in addition to its U: a diagonal and its reversal by this share of the worst diagonal before the
push, a helix by this share of its own value before."""

SAME_AIR_C = 1.0
"""Largest range of air temperature over all readings before and after: steel and iron grow by 11 to 12 um per metre and kelvin, which is
the size of a correction. An assumption of this service: without sensors in the castings their temperature is unknown."""

DIAGONALS = frozenset({"ppp", "npp", "pnp", "ppn"})

NAMES = {"body_diagonal_um": "worst body diagonal", "helix_rms_um": "helix rms", "reversal_um": "worst mean reversal"}
"""Figures of a check that texts name, by their key."""
MARK = {"pass": "within limits", "fail": "out of limits", "cannot tell": "too close to a limit to tell"}
SCHEMA = 1
"""Version of the documents of checks. It rises when a key changes its meaning or disappears, not for new keys."""


@dataclass(frozen=True)
class VerificationFigures:
    """Figures of one verification. ``diagonals``: body diagonals or, as ``of`` states, poses of an artefact, by name. ``reversals``: mean
    reversal values of the body diagonals, by name.

    ``air_c``: lowest and highest air temperature, None without any reading. ``tables``: CRC of every table that was active during its runs;
    None stands for a run that does not record it.
    """

    diagonals: Mapping[str, VerificationFigure]
    helix: VerificationFigure | None
    air_c: tuple[float, float] | None = None
    tables: frozenset[int | None] = frozenset()
    of: Literal["body diagonal", "pose"] = "body diagonal"
    reversals: Mapping[str, VerificationFigure] = field(default_factory=dict)

    @property
    def finite(self) -> bool:
        """Whether every figure and every uncertainty is a number."""
        every = [*self.diagonals.values(), *self.reversals.values(), *([self.helix] if self.helix is not None else [])]
        return all(np.isfinite(f.value_mm) and np.isfinite(f.u_mm) for f in every)

    @property
    def worst(self) -> VerificationFigure:
        """The body diagonal with the largest range, or the worst pose."""
        return max(self.diagonals.values(), key=lambda f: f.value_mm)

    @property
    def reversal(self) -> VerificationFigure | None:
        """The largest mean reversal value of a body diagonal; None for poses of an artefact."""
        return max(self.reversals.values(), key=lambda f: f.value_mm, default=None)


def figures(runs: list[Run], room_c: tuple[float, float] | None = None) -> VerificationFigures:
    """Figures of a verification's runs: plain body diagonals and at most one helix.

    ``room_c``: lowest and highest air temperature that a person states for the room, used where no run recorded one.

    Raises
    ------
    MeasurementFault
        A body diagonal is missing, or a run is not judged (`abbe.service.runs.coverage`) or has too few valid readings.
    """
    diagonals, reversals, helix = {}, {}, None
    for run in runs:
        if run.test == "laser_diagonal" and not run.laser.order and not run.laser.face:
            check_judged(run)
            data, turning_mm = run_data(run), run.laser.ends_mm if run.laser.overrun_mm else ()
            try:
                diagonals[run.laser.diagonal] = diagonal_figure(data, turning_mm)
                reversals[run.laser.diagonal] = reversal_figure(data, turning_mm)
            except ValueError as error:
                raise MeasurementFault(str(error), "measure it again") from None
        elif run.test == "ballbar_helix":
            check_judged(run)
            helix = helix_figure(run_data(run))
    if set(diagonals) != DIAGONALS:
        lost = ", ".join(sorted(DIAGONALS - set(diagonals)))
        raise MeasurementFault(
            f"these runs are not a verification: body diagonal {lost} is missing", "measure the verification campaign again"
        )
    air_c, tables = _air_c(runs) or room_c, frozenset(run.table.crc for run in runs)
    return VerificationFigures(diagonals, helix, air_c, tables, reversals=reversals)


def pose_figures(runs: list[Run], known: JointSolution, room_c: tuple[float, float] | None = None) -> VerificationFigures:
    """Figures of artefacts whose form the solution ``known`` contains, in poses that it did not use; ``room_c`` as in `figures`.

    Raises
    ------
    MeasurementFault
        A run is not of an artefact of this solution, repeats one of its poses, or is not judged.
    """
    poses = {}
    for run in runs:
        check_judged(run)
        if not isinstance(run.setup, ArtefactSetup) or f"form_{run.setup.artefact}_" not in " ".join(known.estimate.names):
            raise MeasurementFault(
                f"run {run.run_id} is not of an artefact that the solution contains",
                "verify with the artefact of the identification, in a pose that the identification did not use",
            )
        data = run_data(run)
        if any(same_pose(data, used) for used in known.data):
            raise MeasurementFault(
                f"run {run.run_id} repeats a pose of the solution, where the fitted form of the artefact hides errors of the machine",
                "turn the artefact, or shift it by more than a few mm",
            )
        poses[run.run_id] = pose_figure(data, known)
    return VerificationFigures(poses, None, _air_c(runs) or room_c, frozenset(run.table.crc for run in runs), "pose")


def _air_c(runs: list[Run]) -> tuple[float, float] | None:
    air = [float(t) for run in runs for t in run.columns.air_c if np.isfinite(t)]
    return (min(air), max(air)) if air else None


def check_before(before: VerificationFigures) -> None:
    """Refuse a verification that cannot serve as the reference of a push, before anything is written.

    Raises
    ------
    TableRefused
        A figure is not a number, or no air temperature is recorded.
    """
    what, remedy = "", "measure it again"
    if not before.finite:
        what = "a figure is not a number"
    elif before.air_c is None:
        what, remedy = (
            "no air temperature was recorded",
            "measure with a laser's air sensor, or give room_temperature_c under [calibration]",
        )
    if what:
        raise TableRefused(f"the first verification is no basis for a comparison: {what}", f"{remedy}; nothing was written")


@dataclass(frozen=True, slots=True)
class VerificationDecision:
    """Whether to keep the new table, and why."""

    keep: bool
    text: str


def _expanded(a: VerificationFigure, b: VerificationFigure) -> float:
    return COVERAGE * float(np.hypot(a.u_mm, b.u_mm))


def incomparable(before: VerificationFigures, after: VerificationFigures, pushed_crc: int | None = None) -> str:
    """Reason why the verifications before and after cannot be compared; empty if they can.

    ``pushed_crc``: CRC of the new table; all runs of the later verification must have been measured with this table.
    """
    if not (before.finite and after.finite):
        return "a figure is not a number"
    if pushed_crc is not None and after.tables != {pushed_crc}:
        used = ", ".join(sorted("unrecorded" if crc is None else f"{crc:08X}" for crc in after.tables)) or "unrecorded"
        return f"the machine was measured with table {used}, but table {pushed_crc:08X} was brought into force"
    if before.air_c is None or after.air_c is None:
        return "the air temperature is not known"
    low, high = min(before.air_c[0], after.air_c[0]), max(before.air_c[1], after.air_c[1])
    if high - low > SAME_AIR_C:
        return f"the air was at {low:.1f} to {high:.1f} °C before and after, a range of more than {SAME_AIR_C:g} K"
    return ""


def decide(before: VerificationFigures, after: VerificationFigures, pushed_crc: int | None = None) -> VerificationDecision:
    """Keep a new table only if the worst diagonal improved by more than its expanded uncertainty and no other figure got worse.

    "Worse" is more than the expanded uncertainty of the difference plus `WORSE_SHARE`: a diagonal that was good because errors cancelled
    may come closer to the others, but only by a small share of the worst one. The table is not kept either if this cannot be decided: the
    two verifications cannot be compared (`incomparable`), or a figure is less certain than the gain.
    """
    why = incomparable(before, after, pushed_crc)
    if why:
        return VerificationDecision(False, f"cannot tell whether the machine is better: {why}")
    worst = before.worst.value_mm
    gain, needed = worst - after.worst.value_mm, _expanded(before.worst, after.worst)
    change = f"worst {before.of} {worst * 1e3:.1f} → {after.worst.value_mm * 1e3:.1f} µm"
    if gain <= needed:
        return VerificationDecision(False, f"{change}: no improvement beyond its uncertainty of {needed * 1e3:.1f} µm")
    if (before.helix is None) != (after.helix is None):
        return VerificationDecision(False, f"{change}, but only one of the two verifications has a helix: the helix cannot be compared")
    if before.diagonals.keys() != after.diagonals.keys():
        return VerificationDecision(False, f"{change}, but the two verifications do not have the same runs")
    kind = before.of.removeprefix("body ")
    pairs = [(f"{kind} {k}", before.diagonals[k], after.diagonals[k], worst) for k in sorted(before.diagonals)]
    if before.helix is not None and after.helix is not None:
        pairs.append(("helix", before.helix, after.helix, before.helix.value_mm))
    both = sorted(before.reversals.keys() & after.reversals.keys())
    pairs += [(f"mean reversal of {k}", before.reversals[k], after.reversals[k], worst) for k in both]
    for name, old, new, scale in pairs:
        if _expanded(old, new) > gain:
            blind = f"the {name} is uncertain by {_expanded(old, new) * 1e3:.1f} µm, more than the {gain * 1e3:.1f} µm that were gained"
            return VerificationDecision(False, f"{change}, but cannot tell whether something got worse: {blind}")
        worse = new.value_mm - old.value_mm
        if worse > _expanded(old, new) + WORSE_SHARE * scale:
            return VerificationDecision(
                False, f"{name} got worse by {worse * 1e3:.1f} µm, although the worst {before.of.removeprefix('body ')} improved"
            )
    return VerificationDecision(True, f"{change} (U = {needed * 1e3:.1f} µm)")


def judge(value_um: float, u_um: float, limit_um: float) -> Verdict:
    """Guard-banded verdict: pass below limit - U, fail above limit + U, else cannot tell (U = 2 u; ISO 14253-1)."""
    expanded = COVERAGE * u_um
    if value_um + expanded <= limit_um:
        return "pass"
    return "fail" if value_um - expanded > limit_um else "cannot tell"


def overall(verdicts: list[Verdict]) -> Verdict:
    """The worst of several verdicts; "cannot tell" if there are none."""
    if "fail" in verdicts:
        return "fail"
    return "cannot tell" if "cannot tell" in verdicts or not verdicts else "pass"


def figure_rows(found: VerificationFigures) -> dict[str, tuple[float, float]]:
    """Figures as (value, standard uncertainty) in µm, by the names used in limits, JSON and reports."""
    name = found.of.removeprefix("body ")
    rows = {f"{name}_{k}_um": (f.value_mm * 1e3, f.u_mm * 1e3) for k, f in found.diagonals.items()}
    rows["body_diagonal_um" if found.of == "body diagonal" else "worst_pose_um"] = (found.worst.value_mm * 1e3, found.worst.u_mm * 1e3)
    if found.helix is not None:
        rows["helix_rms_um"] = (found.helix.value_mm * 1e3, found.helix.u_mm * 1e3)
    if found.reversal is not None:
        rows["reversal_um"] = (found.reversal.value_mm * 1e3, found.reversal.u_mm * 1e3)
    return rows


def judged(config: MachineFile, runs: list[Run], campaign: str, started: datetime, duration_s: float) -> CheckResult:
    """Judge the measured runs of a check against the limits, with their uncertainty.

    Raises
    ------
    MeasurementFault
        The runs are not a complete check: a body diagonal is missing, or a run was not measured to its end.
    """
    rows = figure_rows(figures(runs))
    limits = config.verify.limits_um()
    verdict = overall([judge(*rows[k], limits[k]) for k in limits if k in rows])
    shown = [f"{name} {rows[k][0]:.1f} µm" + (f" (limit {limits[k]:g})" if k in limits else "") for k, name in NAMES.items() if k in rows]
    text = f"{MARK[verdict]}: {', '.join(shown)}"
    against = [*_air(runs, config.limits.temperature_c), *_ended(config, rows, started)]
    if against:
        verdict = "cannot tell"
        text = f"{' and '.join(against)}, so the figures cannot be judged; {text}"
    return CheckResult(
        verdict,
        {k: v for k, (v, _) in rows.items()},
        {k: COVERAGE * u for k, (_, u) in rows.items()},
        {k: v for k, v in limits.items() if k in rows},
        [r.run_id for r in runs],
        campaign,
        started,
        duration_s,
        text,
        not against,
    )


def _ended(config: MachineFile, names: Iterable[str], started: datetime) -> list[str]:
    """Return a sentence for each instrument behind these figures whose certificate had ended by ``started``."""
    days = {"body_diagonal_um": ("laser", config.calibration.laser), "helix_rms_um": ("ball-bar", config.calibration.ballbar)}
    today = started.astimezone(UTC).date()
    known = ((name, day) for key, (name, day) in days.items() if key in names and day is not None)
    return [f"the certificate of the {name} ended on {day}" for name, day in known if day < today]


def _air(runs: list[Run], window: tuple[float, float]) -> list[str]:
    outside, (low, high) = _outside(runs, window), window
    return [] if outside is None else [f"air temperature {outside:.1f} C is outside of {low:g}..{high:g} C"]


def _outside(runs: list[Run], window: tuple[float, float]) -> float | None:
    """Return the air temperature, °C, farthest outside the window; None if all are inside or none was measured."""
    low, high = window
    temperatures = [float(t) for r in runs for t in r.columns.air_c]
    worst = max(temperatures, key=lambda t: max(low - t, t - high), default=None)
    return worst if worst is not None and not low <= worst <= high else None


@dataclass(frozen=True, slots=True)
class Occasion:
    """Identity of a check: machine, schedule and slot."""

    machine: str
    schedule: Schedule
    slot_utc: datetime


def check_doc(occasion: Occasion, result: CheckResult) -> dict[str, Any]:
    """Return the document of a completed check."""
    return {
        **_head(occasion, result.started_utc),
        "duration_s": round(result.duration_s, 3),
        # An unknown verdict must not look like a pass.
        "verdict": result.verdict if result.verdict in MARK else "cannot tell",
        "values": _figures(result.values),
        "uncertainties": _figures(result.uncertainties),
        "limits": _figures(result.limits),
        "campaign": result.campaign,
        "runs": list(result.run_labels),
        "text": result.text,
        "comparable": bool(result.comparable),
        "cause": None,
    }


def failed_doc(occasion: Occasion, cause: Exception, started_utc: datetime, duration_s: float) -> dict[str, Any]:
    """Return the document of a check that could not be completed: no verdict, but the cause."""
    reason = cause_of(cause)
    return {
        **_head(occasion, started_utc),
        "duration_s": round(duration_s, 3),
        "verdict": "cannot tell",
        "values": {},
        "uncertainties": {},
        "limits": {},
        "campaign": "",
        "runs": [],
        "text": f"The check could not be completed: {reason.what}",
        "cause": asdict(reason),
    }


def alarm(doc: dict[str, Any]) -> dict[str, Any]:
    """Return the alarm that goes with the document of a failed check."""
    return {**doc["cause"], "at_utc": doc["started_utc"]}


def cause_of(cause: Exception) -> CheckFailure:
    """Return code, one line of cause, remedy and device of an error.

    Of a group of errors, the first one of a driver or of Abbe is used: if several devices fail together, the first failure matters.
    """
    known = _first(cause)
    if isinstance(known, DriverError):
        what = _line(f"{known.operation}: {known.detail}")
        return CheckFailure(code=known.code, what=what, remedy=known.remedy, device=known.device)
    if isinstance(known, AbbeError):
        return CheckFailure(code=known.code, what=_line(known.detail), remedy=known.remedy)
    name = type(known).__name__
    return CheckFailure(code="ABB-001", what=_line(f"{name}: {known}"), remedy="see the service's log for details")


def _first(cause: Exception) -> Exception:
    if not isinstance(cause, ExceptionGroup):
        return cause
    leaves = [_first(member) for member in cause.exceptions]
    return next((leaf for leaf in leaves if isinstance(leaf, DriverError | AbbeError)), leaves[0])


def _head(occasion: Occasion, started_utc: datetime) -> dict[str, Any]:
    return {
        "schema": SCHEMA,
        "machine": occasion.machine,
        "schedule": occasion.schedule.name,
        "recipe": occasion.schedule.recipe,
        "slot_utc": occasion.slot_utc.isoformat(),
        "started_utc": started_utc.isoformat(),
    }


def _figures(figures: Mapping[str, float]) -> dict[str, float | None]:
    """Replace NaN and infinity, which JSON does not have, with null."""
    return {name: float(value) if math.isfinite(value) else None for name, value in figures.items()}


def _line(text: str) -> str:
    """Return ``text`` as one printable line of at most 500 characters: device strings end up in logs and pages."""
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())[:500]
