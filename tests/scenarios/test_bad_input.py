"""Whatever is wrong: one line with cause and remedy, exit code 2, nothing half-done."""

import json
import threading
from contextlib import contextmanager

import pytest

from tests.scenarios.conftest import simulated
from tests.scenarios.world import bar_chunks, laser_chunks, position_and_counters, refused, runs_of, wait_for

pytestmark = [pytest.mark.scenario, pytest.mark.timeout(180)]


@pytest.fixture(scope="module")
def still(tmp_path_factory):
    """One simulated machine that no test may move."""
    with simulated(tmp_path_factory.mktemp("still"), "--speed", "60") as sims:
        yield sims


@contextmanager
def meanwhile(condition, what, do):
    """While the block runs: do something once the condition holds."""
    done = []

    def work():
        wait_for(condition, 60, what)
        done.append(do())

    thread = threading.Thread(target=work)
    thread.start()
    yield
    thread.join(70)
    assert done, what


def test_missing_machine_file(command):
    refused(command("measure", "-m", "nowhere.toml"), "CFG-001", "nowhere.toml")


def test_unknown_key_names_the_nearest_valid_one(command, tmp_path, still):
    (tmp_path / "machine.toml").write_text(still.machine_file.read_text() + "[limits]\ntable_valu_um = 5\n")
    refused(command("measure", "-m", "machine.toml"), "CFG-001", "table_valu_um", "table_value_um")


def test_port_refused(command, tmp_path, still):
    (tmp_path / "machine.toml").write_text(still.machine_file.read_text().replace(still.ready["cnc"], "modbus+tcp://127.0.0.1:9?unit=1"))
    refused(command("measure", "-m", "machine.toml"), "DRV-002", "127.0.0.1:9")


def test_a_path_beyond_the_stroke_moves_nothing(command, tmp_path, still):
    (tmp_path / "machine.toml").write_text(still.machine_file.read_text())
    before = position_and_counters(still)
    refused(command("measure", "-m", "machine.toml", "--helix", "550,250,100,150"), "SEQ-001", "X", "stroke", "nothing has moved")
    assert position_and_counters(still) == before
    assert not (tmp_path / "abbe.sqlite3").exists() or runs_of(tmp_path) == []


def test_ball_bar_unplugged_in_mid_run(command, start_sims):
    sims = start_sims("--speed", "10")
    with meanwhile(lambda: bar_chunks(sims.machine_file.parent) > 5, "samples of the helix", lambda: sims.ask("unplug_ballbar")):
        ended = command("measure", "-m", str(sims.machine_file), "--helix", "300,250,100,150")
    refused(ended, "DRV-002", "unplugged")
    run = runs_of(sims.machine_file.parent)[-1]
    assert run.status == "failed"
    assert "DRV-002" in run.reason
    assert bar_chunks(sims.machine_file.parent) > 5  # what was measured is kept


DIAGONAL = 'format = "abbe-recipe/1"\nname = "one"\n[[test]]\nkind = "diagonal"\nlabel = "d"\nsetup = "D"\ndiagonal = "ppp"\nsteps = 20\n'


def test_laser_beam_lost(command, start_sims, tmp_path):
    sims = start_sims("--speed", "20")
    (tmp_path / "one.toml").write_text(DIAGONAL)
    # The first readings of a line of 42 are stored: the beam goes while it is being read, not while it is zeroed for the next one.
    first = (lambda: 2 <= laser_chunks(sims.machine_file.parent) <= 20, "the first readings of a laser line")
    with meanwhile(*first, lambda: sims.ask("beam", blocked=True)):
        ended = command("measure", "-m", str(sims.machine_file), "--recipe", "one.toml")
    refused(ended, "ILK-007", "beam")
    run = runs_of(sims.machine_file.parent)[-1]
    assert (run.status, run.test) == ("failed", "laser_diagonal")
    assert "ILK-007" in run.reason


@pytest.mark.parametrize(("fault", "word"), [("estop", "e-stop"), ("door", "door")])
def test_an_interlock_stops_the_run(command, start_sims, fault, word):
    sims = start_sims("--speed", "10")
    with meanwhile(lambda: bar_chunks(sims.machine_file.parent) > 5, "samples of the helix", lambda: sims.ask(fault, on=True)):
        code, _, err = command("measure", "-m", str(sims.machine_file), "--helix", "300,250,100,150")
    assert code == 2
    last = err.strip().splitlines()[-1]
    assert last.startswith("error ")
    assert word in last


def test_nan_in_a_run_file_imports_nothing(command, shared, tmp_path):
    source = shared / "data" / "axis-tests" / "week42-x"
    folder = tmp_path / "damaged"
    folder.mkdir()
    for path in source.iterdir():
        (folder / path.name).write_bytes(path.read_bytes())
    run = json.loads((folder / "r02.json").read_text())
    run["columns"]["deviation_mm"][3] = float("nan")
    (folder / "r02.json").write_text(json.dumps(run))
    refused(command("import", str(folder)), "FMT-001", "r02.json", "deviation_mm")
    code, out, err = command("runs", "--json")
    assert code == 2 or json.loads(out) == [], err
