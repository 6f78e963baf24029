"""Every kind of test, measured on the simulated machine over its wires, exported, checked, and solved."""

import json
import os

import numpy as np
import pytest

from abbe.service.runs.exchange import read_folder

pytestmark = [pytest.mark.scenario, pytest.mark.timeout(240)]


def run(abbe, *words: str) -> str:
    process = abbe(*words)
    out, err = process.communicate(timeout=200)
    assert process.returncode == 0, err
    return out


@pytest.mark.skipif(not os.environ.get("ABBE_TEST_LONG"), reason="ten tests measured: ABBE_TEST_LONG=1 runs it")
def test_every_kind_of_test_is_measured_and_solved(abbe, start_sims, tmp_path):
    sims = start_sims("--seed", "6", "--speed", "90")
    (tmp_path / "field.toml").write_text(FIELD)
    db = f"sqlite:///{tmp_path / 'abbe.sqlite3'}"
    run(abbe, "measure", "-m", str(sims.machine_file), "--recipe", "field.toml", "--name", "field")
    solved = json.loads(run(abbe, "solve", "field", "--db", db, "--json"))
    labels = {"h1", "h2", "p1", "c1", "c2", "c3", "d1", "d2", "f1", "l1"}
    assert set(solved["runs"]) == labels
    assert max(r["rms_um"] for r in solved["runs"].values()) < 1.5  # another cup, place or sign of lost motion would show as tens of µm
    assert not solved.get("findings", [])
    run(abbe, "export", "field", "out", "--db", db)
    folder = next((tmp_path / "out").rglob("campaign.json")).parent
    found = {r["run_id"]: r for r in read_folder(folder).run_files}  # and the exchange format takes it back
    if os.environ.get("ABBE_TEST_LONG") == "1":
        discovered = json.loads(run(abbe, "discover", str(folder), "--json"))
        assert discovered["verdict"] in {"none", "named", "unknown"}
    assert {k: found[k]["test"] for k in ("c1", "f1", "p1", "l1")} == {
        "c1": "ballbar_circle", "f1": "laser_diagonal", "p1": "ballbar_helix", "l1": "laser_linear",
    }  # fmt: skip
    assert circle_angle(found["c1"]) == pytest.approx(2 * np.pi, abs=0.02)  # feed-in and feed-out are not in it
    assert circle_angle(found["c2"]) == pytest.approx(-2 * np.pi, abs=0.02)
    assert len(found["p1"]["columns"]["t_s"]) == 40
    assert set(found["p1"]["columns"]["samples_count"]) == {20}
    assert len(found["l1"]["columns"]["t_s"]) == 3 * 2 * 10 + 1


def circle_angle(run) -> float:
    """Angle that the readings of an XY circle cover, rad, signed."""
    x, y = (np.array(run["columns"][f"{c}_mm"]) - run["setup"]["centre_mm"]["xy".index(c)] for c in "xy")
    angle = np.unwrap(np.arctan2(y, x))
    return float(angle[-1] - angle[0])


FIELD = """
format = "abbe-recipe/1"
name = "all tests"
[[test]]
kind = "helix"
label = "h1"
setup = "cup"
centre_mm = [300.0, 250.0, 100.0]
radius_mm = 150.0
turns = 3.0
feed_in_deg = 10.0
feed_out_deg = 5.0
[[test]]
kind = "helix"
label = "h2"
setup = "cup"
centre_mm = [300.0, 250.0, 100.0]
radius_mm = 150.0
turns = 3.0
feed_mm_min = 3000.0
feed_in_deg = 10.0
feed_out_deg = 5.0
[[test]]
kind = "helix_points"
label = "p1"
setup = "cup"
centre_mm = [300.0, 250.0, 100.0]
radius_mm = 150.0
turns = 3.0
points = 40
direction = -1
[[test]]
kind = "circle"
label = "c1"
setup = "cup"
centre_mm = [300.0, 250.0, 100.0]
radius_mm = 150.0
plane = "XY"
feed_mm_min = 3000.0
[[test]]
kind = "circle"
label = "c2"
setup = "cup"
centre_mm = [300.0, 250.0, 100.0]
radius_mm = 150.0
plane = "XY"
direction = -1
feed_mm_min = 3000.0
[[test]]
kind = "circle"
label = "c3"
setup = "cup"
centre_mm = [300.0, 250.0, 100.0]
radius_mm = 100.0
plane = "ZX"
start_deg = -100.0
span_deg = 200.0
feed_in_deg = 5.0
feed_out_deg = 5.0
[[test]]
kind = "diagonal"
label = "d1"
setup = "mirror"
diagonal = "npp"
order = "XYZ"
steps = 6
cycles = 2
[[test]]
kind = "diagonal"
label = "d2"
setup = "mirror"
diagonal = "npp"
steps = 8
cycles = 2
overrun_mm = 2.0
[[test]]
kind = "face"
label = "f1"
setup = "face"
plane = "YZ"
diagonal = "np"
at_share = 0.4
steps = 8
cycles = 2
overrun_mm = 2.0
[[test]]
kind = "line"
label = "l1"
setup = "line"
axis = "Y"
at_share = [0.1, 0.9]
positions = 9
cycles = 3
overrun_mm = 2.0
offset_share = 0.3
"""
