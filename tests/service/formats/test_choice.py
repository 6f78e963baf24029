"""The best use of a control: what each kind leaves, directions of lost motion, order of effects; and the commands end to end."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from abbe.models.geometry.bases import smooth_terms
from abbe.models.geometry.volume import volume_grid
from abbe.models.machine import Machine
from abbe.service.cli import run
from abbe.service.compensation.comp_export import export, identified, reach_note
from abbe.service.formats.controls import CONTROLS, FormatJudge, best_of, choices
from abbe.service.formats.identified import Identified
from abbe.service.formats.model import AxisTable, Compensation, correction_at

STROKE = np.array([[0.0, 500.0], [-200.0, 200.0], [-300.0, 0.0]])
MACHINE = Machine("w-X-b-Y-Z-t", STROKE, np.zeros((3, 3)), np.array([0.0, 0.0, -150.0]))
START = STROKE[:, 0]


def _known(seed: int = 1, lost: tuple[float, float, float] = (0.004, 0.006, -0.002)) -> Identified:
    terms, rng = smooth_terms(3), np.random.default_rng(seed)
    size = [30e-6 if t.order == 0 else (8e-3 if t.component < 3 else 15e-6) / t.order for t in terms]
    return Identified(MACHINE, terms, np.array(size) * rng.normal(size=len(terms)), dict(zip("XYZ", lost, strict=True)))


def _document(known: Identified) -> dict[str, object]:
    n = len(known.terms)
    covariance = {"encoding": "", "shape": [n, n], "data": _base64(np.zeros(n * (n + 1) // 2))}
    terms = [[t.motion, t.order, t.axis, t.component] for t in known.terms]
    return {
        "machine": {
            "chain": MACHINE.chain,
            "stroke_mm": {a: list(s) for a, s in zip("XYZ", STROKE.tolist(), strict=True)},
            "tool_mm": [0.0, 0.0, -150.0],
        },
        "prediction": {"terms": terms, "coefficients": known.coefficients.tolist(), "covariance": covariance, "scatter_mm": 0.0},
        "parameters": {f"backlash_{a}": {"value": v, "u": 1e-4, "status": "observed"} for a, v in known.lost_motion_mm.items()},
    }


def _base64(values: np.ndarray) -> str:
    import base64

    return base64.b64encode(values.astype("<f8").tobytes()).decode()


def test_more_kinds_leave_less_and_products_leave_almost_nothing() -> None:
    """Rule G is sums and products of functions of one axis: with all of them only the broken lines and the rounding are left."""
    found = {c.kind: c for c in choices(_known(), CONTROLS["siemens-840d"], START)}
    none, own, cross, products = found.values()
    assert none.rms_mm > own.rms_mm > cross.rms_mm > 10 * products.rms_mm
    assert products.best
    assert products.max_mm < 0.001


def test_products_matter_only_where_carriages_turn() -> None:
    known = _known()
    still = replace(known, coefficients=np.where([t.component > 2 and t.order > 0 for t in known.terms], 0.0, known.coefficients))
    found = choices(still, CONTROLS["linuxcnc"], START)
    assert best_of(found).kind == "one-axis and cross tables"


def test_control_with_eight_tables_gets_those_that_matter() -> None:
    found = choices(_known(), CONTROLS["siemens-828d"], START)
    best = best_of(found)
    assert len(best.compensation.cross) + 2 * len(best.compensation.products) <= 8
    every = best_of(choices(_known(), CONTROLS["siemens-840d"], START))
    assert every.rms_mm < best.rms_mm < found[1].rms_mm


def test_residual_is_what_a_machine_would_show() -> None:
    """The judge's figure against the machine itself: exact positions, both directions, no function of the judge."""
    known, control = _known(), CONTROLS["linuxcnc"]
    comp = best_of(choices(known, control, START)).compensation
    p = volume_grid(STROKE, 7)
    left = []
    for way in (1, -1):
        lost = np.array([known.lost_motion_mm[a] for a in "XYZ"])
        left.append(known.deviation_mm(p) - 0.5 * way * lost + correction_at(comp, p, np.full(p.shape, float(way))))
    spread = np.concatenate(left)
    assert np.abs(left[0] - left[1]).max() < 2e-6  # lost motion is gone: moving in + and in − end at one place
    from abbe.models.geometry.volume import remove_rigid

    rms = np.sqrt(np.mean(np.sum(remove_rigid(np.concatenate([p, p]), spread) ** 2, axis=1)))
    assert rms < 0.0005


def test_backward_column_takes_the_lost_motion_out() -> None:
    """An axis with lost motion B stands B further while it moves in − than while it moves in +: its backward column is less by B."""
    comp = best_of(choices(_known(), CONTROLS["mach4"], START)).compensation
    for axis, lost in (("X", 0.004), ("Y", 0.006), ("Z", -0.002)):
        table = next(t for t in comp.tables if t.axis == axis)
        np.testing.assert_allclose(table.backward_mm - table.forward_mm, -lost, atol=1e-12)
        assert table.forward_mm[0] == pytest.approx(0.0, abs=1e-12)


def test_control_without_columns_is_told_its_backlash() -> None:
    made = export(_known(), "siemens-840d")
    assert any("X 4.00 µm, Y 6.00 µm, Z -2.00 µm" in note for note in made.notes)
    assert made.notes[0] == "holds at: unknown: no temperature of the scales is on record or stated"
    assert {f.name for f in made.files} == {"AX_EEC.INI", "NC_CEC.INI"}


@pytest.mark.parametrize(
    ("reached", "said"),
    [
        ({"X": (0.0, 500.0), "Y": (-200.0, 165.0), "Z": (-300.0, 0.0)}, []),
        ({"X": (20.0, 430.0), "Y": (-200.0, 200.0), "Z": (-300.0, 0.0)}, ["X below 20 or above 430 mm of its stroke 0 to 500 mm"]),
        ({}, []),
    ],
    ids=["nearly all", "an end of X is missing", "not known"],
)
def test_what_no_run_reached_is_said_with_the_tables(reached: dict[str, tuple[float, float]], said: list[str]) -> None:
    notes = reach_note(_document(_known()) | {"reached_mm": reached})
    assert len(notes) == len(said)
    assert all(text in note for text, note in zip(said, notes, strict=True))


def test_cross_tables_looked_up_at_the_corrected_position() -> None:
    own = AxisTable("X", "X", np.array([0.0, 100.0]), *[np.array([0.0, 1.0])] * 2)
    cross = AxisTable("X", "Y", np.array([0.0, 100.0]), *[np.array([0.0, 0.1])] * 2)
    at = np.array([[50.0, 0.0, 0.0]])
    comp = Compensation((own, cross))
    assert correction_at(comp, at)[0, 1] == pytest.approx(0.05)
    assert correction_at(comp, at, lookup="corrected")[0, 1] == pytest.approx(0.0505)


def test_all_motions_and_squareness_leave_almost_nothing() -> None:
    for key in ("heidenhain-kinematics", "linuxcnc-kins"):
        found = choices(_known(lost=(0.0, 0.0, 0.0)), CONTROLS[key], START)
        assert best_of(found).rms_mm < 0.0003 < found[0].rms_mm / 20, key


def test_grid_leaves_less_than_one_axis_tables() -> None:
    found = choices(_known(), CONTROLS["fanuc-30i"], START)
    assert found[2].rms_mm < found[1].rms_mm
    assert best_of(found) is found[2]
    judge = FormatJudge(_known(), CONTROLS["fanuc-30i"])
    assert float(np.sqrt(np.mean(judge.left_mm(Compensation()) ** 2))) == pytest.approx(found[0].rms_mm)


@pytest.mark.parametrize("key", [*CONTROLS, "linuxcnc-0", "linuxcnc-hal", "siemens-cec", "fanuc-lattice"])
def test_export_and_import_by_the_commands(key: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source, out = tmp_path / "solution.json", tmp_path / "out"
    source.write_text(json.dumps(_document(_known())))
    name = {"linuxcnc-0": "linuxcnc-0", "mach4": "mach4"}.get(key, key)
    assert run(["comp", "export", str(source), "--format", name, "--out", str(out)]) == 0, capsys.readouterr().err
    capsys.readouterr()
    assert run(["comp", "import", str(out), "--format", name, "--solution", str(source), "--json"]) == 0, capsys.readouterr().err
    told = json.loads(capsys.readouterr().out)
    assert told["tables"]
    unit = 1e3 * {
        "heidenhain-kinematics": 6e-4,
        "fanuc": 1e-3,
        "fanuc-30i": 1e-3,
        "fanuc-lattice": 1e-3,
        "centroid": 1e-4,
        "heidenhain": 1e-4,
        "mach4": 1e-4,
    }.get(key, 1e-6)
    assert max(told["differences_um"].values()) <= 0.51 * unit + 1e-3


def test_tables_without_a_scale_that_the_runs_hardly_tell(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A common scale of 50 µm/m on top changes nothing in tables that leave the common scale out."""
    known = _known()
    scale = np.zeros(len(known.terms))
    for a, axis in enumerate("XYZ"):  # a Legendre polynomial of order 1 rises by 2 over the stroke
        scale[[t.name for t in known.terms].index(f"E{axis}{axis}.1")] = 50e-6 * np.ptp(STROKE[a]) / 2.0
    u = {"worst_point": {"expanded_vector_um": 73.0}, "without_scale": {"scales": "common", "expanded_vector_um": 13.0}}
    stretched, files = replace(known, coefficients=known.coefficients + scale), []
    for k, machine in enumerate((known, stretched)):
        source, out = tmp_path / f"{k}.json", tmp_path / f"out{k}"
        source.write_text(json.dumps(_document(machine) | {"uncertainty": u}))
        export = ["comp", "export", str(source), "--format", "linuxcnc", "--out", str(out)]
        assert run([*export, "--without-scale"]) == 0
        assert "the common scale: left out, and not corrected; the rest is known to ± 13 µm" in capsys.readouterr().out
        files.append((out / "x.comp").read_text())
        assert run([*export[:-1], str(tmp_path / f"whole{k}")]) == 0
        assert "--without-scale leaves it out" in capsys.readouterr().out
    assert files[0] == files[1] != (tmp_path / "whole0" / "x.comp").read_text()

    source.write_text(json.dumps(_document(known)))
    assert run([*export, "--without-scale"]) == 2
    assert "determines the scales as well as the rest" in capsys.readouterr().err


def test_the_measured_step_turns_the_sign_where_no_manual_states_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = tmp_path / "solution.json"
    source.write_text(json.dumps(_document(_known())))
    told = {}
    for moved in ("-10.8", "9.5"):
        out = tmp_path / f"out{moved}"
        word = ["--step-moved", moved, "--format", "siemens-840d"]
        assert run(["comp", "export", str(source), "--out", str(out), *word]) == 0
        assert "Siemens CEC: sign by the measured step" in capsys.readouterr().out
        assert run(["comp", "import", str(out), "--solution", str(source), *word]) == 0, capsys.readouterr().err
        told[moved] = {f.name: f.read_text() for f in out.iterdir()}
    as_is, other = told.values()
    assert as_is["AX_EEC.INI"] == other["AX_EEC.INI"]  # a manual states this one
    first = re.search(r"\$AN_CEC\[0,12\]=(.*)", as_is["NC_CEC.INI"])
    assert first is not None
    assert f"$AN_CEC[0,12]={-float(first.group(1))}" in other["NC_CEC.INI"]
    assert run(["comp", "import", str(out), "--solution", str(source), "--format", "siemens-840d"]) == 2  # another sign than expected
    assert run(["comp", "export", str(source), "--out", str(tmp_path / "x"), "--format", "siemens-840d", "--step-moved", "1"]) == 2
    assert "neither -10 nor +10" in capsys.readouterr().err


def test_skew_commands_leave_less_than_nothing_and_say_so() -> None:
    """A machine out of square only, with lost motion: Marlin corrects both, Klipper the squareness, grblHAL the lost motion."""
    known = _known(lost=(0.010, 0.010, -0.002))
    square = replace(known, coefficients=np.where([t.order == 0 for t in known.terms], known.coefficients, 0.0))
    left = {}
    for key in ("marlin", "klipper", "grblhal"):
        found = choices(square, CONTROLS[key], START)
        left[key] = best_of(found).rms_mm
        assert left[key] < found[0].rms_mm
    assert left["marlin"] == pytest.approx(0.001, rel=0.05)  # the negative lost motion of Z is no lost motion
    assert left["marlin"] < min(left["klipper"], left["grblhal"])
    assert not any("own backlash parameter" in n for n in export(square, "marlin").notes)


def test_turned_sign_is_named_and_nothing_is_half_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source, out = tmp_path / "solution.json", tmp_path / "out"
    source.write_text(json.dumps(_document(_known(lost=(0.0, 0.0, 0.0)))))
    assert run(["comp", "export", str(source), "--format", "mach4", "--out", str(out)]) == 0
    for sheet in out.iterdir():
        lines = sheet.read_text().splitlines()
        rows = [line.split(",") for line in lines[5:]]
        turned = [",".join([r[0], r[1], *(f"{-float(v):.4f}" for v in r[2:])]) for r in rows]
        sheet.write_text("\n".join([*lines[:5], *turned]) + "\n")
    capsys.readouterr()
    assert run(["comp", "import", str(out), "--format", "mach4", "--solution", str(source)]) == 2
    assert "TAB-003: the sign is wrong" in capsys.readouterr().err
    assert run(["comp", "export", str(source), "--format", "mach4", "--out", str(out)]) == 2
    assert run(["comp", "export", str(source), "--format", "nothing", "--out", str(tmp_path / "x")]) == 2
    assert sorted(p.name for p in tmp_path.iterdir()) == ["out", "solution.json"]
    source.write_text('{"format": "abbe-solution/1"}')
    with pytest.raises(Exception, match="holds no coefficients"):
        identified(json.loads(source.read_text()))
