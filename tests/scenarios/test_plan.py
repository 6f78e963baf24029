"""`abbe plan` to `abbe solve`: what the planner writes runs on a machine, and what is measured can be solved."""

import json
import os

import pytest

pytestmark = [pytest.mark.scenario, pytest.mark.timeout(240)]


def run(abbe, *words: str) -> str:
    process = abbe(*words)
    out, err = process.communicate(timeout=200)
    assert process.returncode == 0, err
    return out


@pytest.mark.skipif(not os.environ.get("ABBE_TEST_LONG"), reason="a whole planned campaign: ABBE_TEST_LONG=1 runs it")
def test_a_planned_campaign_is_measured_and_solved(abbe, start_sims, tmp_path):
    sims = start_sims("--seed", "5", "--speed", "60")
    machine = str(sims.machine_file)
    planned = json.loads(run(abbe, "plan", "-m", machine, "--minutes", "14", "--out", "small.toml", "--picture", "small.html", "--json"))
    assert planned["minutes"] <= 14.0
    assert "<svg" in (tmp_path / "small.html").read_text()
    # the planner's minutes are the sequencer's machine time and the set-ups
    machine_min = sum(s["machine_s"] for s in planned["steps"]) / 60.0
    assert planned["minutes"] == pytest.approx(machine_min + setup_minutes(planned["steps"]), abs=0.3)
    run(abbe, "measure", "-m", machine, "--recipe", "small.toml", "--name", "small", "--rate-hz", "100")
    solved = json.loads(run(abbe, "solve", "small", "--db", f"sqlite:///{tmp_path / 'abbe.sqlite3'}", "--json"))
    assert set(solved["runs"]) == {s["label"] for s in planned["steps"]}


def setup_minutes(steps: list[dict]) -> float:
    """A person's minutes: 3 for a cup, 1.5 for another bar at it, 5 for a laser line, 8 for a diagonal; docs/how-to/plan.md."""
    total, before = 0.0, {"setup": "", "what": ""}
    for step in steps:
        if step["setup"] != before["setup"]:
            total += 3.0 if "ball-bar" in step["what"] else 8.0 if "diagonal" in step["what"] else 5.0
        elif "ball-bar" in step["what"] and step["what"].split()[1] != before["what"].split()[1]:
            total += 1.5
        before = step
    return total


@pytest.mark.skipif(not os.environ.get("ABBE_TEST_LONG"), reason="a measured campaign: ABBE_TEST_LONG=1 runs it")
def test_tests_that_share_a_set_up_run_one_after_the_other(abbe, start_sims, tmp_path):
    """Another bar at the standing cup and back with it; two step orders and the straight diagonal on one mirror; one edge line."""
    sims = start_sims("--seed", "6", "--speed", "60")
    (tmp_path / "shared.toml").write_text(SHARED)
    run(abbe, "measure", "-m", str(sims.machine_file), "--recipe", "shared.toml", "--name", "shared")
    solved = json.loads(run(abbe, "solve", "shared", "--db", f"sqlite:///{tmp_path / 'abbe.sqlite3'}", "--json"))
    assert set(solved["runs"]) == {"h1", "h2", "h3", "d1", "d2", "d3", "l1"}
    assert max(r["rms_um"] for r in solved["runs"].values()) < 1.5  # a cup that had moved would show as tens of micrometres


SHARED = """
format = "abbe-recipe/1"
name = "shared set-ups"
[[test]]
kind = "helix"
label = "h1"
setup = "cup"
centre_mm = [300.0, 250.0, 50.0]
radius_mm = 150.0
turns = 3.0
[[test]]
kind = "helix"
label = "h2"
setup = "cup"
centre_mm = [300.0, 250.0, 50.0]
radius_mm = 100.0
turns = 3.0
[[test]]
kind = "helix"
label = "h3"
setup = "cup"
centre_mm = [300.0, 250.0, 50.0]
radius_mm = 100.0
turns = 3.0
direction = -1
[[test]]
kind = "diagonal"
label = "d1"
setup = "mirror"
diagonal = "npp"
order = "XYZ"
steps = 6
[[test]]
kind = "diagonal"
label = "d2"
setup = "mirror"
diagonal = "npp"
order = "ZYX"
steps = 6
[[test]]
kind = "diagonal"
label = "d3"
setup = "mirror"
diagonal = "npp"
steps = 10
[[test]]
kind = "line"
label = "l1"
setup = "line"
axis = "Y"
at_share = [0.1, 0.9]
positions = 11
"""
