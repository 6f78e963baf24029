"""Run by the control's own Python beside a running LinuxCNC: goes to places in both directions and writes what was added there (JSON)."""

import json
import sys

import hal  # type: ignore[import-not-found]
from probe_control import go, start, wait  # type: ignore[import-not-found]

JOINTS = (0, 2)


def settled():
    """The applied correction has followed the wanted one."""
    return all(abs(hal.get_value(f"joint.{j}.backlash-filt") - hal.get_value(f"joint.{j}.backlash-corr")) < 1e-9 for j in JOINTS)


component = start()
wait(settled)
places = [(3.3 + 48.74 * k, -298.1 + 29.26 * k) for k in range(10)]
rows = []
for way, first, order in ((1, "X0 Z-300", places), (-1, "X490 Z-1", places[::-1])):
    go(f"G0 {first}")
    wait(settled)
    for x, z in order:
        go(f"G0 X{x:.6f} Z{z:.6f}")
        wait(settled)
        at, added = ([hal.get_value(f"joint.{j}.{pin}") for j in JOINTS] for pin in ("pos-cmd", "backlash-filt"))
        rows.append({"at": at, "way": way, "added": added})
with open(sys.argv[1], "w") as file:
    json.dump(rows, file)
