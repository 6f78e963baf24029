"""Writes machines as the practice set does: FOLDER/public/CASE (abbe-campaign/1), FOLDER/points/CASE.csv, FOLDER/sealed/CASE.csv.

Beside the deviation, ``sealed/CASE.json`` holds the true parameters as far as a solution names them: Legendre coefficients of the motions
and the squareness.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.polynomial import legendre

from tests.experiments.calibration.families import draw_machine
from tests.experiments.calibration.kinematics import F, TrueMachine, without_rigid_motion
from tests.experiments.calibration.plan import Step, full_plan
from tests.experiments.calibration.readings import Setups, shown_mm

ORDERS = 24
"""Legendre coefficients that the truth lists."""


def write_case(folder: Path, family: str, number: int, seed: int, size: float = 1.0) -> str:
    """Draw machine ``number`` of a family and write its campaign, points and truth; return its name. ``size``: share of the readings."""
    name = f"{family}{number:02d}"
    rng = np.random.default_rng([seed, *family.encode(), number])
    machine, noise = draw_machine(family, rng)
    steps = full_plan(machine.stroke_mm, size)
    setups = Setups(rng, cup_um=float(np.exp(rng.uniform(np.log(2.0), np.log(30.0)))))
    public = folder / "public" / name
    public.mkdir(parents=True, exist_ok=True)
    head = machine_block(machine)
    for step in steps:
        shown = None if step.role == "sealed" else shown_mm(machine, step, setups, noise, rng)
        (public / f"{step.run}.json").write_text(json.dumps(_run(name, head, step, shown)))
    (public / "campaign.json").write_text(json.dumps(_campaign(name, head, steps)))
    _write_truth(folder, name, machine)
    return name


def grid_mm(stroke_mm: F, n: int = 5) -> F:
    """Points of a grid of the whole stroke, Z fastest, shape (n³, 3)."""
    return np.stack(np.meshgrid(*(np.linspace(a, b, n) for a, b in stroke_mm), indexing="ij"), axis=-1).reshape(-1, 3)


def _write_truth(folder: Path, name: str, machine: TrueMachine) -> None:
    points = grid_mm(machine.stroke_mm)
    deviation = 1e3 * without_rigid_motion(points, machine.deviation_mm(points))
    for part, rows, head in (
        ("points", points, "x_mm,y_mm,z_mm"),
        ("sealed", np.hstack([points, deviation]), "x_mm,y_mm,z_mm,dx_um,dy_um,dz_um"),
    ):
        (folder / part).mkdir(exist_ok=True)
        np.savetxt(folder / part / f"{name}.csv", rows, fmt="%.5f", delimiter=",", header=head, comments="")
    truth = {"squareness": machine.squareness.tolist(), "series": [s.tolist() for s in series(machine)]}
    (folder / "sealed" / f"{name}.json").write_text(json.dumps(truth))


def series(machine: TrueMachine, orders: int = ORDERS) -> F:
    """Legendre coefficients of all motions by projection, shape (3 carriages, orders + 1, 6), mm and rad."""
    u, weight = legendre.leggauss(400)
    low, high = machine.stroke_mm.T
    axes = low + 0.5 * (u[:, None] + 1.0) * (high - low)
    project = 0.5 * (2.0 * np.arange(orders + 1) + 1.0)[:, None] * legendre.legvander(u, orders).T * weight
    out: F = np.einsum("kn,njc->jkc", project, machine.motions(axes))
    return out


def machine_block(machine: TrueMachine) -> dict[str, Any]:
    stroke, pivots = (dict(zip("XYZ", rows.tolist(), strict=True)) for rows in (machine.stroke_mm, machine.pivots_mm))
    return {"chain": machine.chain, "vertical_axis": "Z", "stroke_mm": stroke, "pivots_mm": pivots}


def _run(name: str, head: dict[str, Any], step: Step, shown: F | None) -> dict[str, Any]:
    columns = {"t_s": step.t_s.tolist(), **{f"{a}_mm": step.axes_mm[:, i].tolist() for i, a in enumerate("xyz")}}
    columns |= {"feed_mm_min": [step.feed_mm_min] * len(step.t_s), "direction": step.direction.tolist()}
    columns["deviation_mm"] = None if shown is None else shown.tolist()
    about = {"format": "abbe-run/1", "campaign": name, "run_id": step.run, "test": step.test, "role": step.role}
    return {**about, "setup": step.setup, "machine": head, "columns": columns}


def _campaign(name: str, head: dict[str, Any], steps: list[Step]) -> dict[str, Any]:
    return {
        "format": "abbe-campaign/1",
        "campaign": name,
        "machine": head,
        "current_model": {"includes": ["rigid21", "setup_centre_offset", "bar_length_error", "mirror_tilt"]},
        "instruments": {"ballbar": {"resolution_mm": 1e-4}, "laser": {"resolution_mm": 1e-5, "dead_path_mm": 900.0}},
        "setups": {s.setup["setup_id"]: {"kind": "ballbar" if s.is_bar else "laser", "t_set_s": s.setup["t_set_s"]} for s in steps},
        "temperature_sensors": False,
        "runs": [{"run_id": s.run, "test": s.test, "role": s.role, "file": f"{s.run}.json"} for s in steps],
    }
