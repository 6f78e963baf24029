"""`abbe measure` is told to stop while the axes move: they stand still before the process has gone, and the run says so."""

import os
import pty
import signal

import pytest

from tests.patience import within
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


def test_ctrl_c_stops_at_a_safe_place_and_the_same_campaign_goes_on(abbe, start_sims):
    """The path is held, the run closed as stopped; `--resume` drives back along the path and measures it again."""
    sims = start_sims("--speed", "60")
    process = abbe("measure", str(sims.machine_file), *HELIX, "--name", "june")
    wait_for(lambda: bar_chunks(sims.machine_file.parent) > 1, 60, "samples of the helix")
    _, err = interrupt(process, signal.SIGINT)
    assert process.returncode == 130, err
    assert axes_at_rest(sims)
    assert err.splitlines()[-1] == "stopped: `abbe measure MACHINE.toml --resume CAMPAIGN` resumes it"
    (run,) = runs_of(sims.machine_file.parent)
    assert (run.label, run.status) == ("helix", "stopped")
    again = abbe("measure", str(sims.machine_file), "--resume", "june")
    out, err = again.communicate(timeout=within(60))
    assert again.returncode == 0, err
    assert out == "measured: campaign 'june', 1 runs\n"
    assert "set-up B1 is still mounted: helix begins again" in err
    assert [(r.label, r.status) for r in runs_of(sims.machine_file.parent)] == [("helix", "stopped"), ("helix-2", "complete")]


def test_sigusr1_pauses_and_lets_go_on(abbe, start_sims):
    sims = start_sims("--speed", "30")
    process = abbe("measure", str(sims.machine_file), *HELIX, "--name", "june")
    wait_for(lambda: bar_chunks(sims.machine_file.parent) > 1, 60, "samples of the helix")
    process.send_signal(signal.SIGUSR1)
    wait_for(lambda: [r.status for r in runs_of(sims.machine_file.parent)] == ["aborted"], 20, "the run in hand is closed as evidence")
    assert axes_at_rest(sims)
    process.send_signal(signal.SIGUSR1)
    _, err = process.communicate(timeout=within(60))
    assert process.returncode == 0, err
    assert [(r.label, r.status) for r in runs_of(sims.machine_file.parent)] == [("helix", "aborted"), ("helix-2", "complete")]


def test_another_recipe_is_refused_in_one_line(abbe, start_sims):
    sims = start_sims("--speed", "60")
    process = abbe("measure", str(sims.machine_file), *HELIX, "--name", "june")
    wait_for(lambda: bar_chunks(sims.machine_file.parent) > 1, 60, "samples of the helix")
    interrupt(process, signal.SIGINT)
    for change in (("--helix", "300,250,100,140"), ("--recipe", "quick-check")):
        again = abbe("measure", str(sims.machine_file), "--resume", "june", *change)
        _, err = again.communicate(timeout=within(60))
        assert again.returncode == 2
        (line,) = err.splitlines()
        assert line.startswith("error SEQ-007: campaign 'june' was begun with another recipe")


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGHUP, 129)])
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
    assert runs_of(sims.machine_file.parent)[-1].status in ("stopped", "aborted")  # whichever of the two was first


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
