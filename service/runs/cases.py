"""Convert a campaign for the discovery: run documents to paths, readings and roles (`abbe.models.discovery.case`)."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.discovery.case import Case, CaseRun
from abbe.models.effects.path import Path, Places, driven, since_reversal, standing
from abbe.models.geometry.chain import travel_sign
from abbe.models.machine import Machine
from abbe.service.domain.run_file import ASSUMED_MODEL
from abbe.service.errors import MeasurementFault
from abbe.service.runs.approached import with_reversals

RESOLUTION_MM = {"bar": 1e-4, "laser": 1e-5}
SENSORS = ("x", "y", "z", "spindle", "air")
AXES = "XYZ"
FEED_SHARE = 0.1
"""Largest relative difference between the actual and the stated feed; chords are shorter than arcs by 2 % at most."""
CLOCKS_S = 60.0
"""Tolerance of the mounting time, which people do not note to the second."""


def case_of(campaign: dict[str, Any], machine: Machine, runs: list[dict[str, Any]]) -> Case:
    """Turn an ``abbe-campaign/1`` object and its ``abbe-run/1`` objects into a case.

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
    found = tuple(_run(run, machine, vertical, dead) for run in with_earliest_mounting(runs))
    return Case(str(campaign["campaign"]), machine, frozenset(includes), found, resolution)


def with_earliest_mounting(runs: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Give all runs of a set-up its earliest ``t_set_s``: the set-up was mounted once, and later values are only starts of runs.

    Call this with all runs of a campaign before leaving any out, because an omitted run may hold the only mounting time.
    """
    earliest: dict[str, float] = {}
    for run in runs:
        setup = run["setup"]
        if setup.get("t_set_s") is not None:
            earliest[setup["setup_id"]] = min(float(setup["t_set_s"]), earliest.get(setup["setup_id"], np.inf))
    times = [earliest.get(run["setup"]["setup_id"]) for run in runs]
    return [run if t is None else run | {"setup": run["setup"] | {"t_set_s": t}} for run, t in zip(runs, times, strict=True)]


def _run(run: dict[str, Any], machine: Machine, vertical: int, dead_path_mm: float) -> CaseRun:
    columns, setup = run["columns"], run["setup"]
    deviation = columns["deviation_mm"]
    reading = None if deviation is None else np.asarray(deviation, dtype=np.float64)
    valid = np.asarray(columns.get("valid", np.ones(len(columns["t_s"])))).astype(bool)
    return CaseRun(
        path_of(run, machine, vertical, dead_path_mm), run["role"], reading, valid, setup.get("u_length_mm"), setup.get("length_calibrated")
    )


def path_of(run: dict[str, Any], machine: Machine, vertical: int, dead_path_mm: float) -> Path:
    """The path of one ``abbe-run/1`` object, without its readings."""
    columns, setup, laser = run["columns"], run["setup"], run["test"].startswith("laser")
    t_s, feed = (np.asarray(columns[name], dtype=np.float64) for name in ("t_s", "feed_mm_min"))
    q = np.column_stack([np.asarray(columns[f"{c}_mm"], dtype=np.float64) for c in "xyz"])
    feed = feed if laser else _driven_feed(q, t_s, feed)
    temp = {s: np.asarray(columns[f"temp_{s}_C"], dtype=np.float64) for s in SENSORS if f"temp_{s}_C" in columns}
    first = {s: v[:1] for s, v in temp.items()}
    at = driven(q, t_s, feed, dwelling=laser, temp_c=temp)
    if laser:
        path, rows = with_reversals(run, q)
        sign = travel_sign(path)
        at = replace(at, sign=sign[rows], since_mm=since_reversal(path, sign)[rows])
    t_set = float(setup.get("t_set_s", t_s[0]))
    if t_s[0] < t_set - CLOCKS_S:
        raise MeasurementFault(
            f"run {run['run_id']}: its first reading is {t_set - t_s[0]:.0f} s before its set-up was mounted (t_set_s)",
            "write t_s and t_set_s in s of one clock for the whole campaign: what drifts is judged by them",
        )
    if setup.get("tool_mm") is not None:
        machine = replace(machine, tool_mm=np.asarray(setup["tool_mm"], dtype=np.float64))
    common: dict[str, Any] = {
        "label": run["run_id"],
        "setup": setup["setup_id"],
        "test": run["test"],
        "machine": machine,
        "vertical": vertical,
        "at": at,
        "feed_mm_min": feed,
        "direction": np.asarray(columns["direction"], dtype=np.float64),
        "t_set_s": t_set,
    }
    if laser:
        beam = _beam(setup, run["run_id"])
        look = np.broadcast_to(beam, q.shape)
        along: dict[str, Any] = {"reference": _first(at), "look": look, "travel_mm": (q - q[0]) @ beam, "dead_path_mm": dead_path_mm}
        return Path(**common, **along, kind="laser", radius_mm=0.0, centre_mm=np.zeros(3))
    centre, radius = np.asarray(setup["centre_mm"], dtype=np.float64), float(setup["radius_mm"])
    cup: dict[str, Any] = {"reference": standing(centre, t_set, first), "look": _away(q, centre, run["run_id"])}
    return Path(**common, **cup, kind="bar", travel_mm=np.zeros(len(q)), dead_path_mm=0.0, radius_mm=radius, centre_mm=centre)


def _driven_feed(q_mm: F2, t_s: F1, feed_mm_min: F1) -> F1:
    """The stated feed, mm/min, or the feed from positions and times if both contradict each other."""
    took_s = np.diff(t_s)
    if not took_s.size or not (took_s > 0.0).all():
        return feed_mm_min
    speed = float(np.median(60.0 * np.linalg.norm(np.diff(q_mm, axis=0), axis=1) / took_s))
    agrees = abs(speed / max(float(np.median(feed_mm_min)), 1e-9) - 1.0) < FEED_SHARE
    return feed_mm_min if agrees or speed == 0.0 else np.full_like(feed_mm_min, speed)


def _away(q_mm: F2, centre_mm: F1, label: str) -> F2:
    """Unit vectors from the cup to the positions, shape (n, 3)."""
    away = q_mm - centre_mm
    length = np.linalg.norm(away, axis=1, keepdims=True)
    if not (length > 0).all():
        raise MeasurementFault(f"run {label}: a reading is on the cup's centre, where the bar has no direction")
    return np.asarray(away / length)


def _first(at: Places) -> Places:
    """The first record of a laser run, to which all others are relative."""
    return Places(
        at.q_mm[:1], at.sign[:1], at.since_mm[:1], at.v_mm_s[:1], at.a_mm_s2[:1], at.t_s[:1], {s: v[:1] for s, v in at.temp_c.items()}
    )


def _beam(setup: dict[str, Any], label: str) -> F1:
    """Nominal beam as a unit vector: as stated, else along the test."""
    beam = setup.get("nominal_beam")
    along = np.asarray(beam if beam is not None else np.subtract(setup["end_mm"], setup["start_mm"]), dtype=np.float64)
    if setup.get("axis") is not None and beam is None:
        along = np.atleast_1d(along) * np.eye(3)[AXES.index(setup["axis"])]
    length = float(np.linalg.norm(along))
    if along.shape != (3,) or not (np.isfinite(length) and length > 0.0):
        raise MeasurementFault(f"run {label}: a laser run needs a beam: nominal_beam, or start and end apart")
    return np.asarray(along / length)
