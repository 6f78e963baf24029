"""The operator runs the exported NC program, Abbe only listens: the readings are those that it would have taken by itself."""

import json
import threading

import numpy as np
import pytest

from abbe.service.runs.columns import load_run
from abbe.service.storage.store import Store
from tests.service.sequences.nc_reader import read_gcode

pytestmark = [pytest.mark.scenario, pytest.mark.timeout(240)]

RECIPE = """
format = "abbe-recipe/1"
name = "lines"
[[test]]
kind = "line"
label = "l1"
setup = "L1"
axis = "X"
at_share = [0.4, 0.4]
positions = 5
overrun_mm = 2.0
offset_share = 0.3
[[test]]
kind = "diagonal"
label = "d1"
setup = "D1"
diagonal = "npp"
steps = 3
"""


def sections(text):
    """Blocks of an NC program for the simulated panel, cut where it stops for a person."""
    out = [[]]
    for event in read_gcode(text, dwell="P_s"):
        if event.kind == "halt":
            out.append([])
        else:
            out[-1].append(["go", *event.at, event.value] if event.kind == "go" else ["rest", event.value])
    return out


def test_a_program_that_the_operator_starts_gives_the_same_readings(abbe, command, start_sims, tmp_path):
    sims = start_sims("--seed", "4", "--speed", "3")  # a standstill has to last some polls beside other tests, too
    machine = str(sims.machine_file)
    (tmp_path / "r.toml").write_text(RECIPE)
    for words in (("--nc", "linuxcnc", "--out", "r.ngc"), ("--name", "driven")):
        assert command("measure", "-m", machine, "--recipe", "r.toml", *words)[0] == 0
    to_line, line, to_diagonal, diagonal, rest = sections((tmp_path / "r.ngc").read_text())
    assert rest == []
    gone = [k for k, block in enumerate(diagonal) if block[0] == "rest"][2]  # the operator's program has lost one dwell
    lost = [block for k, block in enumerate(diagonal) if k != gone]
    listening = abbe("listen", "-m", machine, "--recipe", "r.toml", "--name", "heard")
    said = []
    steps = {"l1: waiting": to_line, "l1: listening": line, "d1: waiting": to_diagonal, "d1: listening": lost}
    watchdog = threading.Timer(200.0, listening.kill)
    watchdog.start()
    for text in listening.stdout:
        said.append(text)
        for words, blocks in steps.items():
            if words in text:
                sims.ask("program", blocks=blocks)
    watchdog.cancel()
    listening.wait()
    told = listening.stderr.read()
    assert listening.returncode == 0, told
    assert told.splitlines()[-1] == f"next: abbe solve heard -m {machine}"
    assert any("d1: standstill 3 of 7 (at" in text and "is missing" in text for text in said)
    with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as store:
        driven = {r.label: load_run(store, r.id).to_document() for r in store.runs.all("driven")}
        heard = {r.label: load_run(store, r.id).to_document() for r in store.runs.all("heard")}
        end = {r.label: r.end_doc for r in store.runs.all("heard")}
    for label, missing in (("l1", []), ("d1", [2])):
        keep = np.setdiff1d(np.arange(len(driven[label]["columns"]["t_s"])), missing)
        for column in ("x_mm", "y_mm", "z_mm", "direction"):  # the missing one has its row: where it would have been
            assert np.array(heard[label]["columns"][column]) == pytest.approx(np.array(driven[label]["columns"][column]))
        assert [k for k, valid in enumerate(heard[label]["columns"]["valid"]) if not valid] == missing
        assert [heard[label]["columns"]["deviation_mm"][k] for k in missing] == [0.0] * len(missing)
        off = np.subtract(heard[label]["columns"]["deviation_mm"], driven[label]["columns"]["deviation_mm"])[keep]
        assert np.std(off - np.polyval(np.polyfit(keep, off, 1), keep)) < 1e-3  # another mounting: another tilt; 1 µm
        assert np.abs(off).max() < 5e-3
        assert end[label]["standstills"]["missing"] == missing
        assert (np.diff(heard[label]["columns"]["t_s"]) > 0.0).all()
    lag = end["l1"]["lag"]
    assert abs(lag["laser_behind_position_ms"]) < 100.0 + 3.0 * lag["u_ms"]
    assert json.dumps(end["d1"]["standstills"])
