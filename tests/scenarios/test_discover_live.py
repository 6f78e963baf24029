"""`abbe discover --live`: what is proposed is measured on the machine over its wires, put beside the old runs, and searched again."""

import dataclasses
import os
import subprocess
import sys

import pytest

from abbe.service import cli
from abbe.service.runs.columns import load_run
from abbe.service.storage.store import Store
from tests.scenarios.world import axes_at_rest, wait_for
from tests.service.discovery.discovery_bench import Search

pytestmark = [pytest.mark.scenario, pytest.mark.timeout(240)]


class Asks(Search):
    """Proposes a second feed until it is there."""

    def __init__(self):
        super().__init__(width_um=1.0)
        self.seen = []

    def __call__(self, case, effects, progress):
        found = super().__call__(case, effects, progress)
        self.seen.append({r.path.label: (r.path.feed_mm_min[0], r.path.at.t_s[0], r.path.t_set_s) for r in case.runs})
        return found if len(case.runs) == 1 else dataclasses.replace(found, next_test=None)


@pytest.fixture
def run(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def call(*words):
        code = cli.run([str(w) for w in words])
        out, err = capsys.readouterr()
        return code, " ".join(out.split()), err

    return call


def test_the_proposed_run_is_measured_and_the_search_goes_on(run, start_sims, monkeypatch, tmp_path):
    sims = start_sims("--speed", "60")
    assert run("measure", "-m", sims.machine_file, "--helix", "300,250,100,60", "--name", "june")[0] == 0
    search = Asks()
    monkeypatch.setattr("abbe.service.discovery.discover.search", search)
    code, out, err = run("discover", "june", "--machine", sims.machine_file, "--live", "--report", "live.html")
    assert code == 0, err
    assert out.count("measure next: the same path at a second feed") == 1
    assert [len(seen) for seen in search.seen] == [1, 2]
    (old, (feed, first_s, set_s)), (new, (slow, later_s, later_set_s)) = search.seen[1].items()
    assert (old, new) == ("helix", "n1-feed")
    assert slow == pytest.approx(0.4 * feed)
    assert later_s > first_s + 10.0  # one clock for both campaigns
    assert set_s <= first_s < later_set_s <= later_s
    assert "n1-feed" in (tmp_path / "live.html").read_text()
    with Store.open(f"sqlite:///{sims.machine_file.parent / 'abbe.sqlite3'}") as store:
        assert len(store.discoveries.all()) == 2
        assert [c.name.split()[0] for c in store.campaigns.all()] == ["june", "next1"]
        assert [s.state for s in store.discoveries.steps(store.discoveries.all()[-1].id)][
            -1
        ] == "UNEXPLAINED"  # the played answer leaves a gap and nothing judges


LIVE = """
import sys
from abbe.service import cli
from abbe.service.discovery import discover
from tests.scenarios.test_discover_live import Asks

discover.search = Asks()
sys.exit(cli.run(["discover", "june", "--machine", sys.argv[1], "--live"]))
"""


@pytest.mark.skipif(
    os.environ.get("ABBE_TEST_LONG") != "1",
    reason="test_discover_live_resume and test_killed_measuring prove the parts: ABBE_TEST_LONG=1 plays the whole",
)
def test_killed_while_it_measures_the_same_command_goes_on(run, start_sims, monkeypatch, tmp_path):
    sims = start_sims("--speed", "40")
    url = f"sqlite:///{sims.machine_file.parent / 'abbe.sqlite3'}"
    assert run("measure", "-m", sims.machine_file, "--helix", "300,250,100,60", "--name", "june")[0] == 0

    def added():
        with Store.open(url) as store:
            return [
                (r.label, r.visible_status, len(store.chunks.of_run(r.id)) > 0)
                for c in store.campaigns.all()[1:]
                for r in store.runs.all(c.id)
            ]

    words = [sys.executable, "-c", LIVE, str(sims.machine_file)]
    first = subprocess.Popen(words, env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}, stdin=subprocess.DEVNULL)
    try:
        wait_for(lambda: added() == [("n1-feed", "running", True)], 40, "the added run is being measured")
    finally:
        first.kill()
        first.wait()
    assert added() == [("n1-feed", "incomplete", True)]
    wait_for(lambda: axes_at_rest(sims), 60, "the controller has run its path to the end")
    search = Asks()
    monkeypatch.setattr("abbe.service.discovery.discover.search", search)
    for again in (False, True):
        code, out, err = run("discover", "june", "--machine", sims.machine_file, "--live")
        assert code == 0, err
        assert f": {int(again)} of 1 runs are measured" in out
        assert [list(seen) for seen in search.seen] == [["helix", "n1-feed-2"]]  # the first search was not done again
        assert [state[:2] for state in added()] == [("n1-feed", "interrupted"), ("n1-feed-2", "complete")]
    _, first_s, set_s = search.seen[0]["n1-feed-2"]
    with Store.open(url) as store:
        again = load_run(store, "n1-feed-2")
        assert again.setup.setup_id == "n1-feed-2"  # mounted anew: another cup
        broken_off = next(r for r in store.runs.all(store.campaigns.all()[1].id) if r.label == "n1-feed")
        assert broken_off.start_doc["setup"]["t_set_s"] < again.setup.t_set_s < again.columns.t_s[0]
        assert set_s < first_s
        assert [c.name.split()[0] for c in store.campaigns.all()] == ["june", "next1"]
        assert [[s.state for s in store.discoveries.steps(d.id)][-1] for d in store.discoveries.all()] == ["UNEXPLAINED"] * 2


def test_what_cannot_go_on_live_is_refused_before_anything_moves(run, tmp_path):
    assert run("discover", "june", "--live")[2].startswith("error CFG-001: --live needs the machine")
    (tmp_path / "c1").mkdir()
    strokes = "".join(f"{axis} = [0, 400]\n" for axis in "XYZ")
    (tmp_path / "m.toml").write_text(f'name = "m"\nchain = "w-X-Y-b-Z-t"\n[stroke_mm]\n{strokes}')
    assert "not a folder" in run("discover", tmp_path / "c1", "--live", "--machine", tmp_path / "m.toml")[2]
