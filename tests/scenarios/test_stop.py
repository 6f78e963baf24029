"""`abbe measure` is told to stop while the axes move: they stand still before the process has gone, and the run says so."""

import os
import pty
import signal

import pytest

from tests.scenarios.conftest import ABBE
from tests.scenarios.world import axes_at_rest, bar_chunks, interrupt, runs_of, wait_for

pytestmark = [pytest.mark.scenario, pytest.mark.timeout(120)]
HELIX = ("--helix", "300,250,100,150")


def measuring(abbe, sims):
    """A measurement whose helix is under way; at this speed it would take half a minute."""
    process = abbe("measure", str(sims.machine_file), *HELIX)
    wait_for(lambda: bar_chunks(sims.machine_file.parent) > 5, 60, "samples of the helix")
    assert not axes_at_rest(sims)
    return process


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)])
def test_a_signal_stops_the_axes(abbe, start_sims, number, code):
    sims = start_sims("--speed", "5")
    process = measuring(abbe, sims)
    _, err = interrupt(process, number)
    assert process.returncode == code, err
    assert axes_at_rest(sims)
    assert "Traceback" not in err
    assert err.splitlines()[-1].startswith("helix"), err  # nothing but the progress line: the stop got through
    run = runs_of(sims.machine_file.parent)[-1]
    assert (run.status, run.reason) == ("aborted", "stopped")


def test_a_second_ctrl_c_does_not_cut_the_stop_short(abbe, start_sims):
    sims = start_sims("--speed", "5")
    process = measuring(abbe, sims)
    process.send_signal(signal.SIGINT)
    _, err = interrupt(process, signal.SIGTERM)
    assert axes_at_rest(sims)
    assert process.returncode in (130, 143, -signal.SIGTERM), err  # the second may come after the stop was done
    assert runs_of(sims.machine_file.parent)[-1].status == "aborted"


def test_a_closed_terminal_stops_the_axes(start_sims):
    """The session's terminal goes, as when ssh breaks: nothing can be printed any more, and the axes stop all the same."""
    sims = start_sims("--speed", "5")
    pid, terminal = pty.fork()
    if pid == 0:
        os.chdir(sims.machine_file.parent)
        os.execv(ABBE[0], [*ABBE, "measure", str(sims.machine_file), *HELIX])
    wait_for(lambda: bar_chunks(sims.machine_file.parent) > 5, 60, "samples of the helix")
    assert not axes_at_rest(sims)
    os.close(terminal)
    _, status = os.waitpid(pid, 0)
    assert axes_at_rest(sims)
    assert os.waitstatus_to_exitcode(status) == 129
    assert runs_of(sims.machine_file.parent)[-1].status == "aborted"
