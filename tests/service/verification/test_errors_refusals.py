"""`abbe errors`: one line for every bad input, and for output that cannot be written."""

from __future__ import annotations

import copy
import json
import math
import os
import sys
from collections.abc import Callable
from pathlib import Path
from subprocess import PIPE, Popen
from typing import Any

import pytest

from abbe.service import cli
from tests.service.verification.errors_bench import ERRORS, OBJECT, OWN, TOML, Bench

LONG = os.environ.get("ABBE_TEST_LONG") == "1"
pytestmark = pytest.mark.usefixtures("clean_environment")


@pytest.fixture
def bench(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Bench:
    monkeypatch.chdir(tmp_path)
    return Bench(tmp_path, capsys)


# --- refusals ------------------------------------------------------------------------------------------------------------------------

BAD_POINTS = [
    ("", "the file is empty"),
    ("x_mm,y_mm,z_mm\n", "no point below the header"),
    ("x_mm,y_mm\n1,2\n", "column 'z_mm' is missing"),
    ("1,2,3\n4,5,6\n", "column 'x_mm' is missing"),
    ("x_um,y_mm,z_mm\n1,2,3\n", "unknown unit suffix in 'x_um', expected 'x_mm'"),
    ("x,y,z\n1,2,3\n", "unknown unit suffix in 'x', expected 'x_mm'"),
    ("x_mm,y_mm,z_mm,tool_z_mm\n1,2,3,4\n", "column 'tool_x_mm' is missing"),
    ("x_mm,y_mm,z_mm,direction\n1,2,3,1\n", "unknown column 'direction'"),
    ("x_mm,y_mm,z_mm,x_mm\n1,2,3,1\n", "column 'x_mm' appears twice"),
    ("x_mm;y_mm;z_mm\n1;2;3\n", "not separated by commas"),
    ("x_mm,y_mm,z_mm\n1,2,3\n\n1,,3\n", "y_mm, row 2 (line 4): expected a finite number, got ''"),
    ("x_mm,y_mm,z_mm\n1,2,nan\n", "z_mm, row 1 (line 2): expected a finite number, got 'nan'"),
    ("x_mm,y_mm,z_mm\n1,2,inf\n", "z_mm, row 1 (line 2): expected a finite number, got 'inf'"),
    ("x_mm,y_mm,z_mm\n1_00,2,3\n", "x_mm, row 1 (line 2): expected a finite number, got '1_00'"),
    ("x_mm,y_mm,z_mm\n\u0661,2,3\n", "expected a finite number, got '\u0661'"),
    ("x_mm,y_mm,z_mm\n1,2,3mm\n", "expected a finite number, got '3mm'"),
    ("x_mm,y_mm,z_mm\n1,2,3\n1,2\n", "row 2 (line 3): expected 3 values, got 2"),
    ("x_mm,y_mm,z_mm,direction_x\n1,2,3,2\n", "direction_x, row 1 (line 2): expected -1, 0 or 1, got '2'"),
    ('x_mm,y_mm,z_mm\n1,2,"3\n', "not CSV"),
    ("x_mm,y_mm,z_mm\n1,2,3\n1,501,3\n-1,2,3\n", "row 2 (line 3): y_mm = 501 is outside the stroke of Y, 0 to 500 mm (and 1 more rows)"),
]


@pytest.mark.parametrize(("text", "message"), BAD_POINTS, ids=[message[:30] for _, message in BAD_POINTS])
def test_bad_points(bench: Bench, text: str, message: str) -> None:
    bench.write("points.csv", text)
    refusal = bench.refusal("--json")
    assert message in refusal
    assert "points.csv" in refusal


def test_points_that_are_no_text(bench: Bench) -> None:
    bench.points.write_bytes(b"x_mm,y_mm,z_mm\n\xff")
    assert "is not UTF-8" in bench.refusal()


def test_a_byte_order_mark_is_no_mistake(bench: Bench) -> None:
    bench.points.write_bytes(b"\xef\xbb\xbfx_mm,y_mm,z_mm\r\n1,2,3\r\n")
    assert len(bench.doc()["points"]) == 1


Change = Callable[[dict[str, Any]], object]


def _set(*keys: str | int, value: Any) -> Change:
    def change(document: dict[str, Any]) -> None:
        for key in keys[:-1]:
            document = document[key]  # type: ignore[index]
        document[keys[-1]] = value  # type: ignore[index]

    return change


STEEP = {"kind": "table", "position_mm": [0, 1e-5, 2, 3], "value": [1e308, -1e308, 1e308, -1e308], "interpolation": "cubic"}
GOOD = {"parameters": ["C0Y", "EXX.1"], "matrix": [[1e-12, 0], [0, 1e-12]]}
BAD_ERRORS: list[tuple[Change, str]] = [
    (_set("format", value="abbe-errors/2"), "format: expected 'abbe-errors/1'"),
    (lambda d: d.pop("squareness_rad"), "key 'squareness_rad' is missing"),
    (_set("motions", "EQX", value=ERRORS["motions"]["EXX"]), "EQX"),
    (_set("motions", "EXX@back", value=ERRORS["motions"]["EXX"]), "EXX@back"),
    (_set("motions", "EXX", "kind", value="spline"), "motions.EXX"),
    (_set("motions", "EXX", "coefficients", value=[]), "motions.EXX: coefficients: expected 1 or more"),
    (_set("motions", "EXX", "coefficients", 0, value=math.nan), "finite number"),
    (_set("motions", "EYX", "position_mm", value=[0, 600, 200]), "motions.EYX: table: position_mm[3] = 200: expected positions that rise"),
    (_set("motions", "EYX", "interpolation", value="quintic"), "interpolation: expected 'linear' or 'cubic'"),
    (_set("motions", "EYX", "value", value=[0, 1]), "expected as many values as positions, got 2 and 3"),
    (_set("motions", "ECY", "degree", value=2), "expected 6 knots for 3 coefficients of degree 2, got 5"),
    (_set("motions", "ECY", "knots_mm", value=[0, 0, 500, 250, 500]), "motions.ECY: bspline: knots_mm must never decrease"),
    (_set("motions", "EBX", "stroke_mm", value=[600, 0]), "expected [smaller, larger]"),
    (_set("motions", "EXX", "coefficients", value=[1e308, 1e308]), "too large to compute the deviation at"),
    (_set("motions", "EXX", "coefficients", value=[1e200]), "too large to compute the deviation at"),
    (_set("motions", "EYX", value=STEEP), "motions.EYX: table: the values are too large or too steep for a cubic spline"),
    (_set("motions", "ECY", "knots_mm", value=[0, 0, 0, 500, 500]), "motions.ECY: bspline: knot 0 occurs more than 2 times"),
    (_set("covariance", value={"parameters": ["C0Y"], "matrix": [[1e308]]}), "too large to compute the deviation at"),
    (_set("covariance", value={"parameters": ["C0Y"], "matrix": [["1e-12"]]}), "expected rows of numbers, all equally long, got '1e-12'"),
    (_set("covariance", value={"parameters": ["C0Y"], "matrix": [[True]]}), "expected rows of numbers, all equally long, got True"),
    (_set("covariance", value=GOOD | {"matrix": [[0, 1e-9], [1e-9, 1]]}), "matrix, row 1: the variance is zero, so the whole row"),
    (_set("covariance", value=[]), "covariance: expected"),
    (_set("covariance", value={}), "covariance.parameters: expected a list of names, got None"),
    (_set("covariance", value={"parameters": ["C0Y"]}), "covariance.matrix: expected rows of finite numbers"),
    (_set("covariance", value=GOOD | {"matrix": [[1]]}), "expected 2 x 2 numbers, got 1 rows of 1"),
    (_set("covariance", value=GOOD | {"matrix": [[1, 0], [0]]}), "all equally long"),
    (_set("covariance", value=GOOD | {"matrix": [[1, 0], ["a", 1]]}), "rows of numbers"),
    (_set("covariance", value=GOOD | {"matrix": [[1e-12, 0], [0, -1e-12]]}), "matrix, row 2: the variance is negative"),
    (_set("covariance", value=GOOD | {"matrix": [[1, 0.5], [0.4, 1]]}), "it is not symmetric"),
    (_set("covariance", value=GOOD | {"matrix": [[1, 2], [2, 1]]}), "would have a negative variance"),
    (_set("covariance", value=GOOD | {"parameters": ["C0Y", "C0Y"]}), "'C0Y' appears twice"),
]


@pytest.mark.parametrize(("change", "message"), BAD_ERRORS, ids=[message[:30] for _, message in BAD_ERRORS])
def test_bad_errors_file(bench: Bench, change: Change, message: str) -> None:
    document = copy.deepcopy(ERRORS)
    change(document)
    bench.write("errors.json", document)
    refusal = bench.refusal()
    assert message in refusal
    assert "errors.json" in refusal
    assert "FMT-001" in refusal


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"EYX": {', '"EXX": {"kind": "polynomial", "coefficients": [0.5], "origin_mm": 0}, "EYX": {', "key 'EXX' appears twice"),
        ("0.001", "9" * 5000, "an integer of 5000 digits"),
        ('"covariance": null', '"covariance": ' + "[" * 100_000 + "]" * 100_000, "nested too deeply"),
        ('"covariance": null', '"covariance": ' + "[" * 900 + "]" * 900, "recursion limit exceeded"),
    ],
    ids=["twice", "long", "deep", "less deep"],
)
def test_json_that_python_takes_or_breaks_at(bench: Bench, old: str, new: str, message: str) -> None:
    text = json.dumps(ERRORS)
    assert old in text
    bench.write("errors.json", text.replace(old, new, 1))
    assert message in bench.refusal()


BAD_MACHINES = [
    ("m.toml", "deep = " + "[" * 5000 + "]" * 5000 + TOML, "nested too deeply"),
    ("m.toml", TOML.replace("600", "6" * 5000), "an integer has thousands of digits"),
    ("m.json", OBJECT | {"chain": "w-X-Y-Z-t"}, "chain: expected a chain from w to t"),
    ("m.json", OBJECT | {"stroke_mm": {"X": [0, 1], "Y": [0, 1]}}, "key 'stroke_mm.Z' is missing"),
    ("m.json", OBJECT | {"tool_mm": [0, 0]}, "tool_mm[3]"),
    ("m.json", "{", "not JSON"),
    ("m.toml", TOML.replace('vertical_axis = "Z"', "").replace('name = "VMC-1"', ""), "key 'vertical_axis' is missing"),
    ("m.toml", OWN.replace("port", "prt"), "unknown key 'web.prt'"),
    ("m.toml", "[", "not valid TOML"),
    ("m.toml", TOML.replace("[0, 500]", "[500, 0]"), "stroke_mm.Y: expected [smaller, larger]"),
]


@pytest.mark.parametrize(("name", "content", "message"), BAD_MACHINES, ids=[message[:30] for *_, message in BAD_MACHINES])
def test_bad_machine(bench: Bench, name: str, content: Any, message: str) -> None:
    bench.machine = bench.write(name, content)
    refusal = bench.refusal()
    assert message in refusal
    assert name in refusal


@pytest.mark.parametrize("name", ["none.toml", "none.json"])
@pytest.mark.parametrize("which", ["machine", "errors", "points"])
def test_missing_files(bench: Bench, which: str, name: str) -> None:
    setattr(bench, which, bench.folder / name)
    refusal = bench.refusal()
    assert f"{name}: no such file" in refusal or f"{name} does not exist" in refusal
    assert "campaign.json" not in refusal


@pytest.mark.parametrize("which", ["machine", "errors", "points"])
def test_a_folder_is_no_file(bench: Bench, which: str) -> None:
    setattr(bench, which, bench.folder)
    assert any(words in bench.refusal() for words in ("cannot be read: Is a directory", "it is a folder, expected a plain file"))


# --- output that cannot be written ---------------------------------------------------------------------------------------------------


ENDS = [
    (">&-", 2, "error USE-002: the output cannot be written: it is closed"),
    (">/dev/full", 2, "error USE-002: the output cannot be written: No space left on device"),
    (">&- 2>&-", 2, ""),
    ("| true", 1, ""),
]


@pytest.mark.parametrize("option", ["", "--json"] if LONG else ["--json"])
def test_output_that_cannot_be_written_is_one_line(bench: Bench, option: str) -> None:
    """Every end at once, each a process; ABBE_TEST_LONG=1 writes the table, too."""
    words = f"errors --machine {bench.machine.name} --errors {bench.errors.name} --points {bench.points.name} {option}"
    program = f"'{sys.executable}' -c 'from abbe.service import cli; cli.main()' {words}"
    environment = {"PYTHONPATH": str(Path(cli.__file__).parents[2]), "PATH": "/usr/bin:/bin"}
    scripts = [["bash", "-c", f"set -o pipefail; {program} {end}"] for end, _, _ in ENDS]
    begun = [Popen(script, cwd=bench.folder, env=environment, stdout=PIPE, stderr=PIPE, text=True) for script in scripts]
    for process, (end, code, message) in zip(begun, ENDS, strict=True):
        _, told = process.communicate()
        assert process.returncode == code, end
        assert told.count("\n") == bool(message), end
        assert told.startswith(message), end
