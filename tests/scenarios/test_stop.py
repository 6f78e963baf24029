"""`abbe measure` is told to stop while the axes move: they stand still before the process has gone, and the run says so."""

import os
import pty
import signal
import subprocess
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.patience import within
from tests.scenarios.conftest import ABBE, Sims, simulated
from tests.scenarios.world import axes_at_rest, bar_chunks, interrupt, refused, runs_of, wait_for

pytestmark = [pytest.mark.scenario, pytest.mark.timeout(120)]
LONG = os.environ.get("ABBE_TEST_LONG") == "1"
HELIX = ("--helix", "300,250,100,100")
"""At the speed of the simulated machine this path takes some seconds."""


@pytest.fixture(scope="module")
def machine(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Sims]:
    """One simulated machine for all tests of this file."""
    with simulated(tmp_path_factory.mktemp("stop"), "--speed", "20") as sims:
        yield sims


@dataclass
class Measuring:
    """The machine, a folder with a machine file and a database of its own, and the start of `abbe`."""

    sims: Sims
    folder: Path
    abbe: Callable[..., subprocess.Popen[str]]

    @property
    def file(self) -> str:
        return str(self.folder / "machine.toml")

    def helix_under_way(self, *more: str) -> subprocess.Popen[str]:
        process = self.abbe("measure", "-m", self.file, *HELIX, *more)
        self.wait()
        return process

    def wait(self) -> None:
        wait_for(lambda: bar_chunks(self.folder) > 1, 60, "samples of the helix")
        assert not axes_at_rest(self.sims)

    def runs(self) -> list[tuple[str, str]]:
        return [(run.label, run.status) for run in runs_of(self.folder)]


@pytest.fixture
def measuring(machine: Sims, abbe: Callable[..., subprocess.Popen[str]], tmp_path: Path) -> Measuring:
    """The machine as a person leaves it: nothing mounted, no alarm."""
    for op in ("unmount", "reset"):
        machine.ask(op)
    (tmp_path / "machine.toml").write_text(machine.machine_file.read_text())
    return Measuring(machine, tmp_path, abbe)


def test_ctrl_c_stops_at_a_safe_place_and_the_same_campaign_goes_on_but_no_other(measuring, command):
    """The path is held, the run closed as stopped; `--resume` drives back along the path and measures it again."""
    process = measuring.helix_under_way("--name", "june")
    _, err = interrupt(process, signal.SIGINT)
    assert process.returncode == 130, err
    assert axes_at_rest(measuring.sims)
    assert err.splitlines()[-2:] == [
        "stopped: `abbe measure -m MACHINE.toml --resume CAMPAIGN` resumes it",
        f"next: abbe measure --resume june -m {measuring.file}",
    ]
    assert measuring.runs() == [("helix", "stopped")]
    for change in (("--helix", "300,250,100,90"), ("--recipe", "quick-check")):
        line = refused(command("measure", "-m", measuring.file, "--resume", "june", *change), "SEQ-007")
        assert line.startswith("error SEQ-007: campaign 'june' was begun with another recipe")
    code, out, err = command("measure", "-m", measuring.file, "--resume", "june")
    assert code == 0, err
    assert out == "measured: campaign 'june', 1 runs\n"
    assert "set-up B1 is still mounted: helix begins again" in err
    assert measuring.runs() == [("helix", "stopped"), ("helix-2", "complete")]


def test_sigusr1_pauses_and_lets_go_on(measuring):
    process = measuring.helix_under_way("--name", "june")
    process.send_signal(signal.SIGUSR1)
    wait_for(lambda: measuring.runs() == [("helix", "aborted")], 20, "the run in hand is closed as evidence")
    assert axes_at_rest(measuring.sims)
    process.send_signal(signal.SIGUSR1)
    _, err = process.communicate(timeout=within(60))
    assert process.returncode == 0, err
    assert measuring.runs() == [("helix", "aborted"), ("helix-2", "complete")]


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143)] + [(signal.SIGHUP, 129)] * LONG)
def test_a_signal_stops_the_axes(measuring, number, code):
    """SIGHUP in every run: that of a closed terminal."""
    process = measuring.helix_under_way()
    _, err = interrupt(process, number)
    assert process.returncode == code, err
    assert axes_at_rest(measuring.sims)
    assert "Traceback" not in err
    assert err.splitlines()[-2].startswith("helix"), err  # nothing but the progress line and the next command: the stop got through
    assert err.splitlines()[-1].startswith("next: abbe measure --resume "), err
    run = runs_of(measuring.folder)[-1]
    assert (run.status, run.reason) == ("aborted", "stopped")


def test_a_second_ctrl_c_does_not_cut_the_stop_short(measuring):
    process = measuring.helix_under_way()
    process.send_signal(signal.SIGINT)
    _, err = interrupt(process, signal.SIGTERM)
    assert axes_at_rest(measuring.sims)
    assert process.returncode in (130, 143, -signal.SIGTERM), err  # the second may come after the stop was done
    assert runs_of(measuring.folder)[-1].status in ("stopped", "aborted")  # whichever of the two was first


def test_a_closed_terminal_stops_the_axes(measuring):
    """The session's terminal goes, as when ssh breaks: nothing can be printed any more, and the axes stop all the same."""
    pid, terminal = pty.fork()
    if pid == 0:
        os.chdir(measuring.folder)
        os.execv(ABBE[0], [*ABBE, "measure", "-m", measuring.file, *HELIX])
    measuring.wait()
    os.close(terminal)
    _, status = os.waitpid(pid, 0)
    assert axes_at_rest(measuring.sims)
    assert os.waitstatus_to_exitcode(status) == 129
    assert runs_of(measuring.folder)[-1].status == "aborted"
