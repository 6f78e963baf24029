"""Convert a campaign for the discovery: run documents to paths, readings and roles (`abbe.models.discovery.case`)."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.discovery.case import Case, CaseRun
from abbe.models.effects.path import Path, Places, at_rest, driven, since_reversal
from abbe.models.geometry.chain import travel_sign
from abbe.models.machine import Machine
from abbe.service.domain.machine import Role
from abbe.service.domain.run import BarSetup, LaserSetup, Run
from abbe.service.domain.run_file import ASSUMED_MODEL
from abbe.service.errors import MeasurementFault
from abbe.service.runs.observations import with_earliest_mounting, with_reversals

RESOLUTION_MM = {"bar": 1e-4, "laser": 1e-5}
AXES = "XYZ"
FEED_SHARE = 0.1
"""Largest relative difference between the actual and the stated feed; chords are shorter than arcs by 2 % at most."""
CLOCKS_S = 60.0
"""Tolerance of the mounting time, which people do not note to the second."""


def case_of(campaign: dict[str, Any], machine: Machine, runs: list[Run]) -> Case:
    """Turn an ``abbe-campaign/1`` object and its runs into a case, without points of artefacts.

    Raises
    ------
    MeasurementFault
        A run has no measuring direction, or was measured before its set-up was mounted.
    """
    vertical = AXES.index(str(campaign["machine"].get("vertical_axis", "Z")))
    instruments = campaign.get("instruments") or {}
    dead = float((instruments.get("laser") or {}).get("dead_path_mm") or 0.0)
    resolution = {
        "bar": float((instruments.get("ballbar") or {}).get("resolution_mm") or RESOLUTION_MM["bar"]),
        "laser": float((instruments.get("laser") or {}).get("resolution_mm") or RESOLUTION_MM["laser"]),
    }
    includes = (campaign.get("current_model") or {}).get("includes", ASSUMED_MODEL)
    found = tuple(_run(run, machine, vertical, dead) for run in with_earliest_mounting(runs) if not run.is_artefact)
    return Case(str(campaign["campaign"]), machine, frozenset(includes), found, resolution)


def _run(run: Run, machine: Machine, vertical: int, dead_path_mm: float) -> CaseRun:
    path, columns, setup = path_of(run, machine, vertical, dead_path_mm), run.columns, run.setup
    found = CaseRun(path, cast(Role, run.role), columns.deviation_mm, columns.valid)
    if not isinstance(setup, BarSetup):
        return found
    return replace(found, u_length_mm=setup.u_length_mm, length_calibrated=setup.length_calibrated)


def path_of(run: Run, machine: Machine, vertical: int, dead_path_mm: float) -> Path:
    """Return the data of a run for a simulation: positions, times, mounting and temperatures, but no readings."""
    setup, t_s, q = run.setup, run.columns.t_s, run.columns.q_mm
    temp = run.columns.temperatures_c
    first = {s: v[:1] for s, v in temp.items()}
    at = driven(q, t_s, _feed(run), dwelling=not run.is_bar, temp_c=temp)
    t_set = float(t_s[0]) if setup.t_set_s is None else setup.t_set_s
    if t_s[0] < t_set - CLOCKS_S:
        raise MeasurementFault(
            f"run {run.run_id}: its first reading is {t_set - t_s[0]:.0f} s before its set-up was mounted (t_set_s)",
            "write t_s and t_set_s in seconds of one clock for the whole campaign: Abbe needs them to judge drift",
        )
    common: dict[str, Any] = {
        "label": run.run_id,
        "setup": setup.setup_id,
        "test": run.test,
        "machine": machine if setup.tool_mm is None else replace(machine, tool_mm=setup.tool_mm),
        "vertical": vertical,
        "feed_mm_min": _feed(run),
        "direction": run.columns.direction,
        "t_set_s": t_set,
    }
    if isinstance(setup, LaserSetup):
        path, rows = with_reversals(run, q)
        sign = travel_sign(path)
        at = replace(at, sign=sign[rows], since_mm=since_reversal(path, sign)[rows])
        look = np.broadcast_to(run.beam, q.shape)
        along: dict[str, Any] = {"reference": _first(at), "look": look, "travel_mm": (q - q[0]) @ run.beam, "dead_path_mm": dead_path_mm}
        return Path(**common, **along, at=at, kind="laser", radius_mm=0.0, centre_mm=np.zeros(3))
    centre = run.bar.centre_mm
    cup: dict[str, Any] = {"reference": at_rest(centre, t_set, first), "look": _away(q, centre, run.run_id)}
    return Path(
        **common, **cup, at=at, kind="bar", travel_mm=np.zeros(len(q)), dead_path_mm=0.0, radius_mm=run.bar.radius_mm, centre_mm=centre
    )


def _feed(run: Run) -> F1:
    """Return the feed of every reading, mm/min."""
    columns = run.columns
    return _driven_feed(columns.q_mm, columns.t_s, columns.feed_mm_min) if run.is_bar else columns.feed_mm_min


def _driven_feed(q_mm: F2, t_s: F1, feed_mm_min: F1) -> F1:
    """Return the stated feed, mm/min, or the feed from positions and times if the two disagree."""
    took_s = np.diff(t_s)
    if not took_s.size or not (took_s > 0.0).all():
        return feed_mm_min
    speed = float(np.median(60.0 * np.linalg.norm(np.diff(q_mm, axis=0), axis=1) / took_s))
    agrees = abs(speed / max(float(np.median(feed_mm_min)), 1e-9) - 1.0) < FEED_SHARE
    return feed_mm_min if agrees or speed == 0.0 else np.full_like(feed_mm_min, speed)


def _away(q_mm: F2, centre_mm: F1, label: str) -> F2:
    """Return the unit vectors from the cup to the positions, shape (n, 3)."""
    away = q_mm - centre_mm
    length = np.linalg.norm(away, axis=1, keepdims=True)
    if not (length > 0).all():
        raise MeasurementFault(
            f"run {label}: a reading is on the cup's centre, where the bar has no direction", "correct centre_mm or the positions"
        )
    return np.asarray(away / length)


def _first(at: Places) -> Places:
    """Return the first record of a laser run, to which all others are relative."""
    return Places(
        at.q_mm[:1], at.sign[:1], at.since_mm[:1], at.v_mm_s[:1], at.a_mm_s2[:1], at.t_s[:1], {s: v[:1] for s, v in at.temp_c.items()}
    )
