"""Convert runs of an artefact to arrays for the solvers (`abbe.models.solvers.artefact`), one row per sensed component of a point."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from abbe.models.arrays import F1, F2
from abbe.models.solvers.artefact import ArtefactPoints
from abbe.models.solvers.engine import DEFAULT_SIGMA_MM
from abbe.models.solvers.observations import RunData
from abbe.service.domain.artefact import ArtefactObject, Feature
from abbe.service.domain.run import FEATURE, ArtefactSetup, Run
from abbe.service.errors import MeasurementFault

FEWEST = 3
"""Smallest number of sensed components of a run."""
POLE = 1.5
"""Share by which the variance of a ball's height is larger: one touch and the radius give the height, two touches each other direction."""
EXACT = 1e4
"""Weight of a calibrated length, whose error is a separate unknown."""


def artefact_data(run: Run, setup: ArtefactSetup) -> RunData:
    """Return the valid points of a run as arrays.

    Raises
    ------
    MeasurementFault
        The campaign does not describe the artefact, or fewer than three components were sensed.
    """
    if setup.features is None:
        raise MeasurementFault(
            f"run {run.run_id}: its campaign does not describe the artefact {setup.artefact}", "solve it in its campaign"
        )
    c = run.columns
    rows = np.flatnonzero(c.valid)
    deviation = np.column_stack([c.further.get(f"deviation_{a}_mm", np.full(len(c), np.nan)) for a in "xyz"]).astype(np.float64)[rows]
    component, at = np.nonzero(np.isfinite(deviation).T)
    if at.size < FEWEST:
        raise MeasurementFault(f"run {run.run_id}: only {at.size} valid deviations", "measure it again")
    names = c.further[FEATURE][rows]
    points = _points(run, setup, setup.features, rows[at], component)
    u = np.asarray(c.further["u_mm"][rows], dtype=np.float64)[at]
    ball = np.array([f.sensed == "xyz" and setup.by_machine for f in _listed(setup.features, names)])[at]
    height = setup.pose.matrix.T[component][:, 2] ** 2
    sigma = DEFAULT_SIGMA_MM["artefact"]
    return RunData(
        run.run_id, setup.setup_id, "artefact",
        axes_mm=c.q_mm[rows][at],
        deviation_mm=deviation[at, component],
        sign=_signs(run, setup, points, rows[at]),
        t_s=c.t_s[rows][at],
        weight_n=(sigma / u) ** 2 / (1.0 + POLE * height * ball),
        tool_mm=setup.tool_mm,
        points=points,
        test="artefact",
    )  # fmt: skip


def _listed(artefact: ArtefactObject, names: NDArray[np.str_]) -> list[Feature]:
    known = {f.id: f for f in artefact.features}
    return [known[str(n)] for n in names]


def _points(
    run: Run, setup: ArtefactSetup, artefact: ArtefactObject, rows: NDArray[np.intp], component: NDArray[np.intp]
) -> ArtefactPoints:
    c, n = run.columns, len(run.columns)
    listed = _listed(artefact, c.further[FEATURE][rows])
    warm = np.asarray(c.further.get("temperature_C", np.full(n, np.nan)), dtype=np.float64)
    middle = float(np.nanmean(warm)) if np.isfinite(warm).any() else artefact.reference_temperature_C
    u_cmm = float(setup.cmm.get("U_per_m_mm", 0.0)) / 1e3 / float(setup.cmm.get("k", 2.0))
    return ArtefactPoints(
        **_of(artefact, setup.artefact),
        source="probe" if setup.by_machine else "cmm",
        matrix=setup.pose.matrix,
        feature=tuple(f.id for f in listed),
        component=component,
        nominal_mm=np.array([f.nominal_mm for f in listed]),
        normal=np.array([f.normal or (0.0, 0.0, 0.0) for f in listed]),
        warm_K=np.where(np.isfinite(warm), warm, middle)[rows] - artefact.reference_temperature_C,
        touch_deg=np.asarray(c.further.get("touch_start_deg", np.full(n, np.nan)), dtype=np.float64)[rows],
        u_cmm_scale=0.0 if setup.by_machine else u_cmm,
    )


def _of(artefact: ArtefactObject, name: str) -> dict[str, Any]:
    places = np.array([f.nominal_mm for f in artefact.features])
    middle = places.mean(axis=0)
    return {
        "artefact": name,
        "expansion_per_K": artefact.expansion_per_K,
        "u_expansion_per_K": artefact.u_expansion_per_K,
        "middle_mm": middle,
        "reach_mm": max(float(np.linalg.norm(places - middle, axis=1).max()), 1.0),
        "calibrated": bool(artefact.calibrated_lengths),
    }


def _signs(run: Run, setup: ArtefactSetup, points: ArtefactPoints, rows: NDArray[np.intp]) -> F2:
    """Direction of each axis' last motion: towards a probed wall; 0 where touches from both sides cancel lost motion."""
    stated = [run.columns.further[f"from_{a}"] for a in "xyz" if f"from_{a}" in run.columns.further]
    if len(stated) == 3:
        return np.asarray(np.column_stack(stated)[rows], dtype=np.float64)
    return -np.sign(np.round(points.normal @ setup.pose.matrix.T, 3)) if setup.by_machine else np.zeros((len(rows), 3))


def calibrated_lengths(runs: list[Run]) -> tuple[RunData, ...]:
    """Return the calibrated lengths of all probed artefacts as additional runs, one per artefact."""
    known = {r.setup.artefact: r.setup.features for r in runs if isinstance(r.setup, ArtefactSetup) and r.setup.by_machine}
    return tuple(_lengths(name, found) for name, found in known.items() if found is not None and found.calibrated_lengths)


def _lengths(name: str, artefact: ArtefactObject) -> RunData:
    all_, none = artefact.calibrated_lengths, np.zeros((len(artefact.calibrated_lengths), 3))
    places = {f.id: np.array(f.nominal_mm) for f in artefact.features}
    one, two = (np.array([places[end] for end in ends]) for ends in ([c.from_ for c in all_], [c.to for c in all_]))
    points = ArtefactPoints(
        **_of(artefact, name),
        source="length",
        matrix=np.eye(3),
        feature=tuple(c.from_ for c in all_),
        component=np.zeros(len(all_), dtype=np.int64),
        nominal_mm=one,
        normal=none,
        warm_K=np.array([c.temperature_C for c in all_]) - artefact.reference_temperature_C,
        touch_deg=np.full(len(all_), np.nan),
        far=tuple(c.to for c in all_),
        far_mm=two,
        u_mm=np.array([c.U_mm / c.k for c in all_]),
    )
    error: F1 = np.array([c.length_mm for c in all_]) - np.linalg.norm(two - one, axis=1)
    label = f"lengths_{name}"
    return RunData(
        label, label, "artefact", none, error, none, np.zeros(len(all_)), np.full(len(all_), EXACT), points=points, test="artefact"
    )
