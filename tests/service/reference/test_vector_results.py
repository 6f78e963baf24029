"""`abbe vectors` on folders with missing, emptied, bad and unknown files: one answer for all files, no traceback, no warning."""

import json
import shutil

import pytest

from abbe.service.cli import run
from abbe.service.errors import FileFormatError
from abbe.service.reference.vector_results import check_file
from tests.service.reference.vectors.altering import load, read

QUICK = ("pahk_diagonals", "paper_tables", "yang_helix")


@pytest.fixture
def folder(tmp_path, shared):
    for name in QUICK:
        shutil.copy(shared / "vectors" / f"{name}.json", tmp_path)
    return tmp_path


def answer(folder, capsys):
    code = run(["vectors", str(folder), "--json"])
    out, err = capsys.readouterr()
    return code, json.loads(out), err


def test_a_part_of_the_files_holds_and_is_not_complete(folder, capsys):
    code, doc, err = answer(folder, capsys)
    assert (code, doc["ok"], doc["complete"], len(doc["missing"]), err) == (0, True, False, 11, "")
    assert run(["vectors", str(folder)]) == 0
    said = capsys.readouterr()
    assert said.err.splitlines()[-1] == "next: abbe papers"
    last = said.out.splitlines()[-1]
    assert last.startswith("3 of 14 files")
    assert last.endswith("all hold, NOT complete")


def test_bad_files_do_not_cost_the_results_of_the_others(folder, capsys):
    (folder / "foo.json").write_text("{}")
    (folder / "probe.json").write_text("[" * 200_000)
    code, doc, err = answer(folder, capsys)
    assert (code, doc["ok"], doc["complete"]) == (2, False, False)
    files = {f["file"]: f for f in doc["files"]}
    assert all(files[f"{name}.json"]["ok"] for name in QUICK)
    assert "no reader" in files["foo.json"]["error"]
    assert "nested too deeply" in files["probe.json"]["error"]
    assert [line[:14] for line in err.splitlines()] == ["error FMT-001:"] * 2


def test_a_deviation_is_exit_1_and_an_unusable_file_wins(folder, capsys):
    doc = json.loads((folder / "paper_tables.json").read_text())
    doc["slope_ols"] *= 1 + 5e-8
    (folder / "paper_tables.json").write_text(json.dumps(doc))
    assert answer(folder, capsys)[0] == 1
    (folder / "foo.json").write_text("{}")
    assert answer(folder, capsys)[0] == 2


def test_the_key_of_a_machine_twice(folder, capsys):
    path = folder / "pahk_diagonals.json"
    path.write_text(path.read_text().replace('"types": {', '"types": {"MB1": {}, ', 1))
    code, doc, _ = answer(folder, capsys)
    assert code == 2
    assert "key 'MB1' appears twice" in doc["files"][0]["error"]


def put(doc, path, value):
    for key in path[:-1]:
        doc = doc[key]
    doc[path[-1]] = value


def drop(doc, path):
    for key in path[:-1]:
        doc = doc[key]
    del doc[path[-1]]


EMPTIED = [
    ("pahk_diagonals", ("types", "MB1", "diagonals"), {}),
    ("pahk_random", ("types", "MB1"), []),
    ("paper_tables", ("pahk_A", "squareness_only_um"), {}),
    ("paper_tables", ("table2", "dxx"), [-8.5619e-05, -8.7176e-05, 1.5571e-06, 1.0]),
    ("paper_tables", ("pahk_A", "printed_diag_um"), []),
    ("kwon_rsm", ("F_crit",), {}),
    ("kwon_kinematics", ("fk",), []),
    ("kwon_kinematics", ("frame", "T_pm_to_cmm"), []),
    ("probe", ("combined",), []),
    ("probe", ("directions",), []),
    ("probe", ("sphere", "colat_lon"), []),
    ("pahk_random", ("types", "MB1", 0, "X"), 5.0),
    ("pahk_diagonals", ("types", "MB1", "diagonals", "xyz"), {"first_order": 0.0, "full": 0.0}),
    ("wang_step_diagonal", ("cases", "with_angles|none", "a_coef", "XZ"), 1.0),
    ("wang_step_diagonal", ("cases", "with_angles|none", "wang_eq7"), {}),
    ("yang_helix", ("sets",), []),
    ("yang_ranks", ("ranks", "e1 full 3D vector map, one tool"), []),
    ("yang_ballbar_complete", ("result", "map_noise_gain_d1_to_d4"), {}),
    ("yang_conditioning", ("two_radii",), {}),
    ("yang_volumetric", ("cases",), []),
]
DROPPED = [
    ("pahk_diagonals", ("types", "MB1", "diagonals", "npp")),
    ("pahk_random", ("types", "MB1", 0, "printed_eq5")),
    ("paper_tables", ("table2", "dyy")),
    ("paper_tables", ("pahk_B",)),
    ("kwon_rsm", ("table2 ex",)),
    ("kwon_rsm", ("rank 3 planes",)),
    ("wang_step_diagonal", ("cases", "with_angles|none", "wang_lsq4", "ZZ")),
    ("wang_step_diagonal", ("ranks", "ideal mirror")),
    ("wang_step_diagonal", ("compensation_demo", "no_compensation")),
    ("yang_ranks", ("null_space_degree1", "a1 one helix R175, no setup unknowns")),
    ("yang_conditioning", ("corr9_5turns",)),
]


def refused(tmp_path, name, doc) -> str:
    path = tmp_path / f"{name}.json"
    path.write_text(json.dumps(doc))
    return check_file(path).error


@pytest.mark.parametrize(("name", "where", "value"), EMPTIED, ids=lambda v: str(v)[:40])
def test_what_is_emptied_or_of_another_kind_makes_the_file_unusable(tmp_path, shared, name, where, value):
    doc = load(shared, name)
    put(doc, where, value)
    error = refused(tmp_path, name, doc)
    assert f"{name}.json" in error
    assert str(where[-1]) in error


@pytest.mark.parametrize(("name", "where"), DROPPED, ids=lambda v: str(v)[:40])
def test_a_missing_expected_value_makes_the_file_unusable(tmp_path, shared, name, where):
    doc = load(shared, name)
    drop(doc, where)
    assert refused(tmp_path, name, doc)


def test_one_position_is_too_few_and_no_warning(tmp_path, shared, capfd):
    doc = load(shared, "pahk_abbe")
    for part in doc["types"].values():
        for key in ("measured", "true_translational"):
            part[key] = {k: v[:1] for k, v in part[key].items()}
    assert "at least two positions" in refused(tmp_path, "pahk_abbe", doc)
    assert capfd.readouterr().err == ""


def test_a_draw_of_noise_has_to_be_a_number(shared):
    doc = load(shared, "kwon_kinematics")
    doc["frame"]["T_pm_to_cmm"][0][3] = float("nan")
    with pytest.raises(FileFormatError, match="T_pm_to_cmm/0/3: expected a finite number, got nan"):
        read("kwon_kinematics", doc)


def test_another_printed_total_or_f_deviates(shared):
    for key, value in (("SST_printed", 0), ("F_printed", -7)):
        doc = load(shared, "kwon_rsm")
        for component in ("ex", "ey", "ez"):
            doc[f"table2 {component}"][key] = value
        assert len(read("kwon_rsm", doc).quantities[f"Table 2, {key}"].failures) == 3


def test_an_f_of_six_digits_is_taken(shared):
    doc = load(shared, "kwon_rsm")
    doc["table2 ex"]["F_printed"] = 981.083
    assert read("kwon_rsm", doc).ok


def test_what_was_found_by_trial_is_listed(shared):
    facts = check_file(shared / "vectors" / "probe.json").to_document()["assumptions"]
    assert len(facts) == 1
    assert "radius of 1 mm" in facts[0]
