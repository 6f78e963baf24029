"""Campaigns of artefacts on machines of the families, laid out like the practice set of plates: public/, points/, sealed/.

Nine kinds: a plate of holes, a plate of balls, a bar of balls, a step bar, each without and with one calibrated length, and two parts that
the machine drilled and milled and a CMM measured. The readings follow docs/reference/instrument-files.md alone; nothing of the product is
imported.
"""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from tests.experiments.calibration.curves import Rng
from tests.experiments.calibration.families import draw_machine
from tests.experiments.calibration.folder import machine_block
from tests.experiments.calibration.kinematics import F, TrueMachine, without_rigid_motion

KINDS = ("hole", "holecal", "ball", "ballcal", "bar", "barcal", "step", "stepcal", "work")
FAMILIES = ("gp", "poly", "big", "small", "walk", "pitch")
POLE = np.sqrt(2.5)
EXPANSIONS = (1.2e-6, 8e-6, 11.5e-6, 23e-6)
TOUCH_S, MOUNT_S = 5.5, 330.0


@dataclass(frozen=True)
class Artefact:
    """Nominal and true places (n, 3) in its own axes at 20 °C, sensed axes, outward normals (0 for holes and balls), pitch, expansion."""

    ids: list[str]
    nominal: F
    form: F
    sensed: list[str]
    normal: F
    pitch_mm: float
    alpha: float
    alpha_true: float


@dataclass(frozen=True)
class Pose:
    """Stated origin (axis position) and matrix, true ones, drift (mm/s), bend by clamping (mm at the rim, 3 coefficients of x and y)."""

    origin: F
    matrix: F
    true_origin: F
    true_matrix: F
    drift: F
    bend: F


def write_case(folder: Path, family: str, kind: str, number: int, seed: int) -> str:
    """Draw one machine, measure one artefact on it, and write campaign, points and truth; return the case's name."""
    name = f"{family}_{kind}{number:02d}"
    rng = np.random.default_rng([seed, *name.encode()])
    machine, _ = draw_machine(family, rng)
    tool = np.round(np.array([*rng.normal(0.0, 3.0, 2), -rng.uniform(15.0, 90.0)]), 4)
    machine = replace(machine, pivots_mm=machine.pivots_mm - tool)  # the end is the tip then
    play = rng.uniform(0.0, 5e-3, 3) * (0.2 if family == "small" else 1.0)
    body = _artefact(rng, kind.removesuffix("cal"), machine.stroke_mm)
    poses = _poses(rng, kind.removesuffix("cal"), body, machine.stroke_mm)
    work = kind == "work"
    public = folder / "public" / name
    public.mkdir(parents=True, exist_ok=True)
    head = machine_block(replace(machine, pivots_mm=machine.pivots_mm + tool))
    measured = _Measured(rng, machine, play, body, work=work)
    t_s, runs = 540.0, []
    for k, pose in enumerate(poses, start=1):
        run = f"{'w' if work else 'p'}{k}"
        columns = measured.run(pose, t_s)
        stated = {"origin_mm": pose.origin.tolist(), "matrix": pose.matrix.tolist()}
        setup = {"setup_id": run, "t_set_s": t_s, "artefact": "A", "tool_mm": tool.tolist(), "pose": stated}
        setup |= {"source": "workpiece-on-cmm", "tool_radius_mm": 5.0, "cmm": measured.cmm} if work else {"source": "machine-probe"}
        about = {"format": "abbe-run/1", "campaign": name, "run_id": run, "test": "artefact_points", "role": "identify"}
        (public / f"{run}.json").write_text(json.dumps(about | {"machine": head, "setup": setup, "columns": columns}))
        runs.append({"run_id": run, "test": "artefact_points", "role": "identify", "file": f"{run}.json", "t_set_s": t_s})
        t_s = columns["t_s"][-1] + MOUNT_S
    (public / "campaign.json").write_text(json.dumps(_campaign(name, head, body, runs, rng, kind)))
    _write_truth(folder, name, machine, body, poses, scale=kind.endswith("cal") or work, planar=kind.startswith(("hole", "work")))
    return name


def _artefact(rng: Rng, kind: str, stroke: F) -> Artefact:
    side = float(np.round(rng.uniform(0.5, 0.58) * np.ptp(stroke, axis=1)[:2].min(), 1))
    alpha = float(rng.choice(EXPANSIONS))
    if kind in ("hole", "ball", "work"):
        n = {"hole": 6, "ball": 5, "work": 5}[kind]
        pitch = float(np.round(side / (n - 1), 1))
        nominal = np.array([[i * pitch, j * pitch, 0.0] for j in range(n) for i in range(n)])
        ids = [f"{'ABCDEF'[k % n]}{k // n + 1}" for k in range(n * n)]
        normal, sensed = np.zeros_like(nominal), ["xyz" if kind == "ball" else "xy"] * len(ids)
        if kind == "work":
            far, off = (n - 1) * pitch, 25.0
            walls = [(at * far, -off, "y", -1) for at in (0.2, 0.8)] + [(at * far, far + off, "y", 1) for at in (0.2, 0.8)]
            walls += [(-off, at * far, "x", -1) for at in (0.2, 0.8)] + [(far + off, at * far, "x", 1) for at in (0.2, 0.8)]
            ids += [f"W{k}" for k in range(1, 9)]
            nominal = np.concatenate([nominal, [[x, y, 0.0] for x, y, _, _ in walls]])
            normal = np.concatenate([normal, [[w * (a == "x"), w * (a == "y"), 0.0] for _, _, a, w in walls]])
            sensed += [a for _, _, a, _ in walls]
    else:
        n = 9 if kind == "bar" else 16
        pitch = float(np.round(min(1.3 * side, 0.8 * np.ptp(stroke, axis=1).min()) / (n - 1), 1))
        nominal = np.array([[k * pitch, 0.0, 0.0] for k in range(n)])
        ids = [f"{kind[0].upper()}{k + 1:02d}" for k in range(n)]
        sensed = ["xyz" if kind == "bar" else "x"] * n
        normal = np.zeros((n, 3))
        if kind == "step":
            normal[:, 0] = np.where(np.arange(n) % 2, 1.0, -1.0)
    form = rng.uniform(5e-3, 20e-3) * (0.15 if kind == "work" else 1.0) * rng.standard_normal(nominal.shape)
    return Artefact(ids, nominal, form, sensed, normal, pitch, alpha, alpha * (1.0 + 0.025 * rng.standard_normal()))


def _poses(rng: Rng, kind: str, body: Artefact, stroke: F) -> list[Pose]:
    middle = stroke.mean(axis=1)
    turns: dict[str, list[tuple[float, float, float]]] = {
        "hole": [(0, 0, 0), (0, 0, 90), (0, 0, 180), (0, 0, 270)],
        "work": [(0, 0, 0), (0, 0, 90)],
        "ball": [(0, 0, 0), (0, 0, 90), (0, 0, 180), (35, 0, 0), (35, 0, 270)],
    }
    turns["bar"] = turns["step"] = [
        (0, 0, 0), (0, 0, 0), (0, 180, 0), (0, 0, 90), (0, 0, 90), (0, 0, 45), (0, 0, 135), (0, -90, 0), (0, -45, 0), (0, -45, 90)
    ]  # fmt: skip
    out = []
    for k, turn in enumerate(turns[kind]):
        matrix = np.round(Rotation.from_euler("xyz", turn, degrees=True).as_matrix(), 9)
        at = body.nominal @ matrix.T
        room = np.maximum(0.5 * np.ptp(stroke, axis=1) - 0.5 * np.ptp(at, axis=0) - 15.0, 0.0) * np.array([1.0, 1.0, 0.5])
        # in thirds of the room, so that poses lie elsewhere, at pitches that are no simple fraction
        shift = room * np.array([np.cos(2.4 * k), np.sin(2.4 * k), np.cos(1.7 * k) * (kind in ("ball", "bar", "step"))]) * 0.8
        origin = np.round(middle + shift - 0.5 * (at.max(axis=0) + at.min(axis=0)), 3)
        true = Rotation.from_rotvec(rng.normal(0.0, 7e-4, 3) * (1.0 if kind in ("ball", "bar") else [0.1, 0.1, 1.0])).as_matrix() @ matrix
        bend = 3e-4 * rng.standard_normal((3, 3)) * (kind != "work")
        out.append(Pose(origin, matrix, origin + rng.normal(0.0, 0.15, 3), true, 3e-4 / 600.0 * rng.standard_normal(3), bend))
    return out


class _Measured:
    """What a probe finds, or a CMM: readings of one artefact on one machine."""

    def __init__(self, rng: Rng, machine: TrueMachine, play: F, body: Artefact, *, work: bool) -> None:
        self.rng, self.machine, self.play, self.body, self.work = rng, machine, play, body, work
        self.sigma = rng.uniform(3e-4, 7e-4)
        self.shift = {a: 1e-3 * rng.standard_normal(3) for a in (0.0, 45.0)}
        self.pretravel, self.lobe, self.phase = rng.normal(0.0, 3e-3), rng.uniform(5e-4, 2e-3), rng.uniform(0.0, 2.0 * np.pi)
        self.warm, self.sensor = rng.uniform(-1.0, 3.0), 0.07 * rng.standard_normal()
        self.cmm = {"U_mm": 0.0012, "U_per_m_mm": 0.0029, "k": 2}
        self.cmm_scale, self.cmm_square = 1.45e-6 * rng.standard_normal(2)
        self.cutter = rng.normal(0.0, 5e-3)

    def deviation(self, at: F, sign: F) -> F:
        return self.machine.deviation_mm(at) - 0.5 * sign * self.play

    def run(self, pose: Pose, t_s: float) -> dict[str, Any]:
        body, rng = self.body, self.rng
        rows = [*range(len(body.ids)), *([] if self.work else [0, len(body.ids) // 2])]
        times = t_s + 60.0 + (20.0 if self.work else TOUCH_S) * np.arange(len(rows))
        start = np.where(rng.random(len(rows)) < 0.5, 0.0, 45.0)
        nominal, form, normal = body.nominal[rows], body.form[rows], body.normal[rows]
        warm = self.warm + 0.02 * rng.standard_normal(len(rows))
        commanded, deviation, sign = (self._made if self.work else self._probed)(pose, nominal, form, normal, times - t_s, warm, start)
        doc: dict[str, Any] = {"t_s": np.round(times, 3).tolist(), "feature": [body.ids[i] for i in rows]}
        doc |= {f"{a}_mm": np.round(commanded[:, k], 5).tolist() for k, a in enumerate("xyz")}
        for k, a in enumerate("xyz"):
            doc[f"deviation_{a}_mm"] = [
                round(float(d), 6) if a in body.sensed[i] else None for d, i in zip(deviation[:, k], rows, strict=True)
            ]
        doc["u_mm"] = [round(5e-4 if self.work else self.sigma / np.sqrt(2.0), 6)] * len(rows)
        doc["temperature_C"] = np.round(20.0 + warm + self.sensor, 2).tolist()
        if self.work:
            doc |= {f"from_{a}": sign[:, k].tolist() for k, a in enumerate("xyz")}
        elif not normal.any():
            doc["touch_start_deg"] = start.tolist()
        return doc

    def _probed(self, pose: Pose, nominal: F, form: F, normal: F, since: F, warm: F, start: F) -> tuple[F, F, F]:
        reach = float(np.linalg.norm(self.body.nominal - self.body.nominal.mean(axis=0), axis=1).max())
        q = (nominal - self.body.nominal.mean(axis=0)) / reach
        bend = np.stack([q[:, 0] ** 2, q[:, 0] * q[:, 1], q[:, 1] ** 2], axis=1) @ pose.bend
        own = (nominal + form) * (1.0 + self.body.alpha_true * warm)[:, None] + bend
        lies = pose.true_origin + np.outer(since, pose.drift) + own @ pose.true_matrix.T
        wall, outward = normal.any(axis=1), normal @ pose.matrix.T
        sign = -np.sign(np.round(outward, 3))
        lobes = self.lobe * np.cos(3.0 * np.arctan2(outward[:, 1], outward[:, 0]) + self.phase)
        lies = lies + np.where(wall[:, None], (self.pretravel + lobes)[:, None] * outward, np.array([self.shift[a] for a in start]))
        found = lies
        for _ in range(3):
            found = lies - self.deviation(found, sign)
        noise = self.sigma * self.rng.standard_normal(found.shape) / np.sqrt(2.0)
        noise[:, 2] *= POLE
        found = found + noise
        return found, (found - pose.origin) @ pose.matrix - nominal, sign

    def _made(self, pose: Pose, nominal: F, form: F, normal: F, since: F, warm: F, start: F) -> tuple[F, F, F]:
        commanded = pose.origin + nominal @ pose.matrix.T
        outward = normal @ pose.matrix.T
        sign = np.where(self.rng.random(nominal.shape) < 0.5, -1.0, 1.0)
        sign = np.where(outward != 0.0, -np.sign(np.round(outward, 3)), sign)
        made = nominal + self.deviation(commanded, sign) @ pose.matrix + form - self.cutter * normal
        made = made * (1.0 - self.body.alpha_true * warm)[:, None]
        clamped = Rotation.from_rotvec([0.0, 0.0, self.rng.normal(0.0, 4e-4)]).as_matrix()
        seen = made @ clamped.T * (1.0 + self.cmm_scale)
        seen[:, 0] += self.cmm_square * made[:, 1]
        seen = seen + self.rng.normal(0.0, 0.05, 3) + 5e-4 * self.rng.standard_normal(seen.shape)
        return commanded, seen - nominal, sign


def _campaign(name: str, head: dict[str, Any], body: Artefact, runs: list[dict[str, Any]], rng: Rng, kind: str) -> dict[str, Any]:
    known = []
    if kind.endswith("cal"):
        true, last = body.nominal + body.form, {"hole": 5, "ball": 4, "bar": 8, "step": 14}[kind.removesuffix("cal")]
        length = float(np.linalg.norm(true[last] - true[0])) + 6e-4 * rng.standard_normal()
        ends = {"from": body.ids[0], "to": body.ids[last]}
        known = [ends | {"length_mm": round(length, 5), "U_mm": 0.0012, "k": 2, "temperature_C": 20.0}]
    features = [
        {"id": i, "nominal_mm": p.tolist(), "sensed": s} | ({"normal": n.tolist()} if n.any() else {})
        for i, p, s, n in zip(body.ids, body.nominal, body.sensed, body.normal, strict=True)
    ]
    artefact = {"kind": kind, "features": features, "expansion_per_K": body.alpha, "u_expansion_per_K": 0.05 * body.alpha}
    return {
        "format": "abbe-campaign/1", "campaign": name, "machine": head, "current_model": {"includes": ["rigid21"]},
        "instruments": {"cmm": {"U_mm": 0.0012, "U_per_m_mm": 0.0029, "k": 2}} if kind == "work" else {"probe": {"ball_radius_mm": 1.0}},
        "artefacts": {"A": artefact | {"reference_temperature_C": 20.0, "calibrated_lengths": known}},
        "setups": {r["run_id"]: {"kind": "artefact", "t_set_s": r["t_set_s"]} for r in runs}, "temperature_sensors": False,
        "runs": [{k: v for k, v in r.items() if k != "t_set_s"} for r in runs],
    }  # fmt: skip


def _write_truth(folder: Path, name: str, machine: TrueMachine, body: Artefact, poses: list[Pose], *, scale: bool, planar: bool) -> None:
    """Points half a pitch beside the features, in every pose."""
    inner = body.nominal[~body.normal.any(axis=1)] if planar else body.nominal
    half = 0.5 * body.pitch_mm * np.array([1.0, 1.0 if np.ptp(inner[:, 1]) else 0.0, 0.0])
    top = inner.max(axis=0)
    inside = inner[((inner + half) <= top + 1e-6).all(axis=1)] + half
    points = np.round(np.concatenate([p.origin + inside @ p.matrix.T for p in poses]), 4)
    which = np.repeat(np.arange(1, len(poses) + 1), len(inside))
    deviation = 1e3 * without_rigid_motion(points, machine.deviation_mm(points))
    step = bool(body.normal.any()) and not planar
    ray = np.concatenate([np.tile(p.matrix[:, 0] if step else np.full(3, np.nan), (len(inside), 1)) for p in poses])
    if planar:
        deviation[:, 2] = np.nan
    for part, rows, titles in (
        ("points", points, "x_mm,y_mm,z_mm"),
        ("sealed", np.column_stack([points, deviation, which, ray]), "x_mm,y_mm,z_mm,dx_um,dy_um,dz_um,pose,ray_x,ray_y,ray_z"),
    ):
        (folder / part).mkdir(exist_ok=True)
        np.savetxt(
            folder / part / f"{name}.csv", rows, fmt="%.6g" if part == "sealed" else "%.4f", delimiter=",", header=titles, comments=""
        )
    (folder / "sealed" / f"{name}.json").write_text(json.dumps({"scale_known": scale, "planar": planar}))
