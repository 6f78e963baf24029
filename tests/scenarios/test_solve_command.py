"""`abbe solve` as people use it: a folder or a campaign of the store, words, JSON, a page; what is refused leaves nothing behind."""

import json
import re
import tarfile

import numpy as np
import pytest

from abbe.models.geometry.volume import unit_deviation, volume_frame
from abbe.service.campaign_data.campaign_folder import from_folder
from abbe.service.domain.machine import machine_from_doc
from abbe.service.domain.solution_file import SolutionFile, StoredPrediction
from abbe.service.identification.solve import solve_runs
from abbe.service.runs.exchange import import_folder
from abbe.service.storage.store import Store
from tests.experiments.campaigns.population import draw_case
from tests.scenarios.campaign_files import measured, thinned, write_folder

pytestmark = [pytest.mark.scenario, pytest.mark.timeout(120), pytest.mark.usefixtures("solved_once")]
SEED = 7


@pytest.fixture(autouse=True)
def own_database(monkeypatch):
    monkeypatch.delenv("ABBE_DB", raising=False)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    site, runs = measured(SEED, "one_tool")
    return write_folder(tmp_path_factory.mktemp("c1"), site.doc, runs)


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """The same with fifty readings of a ball-bar run."""
    site, runs = measured(SEED, "one_tool")
    return write_folder(tmp_path_factory.mktemp("small") / "c1", site.doc, thinned(runs, 10))


def test_a_folder_is_solved_told_and_drawn_and_nothing_is_stored(command, folder, tmp_path):
    code, out, err = command("solve", folder, "--report", "page.html", "--details")
    assert code == 0
    text = " ".join(out.split())
    for words in (
        "U (k = 2)",
        "Observability",
        "noise found",
        "outliers:",
        "residuals that are not noise",
        "Worst known point",
        "one tool length",
    ):
        assert words in text
    assert "units, axes, copies, machine" in err
    page = (tmp_path / "page.html").read_text()
    pictures = ("can have a compensation table of their own", "Noise gain, Z = ", "µm per µm")
    for words in (
        "Error motions",
        "Uncertainty in the volume",
        "What this measurement could not show",
        "sensor noise of the laser",
        "SHA-256",
        *pictures,
    ):
        assert words in page
    assert page.count("<svg") > 10
    assert not re.search(r"<script|https?://|@import|url\(", page)
    assert [p.name for p in tmp_path.iterdir()] == ["page.html"]


def test_json_keeps_to_its_schema_and_holds_the_truth(command, folder):
    code, out, _ = command("solve", folder, "--json")
    doc = json.loads(out)
    SolutionFile.model_validate_json(out)
    assert code == 0
    assert re.fullmatch(r"rigid21/legendre\d+\+order-by-heldout", doc["model"])
    assert "solution_id" not in doc
    assert doc["not_observable"]  # one tool: something is always hidden (math.md 4.6)
    assert doc["rank"]["rank"] < doc["rank"]["of"]
    assert {p["status"] for p in doc["parameters"].values()} <= {"observed", "weak", "not observable"}
    assert sum(line["share"] for line in doc["uncertainty"]["budget"]) == pytest.approx(1.0)
    assert 0.2 < doc["noise"]["bar"]["sigma_um"] < 1.0
    assert set(doc["inputs"]["runs"]) == set(doc["runs"])
    truth = draw_case(SEED, "one_tool").truth
    for name in ("backlash_X", "backlash_Y", "backlash_Z"):
        found = doc["parameters"][name]
        assert abs(found["value"] - truth.parameters([name])[0]) < 4 * found["u"]
    worst = doc["uncertainty"]["worst_point"]
    assert worst["expanded_vector_um"] >= max(worst["expanded_um"])
    machine = machine_from_doc(doc["machine"])
    terms, coefficients, covariance = StoredPrediction.read(doc["prediction"]).unpacked()
    field_at = unit_deviation(machine, terms, np.array([worst["at_mm"]]), None, volume_frame(machine))[0]
    assert field_at @ coefficients * 1e3 == pytest.approx(worst["deviation_um"], abs=1e-6)
    assert np.sqrt(np.diag(field_at @ covariance @ field_at.T)) * 1e3 == pytest.approx(worst["u_um"], rel=0.01)


def test_grid_and_tables_on_request(command, small, tmp_path):
    code, out, err = command("solve", small, "--grid", "grid.csv", "--nodes", 4, "--tables")
    assert code == 0, err
    text = " ".join(out.split())
    rows = np.loadtxt(tmp_path / "grid.csv", delimiter=",", skiprows=1)
    assert (tmp_path / "grid.csv").read_text().splitlines()[0].startswith("x_mm,y_mm,z_mm,dx_um")
    assert rows.shape == (64, 10)
    used = rows[:, 9] == 1
    assert used.any()
    assert (rows[~used, 3:6] == rows[~used, 3:6][:1]).all()  # no distance between two nodes that are left alone changes
    assert np.allclose(rows[:, 3:6] / 0.1, np.round(rows[:, 3:6] / 0.1), atol=1e-6)  # the machine's unit
    kinds = text.split("error of distances left")[1]
    assert len(re.findall(r"\d ± \d", kinds)) >= 9


def test_deviation_at_points_on_request(command, small, tmp_path):
    """The same numbers as the report's map, and what the command refuses."""
    (tmp_path / "points.csv").write_text("x_mm,y_mm,z_mm\n100,200,-50\n300,250,-100\n")
    code, out, err = command("solve", small, "--at", "points.csv", "--out", "at.csv")
    assert code == 0, err
    assert "deviation: at.csv" in out
    header, *rows, verdict = (tmp_path / "at.csv").read_text().splitlines()
    assert header == "x_mm,y_mm,z_mm,dx_um,dy_um,dz_um,U_dx_um,U_dy_um,U_dz_um"
    values = np.array([[float(v) for v in row.split(",")] for row in rows])
    assert values[:, :3].tolist() == [[100.0, 200.0, -50.0], [300.0, 250.0, -100.0]]
    assert (values[:, 6:] > 0.0).all()
    assert verdict.startswith("# verdict: ")
    for words, told in ((("--at", "points.csv"), "belong together"), (("--at", "none.csv", "--out", "b.csv"), "no such file")):
        code, _, err = command("solve", small, *words)
        assert code == 2
        assert told in err
    assert not (tmp_path / "b.csv").exists()


def trials_agree(text):
    """The stated interval against the trials': limits count as rectangular, so theirs is a little narrower than a normal one's."""
    told = re.search(r"Monte Carlo \(GUM Supplement 1, (\d+) trials\).*?in µm: (.*?): the stated uncertainty is", text)
    assert told is not None
    assert int(told[1]) >= 10_000
    pairs = re.findall(r"stated ± ([\d.]+), found ± ([\d.]+)", told[2])
    assert len(pairs) == 3
    for half, found in pairs:
        assert float(found) == pytest.approx(float(half), rel=0.15)


def test_trials_on_request_for_six_parameters_which_give_no_grid_where_they_do_not_fit(command, tmp_path):
    """Trials of all 21 motions: tests/models/uncertainty/test_uncertainty_trials.py. They draw every reading many thousand times."""
    site, runs = measured(SEED, "one_tool")
    few = write_folder(tmp_path / "few", site.doc, thinned(runs, 20))
    code, out, err = command("solve", few, "--model", "rigid6", "--monte-carlo")
    assert code == 0, err
    trials_agree(" ".join(out.split()))
    code, out, err = command("solve", few, "--model", "rigid6", "--grid", "grid.csv")
    assert (code, out) == (2, "")
    assert "error CMP-001: no grid from a solution with open flags" in err
    assert list(tmp_path.iterdir()) == [few]


def test_residuals_are_one_line_per_run(command, folder, tmp_path):
    site, runs = measured(SEED, "one_tool")
    wave = next(r for r in runs if r["test"] == "ballbar_helix")
    columns = wave["columns"]
    columns["deviation_mm"] = [v + 2e-3 * np.sin(x / 9.0) for v, x in zip(columns["deviation_mm"], columns["x_mm"], strict=True)]
    code, out, _ = command("solve", write_folder(tmp_path / "wave", site.doc, runs), "--details")
    assert code == 0
    lines = out.split("residuals that are not noise:")[1].split("these runs cannot tell")[0].splitlines()
    named = [line.split(":")[0] for line in lines if line.startswith("- ")]
    assert f"- {wave['run_id']}" in named
    assert len(named) == len(set(named))


def test_a_stored_campaign_is_solved_twice_and_recognised(command, small, tmp_path):
    with Store.open("sqlite:///a.sqlite3") as store:
        import_folder(store, small)
    six = ("--db", "sqlite:///a.sqlite3", "--model", "rigid6")
    first = json.loads(command("solve", "c1", "--json", *six)[1])
    code, out, _ = command("solve", small, *six)
    assert code == 0
    assert f"the same readings and model as solution {first['solution_id']}" in out
    with Store.open("sqlite:///a.sqlite3") as store:
        kept = store.solutions.all(store.campaigns.find("c1").id)
        runs = {r.id for r in store.runs.all("c1")}
    assert [s.id for s in kept] == [1, 2]
    for solution in kept:
        assert set(solution.run_ids) == set(solution.doc["run_ids"]) == runs
        assert solution.doc["versions"]["abbe"]
        assert solution.doc["model"] == "rigid6"
    assert kept[0].doc["inputs"] == kept[1].doc["inputs"]
    other = json.loads(command("solve", "c1", "--json", "--db", "sqlite:///a.sqlite3")[1])
    assert other["model"].startswith("rigid21/")
    assert other["same_as"] == []
    assert {n for n in first["parameters"] if n[0] == "E" or n in ("C0Y", "B0Z", "A0Z")} == {"EXX.1", "EYY.1", "EZZ.1", "C0Y", "B0Z", "A0Z"}


def test_what_is_refused_is_one_line_and_leaves_nothing(command, tmp_path):
    site, runs = measured(SEED, "one_tool")
    runs[2]["columns"]["deviation_mm"] = [v / 25.4 for v in runs[2]["columns"]["deviation_mm"]]
    bad = write_folder(tmp_path / "bad", site.doc, runs)
    code, out, err = command("solve", bad, "--db", "sqlite:///b.sqlite3", "--report", "page.html")
    line = err.splitlines()[-1]
    assert (code, out) == (2, "")
    assert line.startswith(f"error SOL-003: run {runs[2]['run_id']}: ")
    assert "inches" in line
    assert "--without" in line
    assert [p.name for p in tmp_path.iterdir()] == ["bad"]
    assert command("solve", bad, "--without", runs[2]["run_id"], "--model", "rigid6")[0] == 0


def test_a_real_axis_with_a_coarse_sensor_and_few_readings_is_solved(command, shared):
    """Its repeats are alike to the last digit, and 24 readings are too few for 21 error motions: the six are solved, and that is told."""
    code, out, err = command("solve", shared / "data" / "foreign" / "bifrost" / "11361-axis1-resolver", "--json")
    assert code == 0, err
    doc = json.loads(out)
    assert doc["model"].startswith("rigid6")
    assert any("24 readings in all are too few for rigid21" in line for line in doc["flags"])
    assert doc["parameters"]["backlash_X"]["value"] == pytest.approx(-0.2e-3, abs=0.1e-3)


def test_a_bad_run_in_the_store_stores_no_solution(command, tmp_path):
    site, runs = measured(SEED, "one_tool")
    again = json.loads(json.dumps(runs[1])) | {"run_id": "twin"}
    with Store.open("sqlite:///c.sqlite3") as store:
        import_folder(store, write_folder(tmp_path / "twice", site.doc, [*runs, again]))
    code, out, err = command("solve", "c1", "--db", "sqlite:///c.sqlite3")
    assert (code, out) == (2, "")
    assert f"run twin: its readings are the same as in run {runs[1]['run_id']}" in err
    with Store.open("sqlite:///c.sqlite3") as store:
        assert store.solutions.all() == []


def test_a_folder_does_not_pass_for_a_stored_campaign_of_its_name(command, small, tmp_path):
    site, runs = measured(SEED, "one_tool")
    runs = thinned(runs, 10)
    runs[-1]["columns"]["deviation_mm"][7] += 1e-3
    with Store.open("sqlite:///d.sqlite3") as store:
        import_folder(store, write_folder(tmp_path / "other", site.doc, runs))
    code, _, err = command("solve", small, "--model", "rigid6", "--db", "sqlite:///d.sqlite3")
    assert code == 2
    assert "a different campaign 'c1'" in err
    assert "the machine (chain" not in err  # its readings do


def test_another_machine_with_the_same_readings_is_another_campaign(command, small, tmp_path):
    site, runs = measured(SEED, "one_tool")
    doc = json.loads(json.dumps(site.doc))
    doc["pivots_mm"] = {a: [0.0, 0.0, 700.0] for a in "XYZ"}
    with Store.open("sqlite:///e.sqlite3") as store:
        import_folder(store, write_folder(tmp_path / "other", doc, thinned(runs, 10)))
    code, _, err = command("solve", small, "--model", "rigid6", "--db", "sqlite:///e.sqlite3")
    assert code == 2
    assert "the machine (chain, strokes, pivots or tool) differs" in err


@pytest.mark.parametrize(
    ("words", "told"), [(("nowhere",), "STO-001"), (("--without", "r77"), "no run r77"), (("--model", "rigid99"), "rigid99")]
)
def test_mistakes_are_one_line(command, folder, words, told):
    target = () if words == ("nowhere",) else (folder,)
    code, out, err = command("solve", *target, *words)
    assert (code, out) == (2, "")
    assert told in err.splitlines()[-1]


def test_hidden_effects_of_the_practice_cases_show_in_the_residuals(shared, tmp_path):
    """Cases with stick-slip: no part of the model, so the tests of the residuals have to speak."""
    with tarfile.open(shared / "data" / "blind-practice.tar.xz") as archive:
        for member in archive:  # unpacked on the way: going back would read it all again
            if member.name.startswith("public/case0073/"):
                archive.extract(member, tmp_path, filter="data")
    case = from_folder(tmp_path / "public" / "case0073")
    solved = solve_runs(case.site, case.runs)
    flagged = [t for t in solved.joint.residual_tests if t.flagged]
    assert len(flagged) > 5
    assert all(t.text.startswith(t.run) for t in flagged)
