"""A small campaign with backlash in X, and a search that gives back what a test wants: a real Discovery with residuals of real runs."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from abbe.models.discovery.answer import Agreement, Discovery, Gap, Localization, NamedEffect, NextTest, Significance, Verdict
from abbe.models.discovery.case import Case, CaseRun
from abbe.models.effects.effect import Effect
from abbe.service.domain.progress import ProgressSink

Doc = dict[str, Any]
MACHINE: Doc = {
    "name": "VMC-1",
    "chain": "w-X-Y-b-Z-t",
    "vertical_axis": "Z",
    "stroke_mm": {"X": [0, 600], "Y": [0, 500], "Z": [0, 450]},
    "pivots_mm": {"X": [300, 250, -150], "Y": [300, 250, -150], "Z": [0, 0, 260]},
}
WIDTH_MM, NOISE_MM = 8e-3, 3e-4
ROLES = ("identify", "identify", "holdout", "sealed")


def circle(number: int, role: str, campaign: str = "c1", width_mm: float = WIDTH_MM) -> Doc:
    """One turn in XY about a centre; the axis stays behind by half the width in the direction it came from."""
    rng = np.random.default_rng(number)
    way = 1 if number % 2 else -1
    angle = 0.5 * np.pi + way * np.linspace(0.0, 2.0 * np.pi, 121)[:-1]  # starts where X does not count
    centre, radius, feed = np.array([250.0 + 20.0 * number, 240.0, 100.0]), 100.0, 1000.0
    x = centre[0] + radius * np.cos(angle)
    sign = np.sign(np.diff(x, prepend=2.0 * x[0] - x[1]))
    reading = -0.5 * width_mm * sign * np.cos(angle) + rng.normal(0.0, NOISE_MM, x.size)
    t = 600.0 * number + np.arange(x.size) * (2.0 * np.pi * radius / 120.0) / (feed / 60.0)
    columns = {"t_s": t.tolist(), "x_mm": x.tolist(), "y_mm": (centre[1] + radius * np.sin(angle)).tolist()}
    columns |= {"z_mm": [100.0] * x.size, "feed_mm_min": [feed] * x.size, "direction": [way] * x.size}
    columns["deviation_mm"] = None if role == "sealed" else reading.tolist()
    setup = {"setup_id": f"S{number}", "t_set_s": 600.0 * number - 60.0, "centre_mm": centre.tolist(), "radius_mm": radius, "plane": "XY"}
    head = {"format": "abbe-run/1", "campaign": campaign, "run_id": f"r{number:02d}", "test": "ballbar_circle", "role": role}
    return head | {"machine": MACHINE, "setup": setup, "columns": columns}


def write_case(folder: Path, campaign: str = "c1", roles: Sequence[str] = ROLES, width_mm: float = WIDTH_MM) -> Path:
    """A campaign folder of such circles."""
    folder.mkdir(parents=True)
    entries = []
    for number, role in enumerate(roles, start=1):
        run = circle(number, role, campaign, width_mm)
        (folder / f"{run['run_id']}.json").write_text(json.dumps(run))
        entries.append({"run_id": run["run_id"], "test": run["test"], "role": role, "file": f"{run['run_id']}.json"})
    head = {"format": "abbe-campaign/1", "campaign": campaign, "machine": MACHINE, "temperature_sensors": False, "setups": {}}
    model = {"current_model": {"includes": ["rigid21", "setup_centre_offset"], "errors": None}}
    instruments = {"instruments": {"ballbar": {"resolution_mm": 1e-4}}}
    (folder / "campaign.json").write_text(json.dumps(head | model | instruments | {"runs": entries}))
    return folder


class Search:
    """Stands in for the computation: names backlash X of a width, or nothing; counts how often it was asked."""

    def __init__(self, verdict: Verdict = "named", width_um: float = 8.0, *, holds: bool = True, ahead: float = 4.2) -> None:
        self.verdict, self.width_um, self.holds, self.ahead, self.calls = verdict, width_um, holds, ahead, 0

    def __call__(self, case: Case, effects: tuple[Effect, ...], progress: ProgressSink) -> Discovery:
        """As `abbe.service.discovery.discover.search`."""
        self.calls += 1
        effect = next(e for e in effects if e.name == "backlash")
        paths = tuple(r.path for r in case.runs)
        size = self.width_um if self.verdict == "named" else 0.0
        shift = {p.label: c[:, 0] * size for p, c in zip(paths, effect.signal(paths, "X", {}), strict=True)}
        judged = [r for r in case.runs if r.deviation_mm is not None]
        before = {r.path.label: reading(r) for r in judged}
        after = {r.path.label: reading(r, shift[r.path.label] * (self.holds or r.role == "identify")) for r in judged}
        rival = (("lateral_play:EYX", self.ahead),)
        location = Localization(tests=("ballbar_circle",), axes=("X",), position_mm=(310.0, 240.0, 100.0), radius_mm=30.0)
        table = Localization(axes=("X",), table=(Significance("axis", "X", 40.0, 1e-9),))
        named = NamedEffect("backlash", "X", size, 0.1, {}, np.array([size]), np.array([[0.01]]), 300.0, rival, location)
        return Discovery(
            verdict=self.verdict,
            effects=(named,) if self.verdict == "named" else (),
            location=location if self.verdict == "unknown" else table,
            next_test=NextTest(("second_feed",), ("backlash:X", "lateral_play:EYX"), 4.2, 12.0, "") if self.verdict == "named" else None,
            gaps={role: gap(role, case, before, after) for role in ("identify", "holdout") if case.of(role)},
            residual_before_mm=before,
            residual_after_mm=after,
            predicted_mm=shift,
            predicted_before_mm={label: 0.0 * v for label, v in shift.items()},
            noise_mm={"bar": NOISE_MM},
            p_value=1e-9 if self.verdict != "none" else 0.6,
            theta_names=("a", "b"),
            theta=np.array([1e-3, 2e-3]),
            theta_covariance=np.diag([1e-8, 2e-8]),
            rejected=(("contour_lag", "explains less than it costs"),),
            agreement=tuple(Agreement(r.path.label, 1.0, 0.8) for r in case.of("holdout")) if self.verdict == "none" else (),
        )


def reading(run: CaseRun, less: Any = 0.0) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Deviation less an effect, without the bar's own length and the cup's place."""
    assert run.deviation_mm is not None
    columns = np.column_stack([run.path.look[:, :2], np.ones(run.path.n)])
    left = run.deviation_mm - less
    return left - columns @ np.linalg.lstsq(columns, left, rcond=None)[0]


def gap(role: str, case: Case, before: Doc, after: Doc) -> Gap:
    """Rms over the runs of a role."""
    labels = [r.path.label for r in case.runs if r.role == role]
    first, second = (float(np.sqrt(np.mean(np.concatenate([v[label] for label in labels]) ** 2))) for v in (before, after))
    return Gap(first, second, NOISE_MM)
