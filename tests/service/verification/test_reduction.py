"""ISO 230-2 at 20 °C: which temperature and coefficient count, what the report shows, and what it says where it does not reduce."""

import csv
import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from abbe.service.cli import run
from abbe.service.clock import SystemClock
from abbe.service.domain.machine import AxisMaterial, Rules
from abbe.service.domain.run import Run
from abbe.service.report.report import push_report
from abbe.service.runs.exchange import import_folder
from abbe.service.storage.store import Store
from abbe.service.verification.iso_report import Evaluated, evaluate
from abbe.service.verification.reduction import AT_20, REDUCTION_STATEMENT, UNKNOWN, holds_at
from tests.pretended_push import KEPT, as_if_pushed
from tests.run_documents import run_of

AT = np.array([0.0, 250.0, 500.0, 750.0, 1000.0])
STEEL = AxisMaterial(11.5e-6, 0.6e-6, 24.0, 0.2, 0.0)
WAVELENGTH = 0.3e-6
MACHINE = """
name = "one"
chain = "w-b-X-Y-Z-t"
short_strokes = true
[stroke_mm]
X = [-4.0, 4.0]
Y = [-4.0, 4.0]
Z = [-4.0, 4.0]
[material]
scale_per_k = {X = 11.5e-6}
u_scale_per_k = {X = 0.6e-6}
temperature_c = 24.0
"""


def line(temperature_c: float | None = None, spread_k: float = 0.0, air_c: float | None = None, run_id: str = "r") -> Run:
    """A perfect steel axis of 1 m at 24 °C, five cycles, read by a laser without noise: 46 µm too long."""
    x = np.tile(np.concatenate([AT, AT[::-1]]), 5)
    columns = {"t_s": np.arange(50.0).tolist(), "x_mm": x.tolist(), "y_mm": [0.0] * 50, "z_mm": [0.0] * 50, "feed_mm_min": [60.0] * 50}
    columns |= {"direction": ([1] * 5 + [-1] * 5) * 5, "deviation_mm": (46e-6 * x).tolist()}
    if temperature_c is not None:
        columns["temp_x_C"] = (temperature_c + np.linspace(-0.5, 0.5, 50) * spread_k).tolist()
    if air_c is not None:
        columns["temp_air_C"] = [air_c] * 50
    setup = {
        "setup_id": "L",
        "t_set_s": 0.0,
        "axis": "X",
        "start_mm": [0.0] * 3,
        "end_mm": [1000.0, 0.0, 0.0],
        "nominal_beam": [1.0, 0.0, 0.0],
    }
    machine = {"name": "m", "chain": "w-b-X-Y-Z-t", "vertical_axis": "Z", "stroke_mm": {"X": [0, 1000], "Y": [0, 1], "Z": [0, 1]}}
    head = {"format": "abbe-run/1", "campaign": "c", "run_id": run_id, "test": "laser_linear", "role": "identify"}
    return run_of(head | {"machine": machine, "setup": setup, "columns": columns})


def figures(told: Evaluated, word: str, symbol: str = "E") -> list[tuple[float, float]]:
    return [(f.value, f.u) for f in told.figures if word in f.group and f.symbol == symbol]


def test_both_values_and_both_uncertainties_in_micrometres() -> None:
    """By hand, 1 m: 11.5 · 4 = 46 µm. u as measured: 11.5 · 0.2 = 2.3 and wavelength 0.3; reduced: also 4 · 0.6 = 2.4.

    The reduced deviations are all zero. Their slope is as uncertain as it is for any other axis, and so are E and A.
    """
    told = evaluate([line()], None, {"X": STEEL})
    assert figures(told, "as measured at 24.00 ± 0.40 °C") == [(pytest.approx(46.0), pytest.approx(np.hypot(2.3, 0.3)))]
    for symbol in ("E", "E+", "M", "A"):
        wanted = (pytest.approx(0.0, abs=1e-9), pytest.approx(np.sqrt(2.3**2 + 2.4**2 + 0.3**2)))
        assert figures(told, "at 20 °C, ISO 230-2", symbol) == [wanted], symbol
    twice = evaluate([line()], None, {"X": AxisMaterial(23e-6, 0.6e-6, 24.0, 0.1, 0.0)})
    assert figures(twice, "at 20 °C, ISO 230-2") == [(pytest.approx(46.0), pytest.approx(np.sqrt(2.3**2 + 2.4**2 + 0.3**2)))]
    assert [section.title for section in told.targets] == [
        "Deviation at each position: X L at 20 °C", "Deviation at each position: X L as measured"
    ]  # fmt: skip
    (reduced,), (measured,) = (section.blocks for section in told.targets)
    assert [row[0] for row in measured.rows] == [row[0] for row in reduced.rows]
    assert measured.rows[-1][:5] == ["1000", "46.0", "46.0", "46.0", "0"]
    assert REDUCTION_STATEMENT in told.statements
    assert told.conditions[f"{AT_20}, axis X L"].startswith("reduced from 24.00 ± 0.40 °C (stated in the machine file) with 11.5 ± 1.2 µm")


def test_the_sensor_of_the_axis_counts_before_the_stated_temperature() -> None:
    """Recorded 24 °C, stated 30 °C. A range of 0.6 K, rectangular, adds 0.6/√12 = 0.1732 K to 0.2 K: U is 2 · 0.2646 = 0.53 K."""
    told = evaluate([line(24.0, spread_k=0.6)], None, {"X": AxisMaterial(11.5e-6, 0.6e-6, 30.0, 0.2, 0.0)})
    assert figures(told, "as measured at 24.00 ± 0.53 °C") == [(pytest.approx(46.0), pytest.approx(np.hypot(11.5 * np.sqrt(0.07), 0.3)))]
    assert "recorded in the runs" in told.conditions[f"{AT_20}, axis X L"]


def test_what_the_laser_took_off_is_not_taken_off_twice() -> None:
    """Laser's compensation set to the scale's coefficient: what it shows is already at 20 °C, as well as its own sensor knew it: 2.3."""
    told = evaluate([line()], None, {"X": AxisMaterial(11.5e-6, 0.6e-6, 24.0, 0.2, 11.5e-6)})
    assert figures(told, "at 20 °C, ISO 230-2") == [(pytest.approx(46.0), pytest.approx(np.sqrt(2.3**2 + 2.4**2 + 0.3**2)))]
    assert figures(told, "as measured") == [(pytest.approx(46.0), pytest.approx(np.hypot(2.3, 0.3)))]


@pytest.mark.parametrize("read_c", [75.2, -40.0, 273.15 + 24.0], ids=["Fahrenheit", "broken wire", "kelvin"])
def test_a_sensor_out_of_bounds_is_not_used_and_the_report_says_so(read_c) -> None:
    told = evaluate([line(read_c)], None, {"X": STEEL})
    assert {f.group for f in told.figures} == {"Axis X, set-up L: positioning, ISO 230-2"}
    why = f"temp_x_C of run r has {read_c:g}, outside of -20 to 50 °C"
    assert any(f"not reduced to 20 °C: {why}" in remark for remark in told.remarks)
    assert holds_at([line(read_c)], {"X": STEEL}) == f"X unknown ({why})"


@pytest.mark.parametrize(("air_c", "said"), [(21.9, True), (22.1, False), (25.9, False), (26.1, True), (None, False)])
def test_air_far_from_the_stated_temperature_is_remarked(air_c, said) -> None:
    told = evaluate([line(air_c=air_c)], None, {"X": STEEL})
    assert any(f"air on record was at {air_c or 0:.2f} °C, the scale is stated at 24.00 °C" in r for r in told.remarks) is said
    assert figures(told, "at 20 °C, ISO 230-2")
    assert not any("air on record" in r for r in evaluate([line(24.0, air_c=air_c)], None, {"X": STEEL}).remarks)


def test_a_sensor_in_some_runs_only_is_remarked() -> None:
    told = evaluate([line(23.0), line(run_id="s")], None, {"X": STEEL})
    assert "stated in the machine file" in told.conditions[f"{AT_20}, axis X L"]
    assert any("only 1 of 2 runs recorded temp_x_C; the stated temperature is used" in r for r in told.remarks)
    without = evaluate([line(23.0), line(run_id="s")])
    assert any("only 1 of 2 runs recorded temp_x_C; it is not used" in r for r in without.remarks)


@pytest.mark.parametrize(
    ("made", "materials", "why"),
    [
        (line(), {}, "not reduced to 20 °C: the temperature of the scales is neither recorded nor stated"),
        (
            line(),
            {"X": AxisMaterial(11.5e-6, 0.6e-6, None, 0.2, 0.0)},
            "not reduced to 20 °C: the temperature of the scales is neither recorded nor stated",
        ),
        (line(24.0), {}, "no expansion coefficient of the scale; the figures hold at 24.00 ± 0.40 °C (recorded in the runs)"),
        (line(), {"Y": STEEL}, "not reduced to 20 °C: the temperature of the scales is neither recorded nor stated"),
    ],
)
def test_without_temperature_or_coefficient_nothing_is_reduced_and_the_report_says_why(made, materials, why) -> None:
    told = evaluate([made], None, materials)
    assert list(dict.fromkeys(f.group for f in told.figures)) == ["Axis X, set-up L: positioning, ISO 230-2"]
    assert any(why in line for line in told.remarks)
    assert REDUCTION_STATEMENT not in told.statements


def diagonal(name: str = "ppp", further: dict[str, float] | None = None) -> Run:
    """Five cycles along a body diagonal of a perfect steel machine, 600 by 500 by 400 mm, at 24 °C: 46 µm/m too long."""
    sign = np.where(np.array(list(name)) == "p", 1.0, -1.0)
    start, way = np.where(sign > 0.0, 0.0, [600.0, 500.0, 400.0]), sign * [600.0, 500.0, 400.0]
    at = np.tile(np.concatenate([np.linspace(0.0, 1.0, 6), np.linspace(1.0, 0.0, 6)]), 5)
    q = start + at[:, None] * way
    columns = {"t_s": np.arange(60.0).tolist()} | {f"{a}_mm": q[:, k].tolist() for k, a in enumerate("xyz")}
    columns |= {"direction": ([1] * 6 + [-1] * 6) * 5, "deviation_mm": (46e-6 * at * np.linalg.norm(way)).tolist()}
    columns |= {f"temp_{axis}_C": [value] * 60 for axis, value in (further or {}).items()}
    setup = {"setup_id": name, "t_set_s": 0.0, "diagonal": name, "start_mm": start.tolist(), "end_mm": (start + way).tolist()}
    strokes = {"X": [0, 600], "Y": [0, 500], "Z": [0, 400]}
    machine = {"name": "m", "chain": "w-b-X-Y-Z-t", "vertical_axis": "Z", "stroke_mm": strokes}
    head = {"format": "abbe-run/1", "campaign": "c", "run_id": name, "test": "laser_diagonal", "role": "holdout"}
    return run_of(head | {"machine": machine, "setup": setup, "columns": columns})


LENGTH_M = np.sqrt(0.6**2 + 0.5**2 + 0.4**2)
SHARES = np.array([0.36, 0.25, 0.16]) / 0.77


def test_diagonals_are_reduced_too() -> None:
    """By hand: 46 µm/m over √0.77 m. Each axis counts with its share; errors of t are independent, those of the coefficient add up."""
    told = evaluate([diagonal(name) for name in ("ppp", "npp", "pnp", "ppn")], None, dict.fromkeys("XYZ", STEEL))
    as_measured = np.hypot(2.3 * np.linalg.norm(SHARES), 0.3) * LENGTH_M
    reduced = np.sqrt((2.3 * np.linalg.norm(SHARES)) ** 2 + 2.4**2 + 0.3**2) * LENGTH_M
    assert figures(told, "displacement as measured at X 24.00 ± 0.40 °C", "E_d") == [
        (pytest.approx(46.0 * LENGTH_M, rel=1e-5), pytest.approx(as_measured, rel=1e-5))
    ]
    assert figures(told, "displacement at 20 °C, ISO 230-6", "E_d") == [(pytest.approx(0.0, abs=1e-3), pytest.approx(reduced, rel=1e-5))]
    assert {f.method for f in told.figures} == {"ISO 230-6, at 20 °C", "ISO 230-6, as measured"}
    assert told.conditions["ISO 230-6 at 20 °C, diagonal npp"].startswith("X reduced from 24.00 ± 0.40 °C")


def test_axes_of_a_diagonal_may_have_different_temperatures() -> None:
    """Only Z is warm, by 4 K: 0.16/0.77 of its strain. The error of the machine is still 46 µm/m; places count to 0.05 mm."""
    told = evaluate([diagonal(further={"x": 20.0, "y": 20.0, "z": 24.0})], None, dict.fromkeys("XYZ", STEEL))
    assert figures(told, "displacement at 20 °C", "E ppp")[0][0] == pytest.approx(46.0 * (1.0 - SHARES[2]) * LENGTH_M, rel=1e-5)


def test_one_axis_without_a_coefficient_leaves_the_diagonals_as_measured_and_says_so() -> None:
    told = evaluate([diagonal()], None, {"X": STEEL, "Y": STEEL})
    assert {f.method for f in told.figures} == {"ISO 230-6"}
    assert "body diagonals: not reduced to 20 °C: Z: the temperature of the scales is neither recorded nor stated" in told.remarks
    assert all(u > 0.0 for _, u in figures(told, "Body diagonals", "E_d"))


def test_what_a_part_has_at_20_degrees() -> None:
    """Aluminium, 23 µm/m/K, on a perfect steel axis at 24 °C: made 46 µm/m too long, it shrinks by 92. U: 23 · 0.2, 4 · 1, 0.3."""
    told = evaluate([line()], None, {"X": replace(STEEL, workpiece_per_k=23e-6, u_workpiece_per_k=1e-6)})
    wanted = (pytest.approx(46.0), pytest.approx(np.sqrt(4.6**2 + 4.0**2 + 0.3**2)))
    assert figures(told, "at 20 °C of a workpiece with 23.0 ± 2.0 µm/m/K") == [wanted]
    assert figures(told, "at 20 °C, ISO 230-2")[0][0] == pytest.approx(0.0, abs=1e-9)


def test_a_flat_axis_that_is_not_reduced_is_not_known_better_than_its_slope() -> None:
    """Laser and scale as usually assumed: 0.3 and 0.2 K · 11.5 µm/m/K over 1 m."""
    flat = line().with_readings(np.zeros(50))
    for symbol in ("E", "E+", "M", "A"):
        assert figures(evaluate([flat]), "positioning", symbol) == [(0.0, pytest.approx(np.hypot(0.3, 2.3)))], symbol


def test_at_which_temperature_a_table_of_these_runs_holds() -> None:
    assert holds_at([line(24.0)], {}) == "X 24.00 ± 0.40 °C (recorded in the runs)"
    assert holds_at([line()], {"X": STEEL}) == "X 24.00 ± 0.40 °C (stated in the machine file)"
    assert holds_at([line()], {}) == UNKNOWN


@pytest.mark.parametrize(
    ("materials", "text"),
    [
        ({"X": STEEL}, "X 24.00 ± 0.40 °C (stated in the machine file)"),
        ({}, "unknown: no temperature of the scales is on record or stated"),
    ],
)
async def test_a_push_report_says_at_which_temperature_its_table_holds(shared: Path, tmp_path: Path, materials, text) -> None:
    with Store.open(f"sqlite:///{tmp_path / 'a.sqlite3'}") as store:
        import_folder(store, shared / "data" / "axis-tests" / "week42-x")
        campaign = store.campaigns.find("week42-x")
        machine = store.machines.get(campaign.machine_id)
        solution = store.solutions.add(campaign.id, "joint", [r.id for r in store.runs.all(campaign.id)], {})
        clock = SystemClock()
        await as_if_pushed(store, clock, "one", {}, (b"of May", b"of June"), KEPT, solution=solution)
        store.machines.add("one", machine.doc)
        told = push_report(store, "one", 1, Rules(materials=materials))
        assert told.about["Table holds at"] == text
        await as_if_pushed(store, clock, "one", {}, (b"of June", b"of July"), KEPT)
        assert "Table holds at" not in push_report(store, "one", 2, Rules(materials=materials)).about


def test_every_form_of_the_report_shows_both(shared: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The steepest line between the deciding places is 2 mm long there: E+ grows by 46 µm/m · 2 mm = 0.092 µm."""
    machine, out = tmp_path / "machine.toml", [tmp_path / f"x.{form}" for form in ("html", "csv", "json")]
    machine.write_text(MACHINE, encoding="utf-8")
    words = ["report", str(shared / "data" / "axis-tests" / "week42-x"), "--machine", str(machine)]
    assert run([*words, *(w for path in out for w in ("--out", str(path)))]) == 0
    assert "ISO 230-2 at 20 °C, axis X L: reduced from 24.00 ± 0.40 °C" in capsys.readouterr().out
    page = out[0].read_text(encoding="utf-8")
    assert "positioning at 20 °C, ISO 230-2" in page
    assert "positioning as measured at 24.00 ± 0.40 °C" in page
    rows = {(r["method"], r["symbol"]): r for r in csv.DictReader(io.StringIO(out[1].read_text(encoding="utf-8")))}
    at_20, as_read = rows["ISO 230-2, at 20 °C", "E+"], rows["ISO 230-2, as measured", "E+"]
    assert float(at_20["value"]) - float(as_read["value"]) == pytest.approx(0.092, abs=1e-9)
    assert float(at_20["expanded"]) > float(as_read["expanded"]) > 0.0
    doc = json.loads(out[2].read_text(encoding="utf-8"))
    assert any(name.startswith(AT_20) for name in doc["conditions"])
    assert {f["method"] for f in doc["figures"]} == {"ISO 230-2, at 20 °C", "ISO 230-2, as measured"}


def test_a_coefficient_in_other_units_or_without_uncertainty_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    machine = tmp_path / "machine.toml"
    for old, new, says in (
        ("X = 11.5e-6", "X = 11.5", "material.scale_per_k.X: expected "),
        ("u_scale_per_k = {X = 0.6e-6}", "", "scale_per_k.X and u_scale_per_k.X belong together"),
        ("temperature_c = 24.0", "temperature_c = 75.2", "material.temperature_c: expected "),
        ("temperature_c = 24.0", "workpiece_per_k = 23e-6", "workpiece_per_k and u_workpiece_per_k belong together"),
    ):
        machine.write_text(MACHINE.replace(old, new, 1), encoding="utf-8")
        assert run(["check-config", "-m", str(machine)]) == 2
        told = capsys.readouterr().err.strip()
        assert says in told
        assert len(told.splitlines()) <= 2
