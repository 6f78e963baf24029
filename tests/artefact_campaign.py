"""A campaign of an artefact on a machine with simple errors, as a folder; the formulas here are the test's own (plane, first order)."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Vectors = NDArray[np.float64]
MACHINE = {
    "chain": "w-X-Y-b-Z-t",
    "vertical_axis": "Z",
    "stroke_mm": {"X": [0.0, 800.0], "Y": [0.0, 500.0], "Z": [0.0, 450.0]},
    "pivots_mm": {a: [0.0, 0.0, 0.0] for a in "XYZ"},
}
TOOL = [0.0, 0.0, -60.0]
PITCH_MM = 55.5
EXPANSION = 23e-6
WARM_K = 1.5
POSES = ((0, (260.0, 110.0)), (1, (560.0, 90.0)), (0, (301.0, 147.0)), (2, (520.0, 430.0)))
"""Quarter turns and origins; the third is shifted by fractions of the pitch."""


def error_mm(x: Vectors, y: Vectors) -> Vectors:
    """Deviation of the machine in the plane, shape (n, 2): scales of -60 and 25 ppm, 30 urad of squareness, bent axes."""
    u, v = x - 400.0, y - 250.0
    return np.stack([-60e-6 * u - 30e-6 * v + 1.5e-7 * v**2, 25e-6 * v - 1e-7 * u**2 + 2e-10 * u**3], axis=1)


def screws_mm(x: Vectors, y: Vectors) -> Vectors:
    """`error_mm` on screws of 10 mm lead that err by 2.5 um, and by 1 um with 13.33 mm."""
    waves = [2.5e-3 * np.sin(2.0 * np.pi * a / 10.0 + i) + 1e-3 * np.cos(6.0 * np.pi * a / 40.0 + i) for i, a in enumerate((x, y))]
    return error_mm(x, y) + np.stack(waves, axis=1)


Error = Callable[[Vectors, Vectors], Vectors]


def names() -> list[str]:
    """Ids of 25 holes, row by row."""
    return [f"{c}{r}" for r in range(1, 6) for c in "ABCDE"]


def nominal() -> Vectors:
    """Their nominal places, shape (25, 2), mm."""
    return np.array([[i % 5 * PITCH_MM, i // 5 * PITCH_MM] for i in range(25)])


def campaign(
    folder: Path, *, seed: int = 1, length: bool = True, noise_mm: float = 2e-4, turned: str = "", error: Error = error_mm
) -> Path:
    """Write the campaign and return the folder; ``turned``: run whose plate lies a quarter turn further about its centre than stated;
    ``error``: the machine's."""
    rng = np.random.default_rng(seed)
    form = 0.02 * rng.standard_normal((25, 2))
    n = nominal()
    known = []
    if length:
        l_mm = float(np.linalg.norm(n[4] + form[4] - n[0] - form[0]))
        known = [{"from": "A1", "to": "E1", "length_mm": l_mm, "U_mm": 0.0004, "k": 2, "temperature_C": 20.0}]
    features = [{"id": i, "nominal_mm": [*map(float, p), 0.0], "sensed": "xy"} for i, p in zip(names(), n, strict=True)]
    artefact = {"kind": "hole_plate", "features": features, "expansion_per_K": EXPANSION, "u_expansion_per_K": 1e-7}
    head = {
        "format": "abbe-campaign/1", "campaign": "plate", "machine": MACHINE, "current_model": {"includes": ["rigid21"]},
        "instruments": {"probe": {"ball_radius_mm": 1.0}}, "setups": {}, "temperature_sensors": False,
        "artefacts": {"A": artefact | {"reference_temperature_C": 20.0, "calibrated_lengths": known}},
    }  # fmt: skip
    entries = []
    for k, (quarter, origin) in enumerate(POSES, start=1):
        run = _run(f"p{k}", 600.0 * k, quarter, np.array(origin), _quarter(form) if turned == f"p{k}" else form, rng, noise_mm, error)
        entries.append({"run_id": f"p{k}", "test": "artefact_points", "role": "identify", "file": f"p{k}.json"})
        head["setups"][f"p{k}"] = {"kind": "artefact", "t_set_s": 600.0 * k}  # type: ignore[index]
        (folder / f"p{k}.json").write_text(json.dumps(run))
    (folder / "campaign.json").write_text(json.dumps(head | {"runs": entries}))
    return folder


def _quarter(form: Vectors) -> Vectors:
    """Form that is found at every place if the plate lies a quarter turn further: that of another hole, turned."""
    at = [5 * (4 - i % 5) + i // 5 for i in range(25)]
    return np.stack([-form[at, 1], form[at, 0]], axis=1)


def _run(
    label: str, t_s: float, quarter: int, origin: Vectors, form: Vectors, rng: np.random.Generator, noise_mm: float, error: Error
) -> dict[str, Any]:
    """Points of one pose: the plate lies 0.05 mm and 0.2 mrad off, and is warm."""
    c, s = ((1, 0), (0, 1), (-1, 0), (0, -1))[quarter]
    matrix = np.array([[c, -s], [s, c]], dtype=np.float64)
    shift, turn = 0.05 * rng.standard_normal(2), 2e-4 * rng.standard_normal()
    true = (nominal() + form) * (1.0 + EXPANSION * WARM_K)
    lies = origin + shift + (true + turn * np.stack([-true[:, 1], true[:, 0]], axis=1)) @ matrix.T
    found = lies - error(*lies.T) + noise_mm * rng.standard_normal((25, 2))
    deviation = (found - origin) @ matrix - nominal()
    columns = {
        "t_s": [t_s + 6.0 * i for i in range(25)], "x_mm": found[:, 0].tolist(), "y_mm": found[:, 1].tolist(), "z_mm": [200.0] * 25,
        "feature": names(), "deviation_x_mm": deviation[:, 0].tolist(), "deviation_y_mm": deviation[:, 1].tolist(),
        "deviation_z_mm": [None] * 25, "u_mm": [max(noise_mm, 1e-5)] * 25, "temperature_C": [20.0 + WARM_K] * 25,
    }  # fmt: skip
    pose = {"origin_mm": [*map(float, origin), 200.0], "matrix": [[float(c), float(-s), 0.0], [float(s), float(c), 0.0], [0.0, 0.0, 1.0]]}
    setup = {"setup_id": label, "t_set_s": t_s, "artefact": "A", "source": "machine-probe", "tool_mm": TOOL, "pose": pose}
    head = {"format": "abbe-run/1", "campaign": "plate", "run_id": label, "test": "artefact_points", "role": "identify"}
    return head | {"machine": MACHINE, "setup": setup, "columns": columns}
