"""A 21-error CMM model that a national metrology institute made, reproduced to the rounding of its files (0.01 um, so half of that).

Material: shared/data/mslnz-cmm21, a KOBA 5 x 5 ball plate in the XZ plane and a step gauge along X, each with machine and plate columns.

What the numbers themselves say, tried over all 24 chains, both readings of the names and all signs:

- Chain ``w-X-b-Y-Z-t``: the table carries the plate along X, Y runs across the fixed bridge, Z is the ram; ``bridge_axis,1`` counts from 0.
  (The note with the data says table along Y, bridge axis X; ``w-Y-b-X-Z-t`` misses by 8 um or more, whatever the signs.)
- ``Tab``: the FIRST letter is the moving axis, the second the direction, so Tyx is our EXY; ``Rab`` likewise, Ryz is our ECY. Values are
  polynomials of that axis' own commanded position, zero at the axis zero: mm per mm, rad per mm.
- Signs are ISO's, tool relative to workpiece, for the table too: +1 everywhere. Not decided by these data: the sign of the table's lateral
  Txy, Txz and of the squareness W, which are all zero here.
- The probe is the tool, no pivots; deviations are actual minus nominal at the ball's machine coordinates, first order.
- Plate columns: (x, y, z) of the plate = (X, Z, -Y) of the machine (90 degrees about X); the measured plate is then put on its own balls:
  first ball at the origin, last ball of the first row on the x axis, first ball of the last row in the plane.
"""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from abbe.models.geometry.chain import all_chains, deviation_mm, exact_deviation_mm
from abbe.models.machine import Machine
from abbe.models.solvers.artefact import ArtefactPoints
from abbe.models.solvers.joint import solve_joint
from abbe.models.solvers.observations import RunData

CHAIN = "w-X-b-Y-Z-t"
STROKE = np.array([[0.0, 800.0], [0.0, 600.0], [0.0, 600.0]])
ROUNDING = 5.0e-6 + 1e-12  # half of the last printed digit, mm


def metadata(path):
    lines = [line.split(",") for line in path.read_text().splitlines()]
    return {key: np.array([float(v) for v in rest if v]) for key, *rest in lines if key in
            {"artefact.nballs", "artefact.ball_spacing", "location", "rotation/deg", "probe.length"}}  # fmt: skip


class Measurement:
    """One file: its settings and the columns, by group of three."""

    def __init__(self, folder, name):
        self.meta = metadata(folder / f"{name}_metadata.csv")
        rows = [line.rstrip(",").split(",") for line in (folder / f"{name}_fulldata.csv").read_text().splitlines() if line[:1].isdigit()]
        table = np.array(rows, dtype=float)
        self.nominal, self.deviation, self.local, self.local_deviation = (table[:, k : k + 3] for k in (1, 4, 7, 10))
        self.turn = Rotation.from_euler("xyz", self.meta["rotation/deg"], degrees=True).as_matrix()
        self.balls = self.meta["artefact.nballs"].astype(int)

    def machine(self, chain=CHAIN):
        return Machine(chain, STROKE, tool_mm=self.meta["probe.length"])

    def layout(self):
        """Ball centres in the artefact: along the first row, row after row."""
        k = np.arange(self.balls.prod())
        zero = np.zeros(k.size)
        return self.meta["artefact.ball_spacing"] * np.stack([k % self.balls[0], k // self.balls[0], zero], axis=1)

    def aligned(self, deviation):
        """Deviation in the artefact after putting it on its own balls, by finite rotation."""
        actual = (self.nominal + deviation - self.nominal[0] - deviation[0]) @ self.turn
        x = actual[self.balls[0] - 1] / np.linalg.norm(actual[self.balls[0] - 1])
        up = actual[-self.balls[0]] if self.balls[1] > 1 else np.array([0.0, 1.0, 0.0])
        z = np.cross(x, up) / np.linalg.norm(np.cross(x, up))
        return actual @ np.stack([x, np.cross(z, x), z], axis=1) - self.layout()


def motions(coefficients, p):
    """ISO motions of the institute's names: T/R + moving axis + direction, a polynomial of the axis' position."""
    out = np.zeros((len(p), 3, 6))
    for j, axis in enumerate("xyz"):
        for i, direction in enumerate("xyz"):
            out[:, j, i] = np.polynomial.polynomial.polyval(p[:, j], coefficients[f"T{axis}{direction}"])
            out[:, j, 3 + i] = np.polynomial.polynomial.polyval(p[:, j], coefficients[f"R{axis}{direction}"])
    assert not any(np.any(coefficients[w]) for w in ("Wxy", "Wxz", "Wyz"))
    return out


@pytest.fixture(scope="module")
def folder(shared):
    return shared / "data" / "mslnz-cmm21"


@pytest.fixture(scope="module")
def plate(folder):
    return Measurement(folder, "plate"), json.loads((folder / "model_parameters_test.json").read_text())


@pytest.fixture(scope="module")
def bar(folder):
    zero = {f"{kind}{a}{b}": [0.0] for kind in "TR" for a in "xyz" for b in "xyz"} | {w: [0.0] for w in ("Wxy", "Wxz", "Wyz")}
    return Measurement(folder, "bar"), zero | {"Txx": [0.0, 1.2e-6]}


@pytest.mark.parametrize("name", ["plate", "bar"])
def test_every_column_is_reproduced_to_its_rounding(name, request):
    m, coefficients = request.getfixturevalue(name)
    found = deviation_mm(m.machine(), m.nominal, motions(coefficients, m.nominal))
    assert len(m.nominal) == {"plate": 25, "bar": 31}[name]
    assert np.abs(m.local - m.layout()).max() <= ROUNDING
    assert np.abs(m.nominal - (m.layout() @ m.turn.T + m.meta["location"])).max() <= ROUNDING
    assert np.abs(m.deviation - found).max() <= ROUNDING
    assert np.abs(m.local_deviation - m.aligned(found)).max() <= ROUNDING


def test_the_exact_kinematics_differ_from_the_file_by_second_order_only(plate):
    """Slopes of 26 um/m and angles of 30 urad: the second order is below 1 nm, a tenth of the file's last digit."""
    m, coefficients = plate
    e = motions(coefficients, m.nominal)
    first = deviation_mm(m.machine(), m.nominal, e)
    for form in ("vector", "zyx", "small"):
        exact = exact_deviation_mm(m.machine(), m.nominal, e, rotation=form)
        assert 0.0 < np.abs(exact - first).max() < 1e-6
        assert np.abs(exact - m.deviation).max() <= ROUNDING + 1e-6


def test_no_other_chain_and_no_other_reading_of_the_names_gives_the_plate(plate):
    m, coefficients = plate
    swapped = {name[0] + name[2] + name[1]: value for name, value in coefficients.items()} | {w: [0.0] for w in ("Wxy", "Wxz", "Wyz")}
    for chain in all_chains():
        for reading in (coefficients, swapped):
            if chain == CHAIN and reading is coefficients:
                continue
            gap = deviation_mm(m.machine(chain), m.nominal, motions(reading, m.nominal)) - m.deviation
            assert np.abs(gap).max() > 1e-3, chain


def test_every_error_of_the_plate_is_seen(plate):
    """Each of the model's numbers, left out, is missed: the agreement is not that of a few large ones."""
    m, coefficients = plate
    for name, value in coefficients.items():
        if not np.any(value):
            continue
        without = deviation_mm(m.machine(), m.nominal, motions(coefficients | {name: [0.0]}, m.nominal))
        assert np.abs(without - m.deviation).max() > 2 * ROUNDING, name


def test_the_plate_as_a_part_on_a_cmm_gives_its_coefficients_back_where_one_pose_shows_them(plate):
    """The joint solution reads the 75 deviations; one pose in XZ shows the scale of X and hides, e.g., everything of Y."""
    m, coefficients = plate
    names = tuple(f"B{i:02d}" for i in range(25) for _ in range(3))
    at, n = np.repeat(m.nominal, 3, axis=0), 75
    local = m.nominal - m.nominal[0]
    points = ArtefactPoints(
        "K", "cmm", np.eye(3), names, np.tile(np.arange(3), 25), np.repeat(local, 3, axis=0), np.zeros((n, 3)), np.zeros(n), 0.0, 0.0,
        np.full(n, np.nan), 400.0, local.mean(axis=0), calibrated=True, u_cmm_scale=1e-9,
    )  # fmt: skip
    run = RunData(
        "p1", "p1", "artefact", at, m.deviation.ravel(), np.zeros((n, 3)), np.zeros(n), np.full(n, 1e6), tool_mm=m.meta["probe.length"],
        points=points,
    )  # fmt: skip
    joint = solve_joint(m.machine(), (run,), order=1)
    moved = joint.deviation_mm(m.nominal, m.meta["probe.length"])
    exact = deviation_mm(m.machine(), m.nominal, motions(coefficients, m.nominal))
    assert np.abs(m.deviation.ravel() - joint.runs[0].residual_mm - exact.ravel()).max() <= ROUNDING
    away = np.column_stack([np.ones(25), local])
    for k in (0, 2):  # along X and Z: the scale that was planted, as a slope along its own axis
        slopes = [np.linalg.lstsq(away[:, [0, 1, 3]], d[:, k], rcond=None)[0][1 if k == 0 else 2] for d in (moved, exact)]
        assert slopes[0] == pytest.approx(slopes[1], abs=0.3e-6)
    assert joint.identifiability.rank < len(joint.terms)
    assert any(name.startswith("EYY") for name in joint.identifiability.involved)  # nothing moved along Y
