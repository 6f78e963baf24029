"""Run by the control's own Python beside a LinuxCNC with our kinematics: what the joints get without, with and again without them."""

import json
import os
import random
import sys
import time

import hal  # type: ignore[import-not-found]
import linuxcnc  # type: ignore[import-not-found]

command, status = linuxcnc.command(), linuxcnc.stat()
PLACES = 25


def wait(condition, limit_s=20.0):
    """Poll until a condition holds."""
    end = time.monotonic() + limit_s
    while time.monotonic() < end:
        status.poll()
        if condition():
            return
        time.sleep(0.005)  # noqa: TID251 - a process of its own, with no event loop
    raise TimeoutError


def go(at):
    """One straight move, to its end."""
    command.mdi("G0 " + " ".join(f"{a}{v:.6f}" for a, v in zip("XYZ", at)))  # noqa: B905 - the control's Python
    while command.wait_complete(5) == -1:
        pass
    wait(lambda: status.interp_state == linuxcnc.INTERP_IDLE and status.inpos)


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
command.mode(linuxcnc.MODE_MDI)
command.wait_complete()
command.mdi("G21 G90 G64 P0.001 G94")
command.wait_complete()
chosen = random.Random(7)
places = [(chosen.uniform(0, 500), chosen.uniform(-200, 200), chosen.uniform(-300, 0)) for _ in range(PLACES)]
rows = []
for phase, weight, count in (("before", 0.0, 5), ("in force", 1.0, PLACES), ("back", 0.0, 5)):
    hal.set_p("abbekins.weight", str(weight))
    wait(lambda: hal.get_value("abbekins.applied") == weight)  # noqa: B023 - called at once
    seen = []
    for at in places[:count]:
        go(at)
        seen.append([hal.get_value(f"joint.{j}.pos-cmd") - round(at[j], 6) for j in range(3)])
    rows.append({"phase": phase, "at": [[round(v, 6) for v in at] for at in places[:count]], "added": seen})
with open(sys.argv[1], "w") as file:
    json.dump(rows, file)
