"""`abbe errors`: values against formulas written out here, uncertainty against finite differences, what a person reads."""

from __future__ import annotations

import copy
import json
import math
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from abbe.models.geometry import field
from abbe.service.runs import points as points_file
from abbe.service.verification import deviations as workflow
from abbe.service.verification.deviations import standard_uncertainty_mm
from tests.service.verification.errors_bench import ERRORS, OBJECT, OWN, POINTS, TOML, TOOL, Bench

pytestmark = pytest.mark.usefixtures("clean_environment")


@pytest.fixture
def bench(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Bench:
    monkeypatch.chdir(tmp_path)
    return Bench(tmp_path, capsys)


def motions(p: np.ndarray, reverse: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Translations and angles of the carriages X, Y, Z at one point, written out from ERRORS: two arrays (3, 3)."""
    x, y, z = p
    d, e = np.zeros((3, 3)), np.zeros((3, 3))
    d[0, 0] = 4e-3 - 8.6e-5 * (x - 50) if reverse else 1e-3 - 8.6e-5 * (x - 50) + 2e-8 * (x - 50) ** 2
    d[0, 1] = 2e-3 * x / 200 if x < 200 else 2e-3 - 3e-3 * (x - 200) / 400
    u = x / 300 - 1
    e[0, 1] = 1e-5 + 2e-5 * u - 5e-6 * (1.5 * u**2 - 0.5)
    e[1, 2] = 3e-5 * y / 250 if y < 250 else 3e-5 - 4e-5 * (y - 250) / 250
    e[2, 0] = sum(v * math.prod((z - b) / (a - b) for b in NODES if b != a) for a, v in zip(NODES, [0, 1e-5, 4e-5, 2e-5], strict=True))
    d[2, 2] = 4e-5 * (z + 50)
    d[1, 0] -= 2.1e-5 * y  # Y's direction is (-C0Y, 1, 0), from axis zero
    d[2, 0] += -3e-5 * z  # Z's direction is (B0Z, -A0Z, 1)
    d[2, 1] -= -1e-5 * z
    return d, e


NODES = [-50.0, 100.0, 300.0, 450.0]  # a not-a-knot spline through four points is the one cubic through them


def by_hand(p: np.ndarray, tool: np.ndarray = TOOL, reverse: bool = False) -> np.ndarray:
    """Rule G of docs/explanation/conventions.md for w-X-Y-b-Z-t: X and Y carry the table, Z the tool."""
    d, e = motions(p, reverse)
    px, py, pz = (np.array(OBJECT["pivots_mm"][a], dtype=float) for a in "XYZ")
    x, y, z = np.diag(p)
    levers = [tool + x + y + z - px, tool + y + z - py, tool - pz]
    return sum(d[j] + np.cross(e[j], levers[j]) for j in range(3))


def exact_by_hand(p: np.ndarray) -> np.ndarray:
    d, e = motions(p)
    px, py, pz = (np.array(OBJECT["pivots_mm"][a], dtype=float) for a in "XYZ")
    x, y, z = np.diag(p)
    q = pz + Rotation.from_rotvec(e[2]).apply(TOOL - pz) + z + d[2]
    for j, (step, pivot) in enumerate([(y, py), (x, px)]):
        q = pivot + Rotation.from_rotvec(e[1 - j]).apply(q + step + d[1 - j] - pivot)
    return q - p - TOOL


# --- values --------------------------------------------------------------------------------------------------------------------------


def test_first_order_is_rule_g(bench: Bench) -> None:
    doc = bench.doc()
    assert (doc["format"], doc["machine"], doc["model"]) == ("abbe-deviations/1", "VMC-1", "first-order")
    found = np.array([p["deviation_mm"] for p in doc["points"]])
    assert_allclose(found, [by_hand(p) for p in POINTS], rtol=0, atol=2e-17)
    assert_allclose([p["norm_mm"] for p in doc["points"]], np.linalg.norm(found, axis=1), rtol=1e-15)
    assert [[p["x_mm"], p["y_mm"], p["z_mm"]] for p in doc["points"]] == POINTS.tolist()


def test_exact_is_the_finite_rotations_and_differs_by_second_order(bench: Bench) -> None:
    doc = bench.doc("--exact")
    found = np.array([p["deviation_mm"] for p in doc["points"]])
    assert doc["model"] == "exact"
    assert_allclose(found, [exact_by_hand(p) for p in POINTS], rtol=0, atol=1e-12)
    gap = np.abs(found - bench.deviation()).max()
    assert 1e-9 < gap < 1e-5
    half = copy.deepcopy(ERRORS)
    for one in half["motions"].values():
        key = "value" if one["kind"] == "table" else "coefficients"
        one[key] = [0.5 * v for v in one[key]]
    half["squareness_rad"] = {k: 0.5 * v for k, v in half["squareness_rad"].items()}
    bench.errors = bench.write("half.json", half)
    assert gap / np.abs(bench.deviation("--exact") - bench.deviation()).max() == pytest.approx(4.0, rel=1e-3)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("m.json", OBJECT),
        ("plain.toml", TOML),
        ("own.toml", OWN),
        ("nameless.toml", TOML.replace('name = "VMC-1"', "")),
        ("more.toml", 'colour = "green"\nbuilt = 2020-01-01\n' + TOML),
    ],
)
def test_every_form_of_machine_gives_the_same(bench: Bench, name: str, content: Any) -> None:
    wanted = bench.deviation()
    bench.machine = bench.write(name, content)
    assert bench.deviation().tolist() == wanted.tolist()


def test_what_a_machine_object_leaves_out_is_zero(bench: Bench) -> None:
    bench.machine = bench.write("m.json", OBJECT | {"tool_mm": None, "pivots_mm": {"X": None}})
    bare = bench.deviation()
    bench.machine = bench.write("m.json", OBJECT | {"tool_mm": [0, 0, 0], "pivots_mm": {a: [0, 0, 0] for a in "XYZ"}})
    assert bare.tolist() == bench.deviation().tolist()


def test_a_tool_of_each_point_replaces_the_machines(bench: Bench) -> None:
    tools = np.array([[0, 0, 0], [10, -20, -120], [5.5, 1, -300], [0, 0, 99]], dtype=float)
    bench.csv(np.hstack([POINTS, tools]), "x_mm,y_mm,z_mm,tool_x_mm,tool_y_mm,tool_z_mm")
    doc = bench.doc()
    assert_allclose(
        [p["deviation_mm"] for p in doc["points"]], [by_hand(p, t) for p, t in zip(POINTS, tools, strict=True)], rtol=0, atol=2e-17
    )
    assert doc["points"][2]["tool_z_mm"] == -300.0


def test_reverse_functions_hold_where_the_axis_last_moved_in_minus(bench: Bench) -> None:
    assert "no column direction_x: Abbe assumes that X last moved in +, and EXX@reverse is not used" in bench.doc()["warnings"]
    signs = [-1, 1, -1, 0]
    bench.csv(np.hstack([np.array(signs, dtype=object)[:, None], POINTS]), " direction_x , x_mm,y_mm,z_mm")
    doc = bench.doc()
    wanted = [by_hand(p, reverse=s < 0) for p, s in zip(POINTS, signs, strict=True)]
    assert_allclose([p["deviation_mm"] for p in doc["points"]], wanted, rtol=0, atol=2e-17)
    assert [p["direction_x"] for p in doc["points"]] == signs
    assert not any("direction" in text for text in doc["warnings"])


def test_a_table_that_ends_inside_the_stroke_holds_its_end_value_and_says_so(bench: Bench) -> None:
    errors = copy.deepcopy(ERRORS)
    errors["motions"] = {"EXX": {"kind": "table", "position_mm": [100, 500], "value": [1e-3, 2e-3], "interpolation": "linear"}}
    errors["squareness_rad"] = dict.fromkeys(("C0Y", "B0Z", "A0Z"), 0)
    bench.errors = bench.write("e.json", errors)
    doc = bench.doc()
    assert [p["deviation_mm"][0] for p in doc["points"]] == pytest.approx([1e-3, 1.0575e-3, 2e-3, 1.625e-3])
    assert "EXX is known from 100 to 500 mm only: its end value is held at 2 of 4 points" in doc["warnings"]


def test_points_on_the_ends_of_the_stroke_are_inside(bench: Bench) -> None:
    bench.csv([[0, 0, -50], [600.0000000001, 500, 450]])
    assert len(bench.doc()["points"]) == 2


def test_a_hundred_thousand_points_are_answered_in_one_piece(bench: Bench) -> None:
    errors = copy.deepcopy(ERRORS) | {"covariance": {"parameters": ["C0Y", "EXX.1"], "matrix": [[1e-12, 0], [0, 1e-12]]}}
    bench.errors = bench.write("e.json", errors)
    rng = np.random.default_rng(1)
    bench.csv(np.round(rng.uniform([0, 0, -50], [600, 500, 450], (100_000, 3)), 4))
    out = bench("--exact").out
    assert "99980 more points; --json lists all" in out
    assert "100000 points, largest deviation" in out


# --- uncertainty ---------------------------------------------------------------------------------------------------------------------

PARAMETERS = ["C0Y", "B0Z", "A0Z", "EXX.2", "EXX@reverse.0", "EYX.1", "EBX.1", "ECY.1", "EAZ.2", "EZZ.1"]


def covariance(seed: int = 3) -> np.ndarray:
    spread = np.array([1e-6, 2e-6, 1e-6, 1e-9, 1e-4, 2e-4, 1e-6, 1e-6, 3e-6, 1e-6])
    root = np.random.default_rng(seed).normal(size=(10, 10)) * spread[:, None]
    return root @ root.T


def shifted(parameter: str, by: float) -> dict[str, Any]:
    errors = copy.deepcopy(ERRORS)
    if parameter in errors["squareness_rad"]:
        errors["squareness_rad"][parameter] += by
    else:
        key, _, index = parameter.rpartition(".")
        one = errors["motions"][key]
        one["value" if one["kind"] == "table" else "coefficients"][int(index)] += by
    return errors


@pytest.mark.parametrize("options", [(), ("--exact",)])
def test_uncertainty_is_that_of_finite_differences_through_the_command(bench: Bench, options: tuple[str, ...]) -> None:
    rows = np.hstack([POINTS, np.array([[-1], [1], [0], [-1]]), np.tile([1.0, 2.0, -100.0], (4, 1))])
    bench.csv(rows, "x_mm,y_mm,z_mm,direction_x,tool_x_mm,tool_y_mm,tool_z_mm")
    columns = []
    for parameter in PARAMETERS:
        step = 1e-7 if parameter == "EXX.2" else 1e-4
        pair = []
        for sign in (1.0, -1.0):
            bench.errors = bench.write("e.json", shifted(parameter, sign * step))
            pair.append(bench.deviation(*options))
        columns.append((pair[0] - pair[1]) / (2.0 * step))
    j = np.stack(columns, axis=-1)
    wanted = j @ covariance() @ j.transpose(0, 2, 1)
    bench.errors = bench.write("e.json", ERRORS | {"covariance": {"parameters": PARAMETERS, "matrix": covariance().tolist()}})
    doc = bench.doc(*options)
    assert_allclose([p["u_deviation_mm"] for p in doc["points"]], np.sqrt(np.diagonal(wanted, axis1=1, axis2=2)), rtol=1e-5)
    along = np.array([np.array(p["deviation_mm"]) / p["norm_mm"] for p in doc["points"]])
    assert_allclose([p["u_norm_mm"] for p in doc["points"]], np.sqrt(np.einsum("ni,nij,nj->n", along, wanted, along)), rtol=1e-5)
    left = "EXX.0 to EXX.1, EXX@reverse.1, EYX.2, EBX.0, EBX.2, ECY.2, EAZ.1, EAZ.3"
    text = f"u from the covariance of the errors file (10 parameters); not in this covariance, so taken as exact: {left}"
    assert doc["uncertainty"] == {"given": True, "text": text}


def test_no_uncertainty_is_said(bench: Bench) -> None:
    doc = bench.doc()
    assert doc["uncertainty"] == {"given": False, "text": "no uncertainty given in the errors file"}
    assert doc["points"][0]["u_deviation_mm"] is None
    out = bench().out
    assert "no uncertainty given in the errors file" in out
    assert "U(dX)" not in out


def test_what_the_covariance_leaves_out_is_named(bench: Bench) -> None:
    bench.errors = bench.write("e.json", ERRORS | {"covariance": {"parameters": ["C0Y"], "matrix": [[1e-12]]}})
    done = bench()
    assert "U(dX)" in done.out
    assert "(1 parameters); not in this covariance, so taken as exact: B0Z, A0Z, EXX, EXX@reverse, EYX, EBX, ECY, EAZ, EZZ" in done.out


def test_parameters_that_the_covariance_leaves_out_are_named_one_by_one(bench: Bench) -> None:
    errors = copy.deepcopy(ERRORS) | {"covariance": {"parameters": ["EXX.0", "EAZ.0"], "matrix": [[1e-12, 0], [0, 1e-12]]}}
    errors["motions"] = {key: errors["motions"][key] for key in ("EXX", "EAZ", "ECY")}
    errors["motions"]["EXX"]["coefficients"] = [1e-3, -8.6e-5]
    errors["squareness_rad"]["B0Z"] = 0
    bench.errors = bench.write("e.json", errors)
    assert bench.doc()["uncertainty"]["text"].endswith("taken as exact: C0Y, A0Z, EXX.1, EAZ.1 to EAZ.3, ECY")


@pytest.mark.parametrize("strange", ["EXX.3", "EYX", "bar", "EXY.1", "EXX.-1", "EXX.1.0"])
def test_a_covariance_of_other_parameters_is_not_used_and_that_is_said(bench: Bench, strange: str) -> None:
    bench.errors = bench.write("e.json", ERRORS | {"covariance": {"parameters": ["C0Y", strange], "matrix": [[1e-12, 0], [0, 1e-12]]}})
    doc = bench.doc()
    assert doc["uncertainty"]["given"] is False
    assert f"names {strange!r}, which is not a parameter of its functions" in doc["uncertainty"]["text"]
    assert doc["points"][0]["u_norm_mm"] is None


def test_where_there_is_no_deviation_its_length_still_has_an_uncertainty(bench: Bench) -> None:
    zero = {"format": "abbe-errors/1", "squareness_rad": {"C0Y": 0, "B0Z": 0, "A0Z": 0}, "motions": {}}
    bench.errors = bench.write("e.json", zero | {"covariance": {"parameters": ["C0Y"], "matrix": [[4e-12]]}})
    bench.csv([[1, 100, 2]])
    point = bench.doc()["points"][0]
    assert (point["norm_mm"], point["deviation_mm"]) == (0.0, [0.0, 0.0, 0.0])
    assert point["u_norm_mm"] == pytest.approx(2e-4)


def test_a_deviation_below_twice_its_uncertainty_has_that_of_the_worst_direction(bench: Bench) -> None:
    """dZ = 1 nm and u(dX) = u(dY) = 0.4 µm: the linear term along Z would be 0."""
    zero = {"format": "abbe-errors/1", "squareness_rad": {"C0Y": 0, "B0Z": 0, "A0Z": 0}}
    known = {"parameters": ["B0Z", "A0Z"], "matrix": [[1e-12, 0], [0, 1e-12]]}
    bench.csv([[0, 0, 400]])
    for size, u in ((1e-9, 4e-4), (0.0, 4e-4), (7.9e-4, 4e-4), (8.1e-4, 0.0)):
        motions = {"EZZ": {"kind": "polynomial", "coefficients": [size], "origin_mm": 0}}
        bench.errors = bench.write("e.json", zero | {"motions": motions, "covariance": known})
        point = bench.doc()["points"][0]
        assert point["u_deviation_mm"] == pytest.approx([4e-4, 4e-4, 0.0])
        assert point["u_norm_mm"] == pytest.approx(u)


def test_the_worst_direction_is_that_of_the_largest_eigenvalue() -> None:
    root = np.random.default_rng(4).normal(size=(50, 3, 3))
    cov, tiny = root @ root.transpose(0, 2, 1), np.full((50, 3), 1e-9)
    directions = np.random.default_rng(5).normal(size=(20_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    largest = np.einsum("di,nij,dj->nd", directions, cov, directions).max(axis=1)
    assert_allclose(standard_uncertainty_mm(tiny, cov)[:, 3], np.sqrt(largest), rtol=2e-3)
    assert_allclose(standard_uncertainty_mm(tiny, cov)[:, :3], np.sqrt(np.diagonal(cov, axis1=1, axis2=2)))
    cov[3, 0, 0] = np.inf
    assert np.isnan(standard_uncertainty_mm(tiny, cov)).all(axis=1).nonzero()[0].tolist() == [3]


# --- what a person reads -------------------------------------------------------------------------------------------------------------


def test_table_for_people(bench: Bench) -> None:
    out = bench().out
    row = next(line for line in out.splitlines() if line.split()[:3] == ["123", "400", "77"])
    d = by_hand(POINTS[1]) * 1e3
    assert row.split()[3:] == [f"{v:.4f}" for v in (*d, np.linalg.norm(d))]
    assert "VMC-1: deviation in µm at positions in mm, first-order" in out
    assert "warning: not observable: ECY.1 - 0.5 EXX.0 (no second tool)" in out
    assert "rigid motion not removed" in out
    assert "exact" in bench("--exact").out.splitlines()[0]


def test_only_twenty_rows_are_shown(bench: Bench) -> None:
    bench.csv([[k, 0, 0] for k in range(50)])
    out = bench().out
    assert "30 more points; --json lists all" in out
    assert sum(line.split()[1:3] == ["0", "0"] for line in out.splitlines()) == 20


def test_unused_columns_and_keys_are_named(bench: Bench) -> None:
    bench.machine = bench.write("m.json", OBJECT | {"tol_mm": [0, 0, 1]})
    bench.csv([[1, 2, 3, "a"]], "x_mm,y_mm,z_mm,label")
    warnings = bench.doc()["warnings"]
    assert any("key 'tol_mm' is not used (did you mean 'tool_mm'?)" in text for text in warnings)
    assert any("column 'label' is not used" in text for text in warnings)


def test_keys_of_the_errors_file_that_mean_nothing_are_named(bench: Bench) -> None:
    errors = copy.deepcopy(ERRORS)
    errors["covariances"] = {"parameters": ["C0Y"], "matrix": [[1e-12]]}
    errors["squareness_rad"]["C0X"] = 1.0
    errors["motions"]["EYX"]["values"] = [1]
    errors["covariance"] = {"parameters": ["C0Y"], "matrix": [[1e-12]], "factor": 2}
    bench.errors = bench.write("e.json", errors)
    warnings = bench.doc()["warnings"]
    for text in (
        "e.json: key 'covariances' is not used (did you mean 'covariance'?)",
        "e.json: key 'squareness_rad.C0X' is not used",
        "e.json: key 'motions.EYX.values' is not used (did you mean 'value'?)",
        "e.json: key 'covariance.factor' is not used",
    ):
        assert any(text in one for one in warnings)
    assert sum("is not used (" in one for one in warnings) == 4


def test_the_pieces_are_one_document_and_the_blocks_one_file(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = np.hstack([np.tile(POINTS, (3, 1)), np.tile([[1.0], [-1.0], [0.0]], (4, 1)), np.tile([1.5, 2.0, -99.0], (12, 1))])
    covariance = {"parameters": ["C0Y", "EXX.1"], "matrix": [[1e-12, 0], [0, 1e-12]]}
    bench.errors = bench.write("e.json", ERRORS | {"covariance": covariance})
    path = bench.csv(rows, "x_mm,y_mm,z_mm,direction_x,tool_x_mm,tool_y_mm,tool_z_mm")
    path.write_text(path.read_text().replace("\n", "\n\n", 3))
    whole = bench("--json", "--exact").out
    assert whole == json.dumps(json.loads(whole), ensure_ascii=False) + "\n"
    assert len(json.loads(whole)["points"]) == 12
    monkeypatch.setattr(field, "BLOCK", 5)
    monkeypatch.setattr(workflow, "ROWS", 5)
    monkeypatch.setattr(points_file, "BLOCK", 5)
    assert bench("--json", "--exact").out == whole
    path.write_text(path.read_text().replace("350.0,20.5", "350.0,2_0.5"))
    assert "y_mm, row 4 (line 8): expected a finite number, got '2_0.5'" in bench.refusal()
    path.write_text(path.read_text().replace("350.0,2_0.5", "350.0,20.5", 2))
    assert "y_mm, row 12 (line 16): expected a finite number, got '2_0.5'" in bench.refusal()


def test_memory_does_not_grow_with_text_and_objects(bench: Bench) -> None:
    bench.csv(np.random.default_rng(1).uniform(0, 400, (15_000, 3)))
    pieces = []
    tracemalloc.start()
    for piece in workflow.deviations_json(workflow.deviations(bench.machine, bench.errors, bench.points)):
        pieces.append(len(piece))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(pieces) == 6
    assert peak < 14e6  # as Python objects these points take 21 MB
