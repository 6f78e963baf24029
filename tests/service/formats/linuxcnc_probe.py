"""Run by the control's own Python beside a running LinuxCNC: goes to places in both directions and writes what was added there (JSON)."""

import json
import os
import sys
import time

import hal  # type: ignore[import-not-found]
import linuxcnc  # type: ignore[import-not-found]

command, status = linuxcnc.command(), linuxcnc.stat()
JOINTS = (0, 2)


def wait(condition, limit_s=20.0):
    """Poll until a condition holds."""
    end = time.monotonic() + limit_s
    while time.monotonic() < end:
        status.poll()
        if condition():
            return
        time.sleep(0.005)  # noqa: TID251 - a process of its own, with no event loop
    raise TimeoutError


def settled():
    """The applied correction has followed the wanted one."""
    return all(abs(hal.get_value(f"joint.{j}.backlash-filt") - hal.get_value(f"joint.{j}.backlash-corr")) < 1e-9 for j in JOINTS)


def go(text):
    """One line of MDI, to its end."""
    command.mode(linuxcnc.MODE_MDI)
    command.wait_complete()
    command.mdi(text)
    while command.wait_complete(5) == -1:
        pass
    wait(lambda: status.interp_state == linuxcnc.INTERP_IDLE and status.inpos)
    wait(settled)


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
places = [(3.3 + 48.74 * k, -298.1 + 29.26 * k) for k in range(10)]
rows = []
for way, first, order in ((1, "X0 Z-300", places), (-1, "X490 Z-1", places[::-1])):
    go(f"G0 {first}")
    for x, z in order:
        go(f"G0 X{x:.6f} Z{z:.6f}")
        at, added = ([hal.get_value(f"joint.{j}.{pin}") for j in JOINTS] for pin in ("pos-cmd", "backlash-filt"))
        rows.append({"at": at, "way": way, "added": added})
with open(sys.argv[1], "w") as file:
    json.dump(rows, file)
