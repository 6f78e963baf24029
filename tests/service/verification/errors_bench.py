"""Files for `abbe errors` in a folder of their own, and the command on them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from abbe.service import cli

OBJECT = {
    "name": "VMC-1",
    "chain": "w-X-Y-b-Z-t",
    "vertical_axis": "Z",
    "stroke_mm": {"X": [0, 600], "Y": [0, 500], "Z": [-50, 450]},
    "pivots_mm": {"X": [300, 250, -150], "Y": [300, 250, -250], "Z": [0, 320, 260]},
    "tool_mm": [10, -20, -120],
}
TOML = """
name = "VMC-1"
chain = "w-X-Y-b-Z-t"
vertical_axis = "Z"
tool_mm = [10, -20, -120]
[stroke_mm]
X = [0, 600]
Y = [0, 500]
Z = [-50, 450]
[pivots_mm]
X = [300, 250, -150]
Y = [300, 250, -250]
Z = [0, 320, 260]
"""
OWN = TOML + '[web]\nport = 9000\n[devices]\ncnc = "modbus+tcp://127.0.0.1:502"\n'
ERRORS: dict[str, Any] = {
    "format": "abbe-errors/1",
    "squareness_rad": {"C0Y": 2.1e-5, "B0Z": -3e-5, "A0Z": -1e-5},
    "motions": {
        "EXX": {"kind": "polynomial", "coefficients": [1e-3, -8.6e-5, 2e-8], "origin_mm": 50},
        "EXX@reverse": {"kind": "polynomial", "coefficients": [4e-3, -8.6e-5], "origin_mm": 50},
        "EYX": {"kind": "table", "position_mm": [0, 200, 600], "value": [0, 2e-3, -1e-3], "interpolation": "linear"},
        "EBX": {"kind": "legendre", "coefficients": [1e-5, 2e-5, -5e-6], "stroke_mm": [0, 600]},
        "ECY": {"kind": "bspline", "knots_mm": [0, 0, 250, 500, 500], "coefficients": [0, 3e-5, -1e-5], "degree": 1},
        "EAZ": {"kind": "table", "position_mm": [-50, 100, 300, 450], "value": [0, 1e-5, 4e-5, 2e-5], "interpolation": "cubic"},
        "EZZ": {"kind": "polynomial", "coefficients": [0, 4e-5], "origin_mm": -50},
    },
    "covariance": None,
    "not_observable": [{"combination": {"ECY.1": 1.0, "EXX.0": -0.5}, "why": "no second tool"}],
}
POINTS = np.array([[0.0, 0.0, -50.0], [123.0, 400.0, 77.0], [600.0, 500.0, 450.0], [350.0, 20.5, 0.0]])
TOOL = np.array(OBJECT["tool_mm"], dtype=float)


class Outcome:
    def __init__(self, code: int, out: str, err: str) -> None:
        self.code, self.out, self.err = code, out, err


class Bench:
    """Files in a folder of its own, and the command on them."""

    def __init__(self, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
        self.folder, self._capsys = folder, capsys
        self.machine = self.write("machine.json", OBJECT)
        self.errors = self.write("errors.json", ERRORS)
        self.points = self.csv(POINTS)

    def write(self, name: str, content: Any) -> Path:
        path = self.folder / name
        path.write_text(content if isinstance(content, str) else json.dumps(content), encoding="utf-8")
        return path

    def csv(self, rows: Any, header: str = "x_mm,y_mm,z_mm") -> Path:
        return self.write("points.csv", "\n".join([header, *(",".join(str(v) for v in row) for row in rows)]) + "\n")

    def __call__(self, *options: object) -> Outcome:
        words = ["errors", "--machine", self.machine, "--errors", self.errors, "--points", self.points, *options]
        code = cli.run([str(word) for word in words])
        out, err = self._capsys.readouterr()
        return Outcome(code, out, err)

    def doc(self, *options: object) -> dict[str, Any]:
        done = self(*options, "--json")
        assert (done.code, done.err) == (0, "")
        return json.loads(done.out)

    def deviation(self, *options: object) -> np.ndarray:
        return np.array([p["deviation_mm"] for p in self.doc(*options)["points"]])

    def refusal(self, *options: object) -> str:
        done = self(*options)
        assert (done.code, done.out) == (2, "")
        assert done.err.startswith("error ")
        assert done.err.count("\n") == 1
        return done.err
