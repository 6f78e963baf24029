"""Shared by the probes, which the control's own Python runs: LinuxCNC on, its axes homed; moves that are waited for."""

import os
import time

import hal  # type: ignore[import-not-found]
import linuxcnc  # type: ignore[import-not-found]

command, status = linuxcnc.command(), linuxcnc.stat()


def wait(condition, limit_s=20.0):
    """Poll until a condition holds."""
    end = time.monotonic() + limit_s
    while time.monotonic() < end:
        status.poll()
        if condition():
            return
        time.sleep(0.005)  # noqa: TID251 - a process of its own, with no event loop
    raise TimeoutError


def go(text):
    """One line of MDI, to its end."""
    command.mode(linuxcnc.MODE_MDI)
    command.wait_complete()
    command.mdi(text)
    while command.wait_complete(5) == -1:
        pass
    wait(lambda: status.interp_state == linuxcnc.INTERP_IDLE and status.inpos)


def start():
    """Switch the control on, home its axes, choose mm and paths; return a component of our own, which may read pins."""
    wait(lambda: status.joints == 3)
    for state in (linuxcnc.STATE_ESTOP_RESET, linuxcnc.STATE_ON):
        command.state(state)
        command.wait_complete()
    command.teleop_enable(0)
    command.wait_complete()
    command.home(-1)
    wait(lambda: all(status.homed[:3]))
    component = hal.component(f"probe{os.getpid()}")
    component.ready()
    go("G21 G90 G64 P0.001 G94")
    return component
