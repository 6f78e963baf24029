"""Whatever is wrong: one line with cause and remedy, exit code 2, nothing half-done."""

import json

import pytest

from tests.scenarios.world import bar_chunks, laser_chunks, one_line, position_and_counters, runs_of, wait_for

pytestmark = [pytest.mark.scenario, pytest.mark.timeout(180)]


def test_missing_machine_file(abbe):
    one_line(abbe("measure", "nowhere.toml"), "CFG-001", "nowhere.toml")


def test_unknown_key_names_the_nearest_valid_one(abbe, tmp_path, start_sims):
    sims = start_sims(extra="[limits]\ntable_valu_um = 5\n")
    one_line(abbe("measure", str(sims.machine_file)), "CFG-001", "table_valu_um", "table_value_um")


def test_port_refused(abbe, start_sims):
    sims = start_sims()
    sims.machine_file.write_text(sims.machine_file.read_text().replace(sims.ready["cnc"], "modbus+tcp://127.0.0.1:9?unit=1"))
    one_line(abbe("measure", str(sims.machine_file)), "DRV-002", "127.0.0.1:9")


def test_a_path_beyond_the_stroke_moves_nothing(abbe, start_sims):
    sims = start_sims("--speed", "60")
    before = position_and_counters(sims)
    one_line(abbe("measure", str(sims.machine_file), "--helix", "550,250,100,150"), "SEQ-001", "X", "stroke", "nothing has moved")
    assert position_and_counters(sims) == before
    assert not (sims.machine_file.parent / "abbe.sqlite3").exists() or runs_of(sims.machine_file.parent) == []


def test_ball_bar_unplugged_in_mid_run(abbe, start_sims):
    sims = start_sims("--speed", "10")
    process = abbe("measure", str(sims.machine_file), "--helix", "300,250,100,150")
    wait_for(lambda: bar_chunks(sims.machine_file.parent) > 5, 60, "samples of the helix")
    sims.ask("unplug_ballbar")
    one_line(process, "DRV-002", "unplugged")
    run = runs_of(sims.machine_file.parent)[-1]
    assert run.status == "failed"
    assert "DRV-002" in run.reason
    assert bar_chunks(sims.machine_file.parent) > 5  # what was measured is kept


def test_laser_beam_lost(abbe, start_sims):
    sims = start_sims("--speed", "20")
    process = abbe("measure", str(sims.machine_file), "--recipe", "verification")
    # The first readings of a line of 42 are stored: the beam goes while it is being read, not while it is zeroed for the next one.
    wait_for(lambda: 2 <= laser_chunks(sims.machine_file.parent) <= 20, 60, "the first readings of a laser line")
    sims.ask("beam", blocked=True)
    one_line(process, "ILK-007", "beam")
    run = runs_of(sims.machine_file.parent)[-1]
    assert (run.status, run.test) == ("failed", "laser_diagonal")
    assert "ILK-007" in run.reason


@pytest.mark.parametrize(("fault", "word"), [("estop", "e-stop"), ("door", "door")])
def test_an_interlock_stops_the_run(abbe, start_sims, fault, word):
    sims = start_sims("--speed", "10")
    process = abbe("measure", str(sims.machine_file), "--helix", "300,250,100,150")
    wait_for(lambda: bar_chunks(sims.machine_file.parent) > 5, 60, "samples of the helix")
    sims.ask(fault, on=True)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 2
    last = err.strip().splitlines()[-1]
    assert last.startswith("error ")
    assert word in last


def test_nan_in_a_run_file_imports_nothing(abbe, shared, tmp_path):
    source = shared / "data" / "axis-tests" / "week42-x"
    folder = tmp_path / "damaged"
    folder.mkdir()
    for path in source.iterdir():
        (folder / path.name).write_bytes(path.read_bytes())
    run = json.loads((folder / "r02.json").read_text())
    run["columns"]["deviation_mm"][3] = float("nan")
    (folder / "r02.json").write_text(json.dumps(run))
    one_line(abbe("import", str(folder)), "FMT-001", "r02.json", "deviation_mm")
    listing = abbe("runs", "--json")
    out, err = listing.communicate(timeout=30)
    assert listing.returncode == 2 or json.loads(out) == [], err
