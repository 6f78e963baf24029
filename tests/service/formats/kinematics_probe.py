"""Run by the control's own Python beside a LinuxCNC with our kinematics: what the joints get without, with and again without them."""

import json
import random
import sys
import time

import hal  # type: ignore[import-not-found]
from probe_control import go, start, wait  # type: ignore[import-not-found]

PLACES = 25


def joints():
    """Return what the joints are told once they stand: a loaded computer sees a motion ended before its last step."""
    seen, now = None, [hal.get_value(f"joint.{j}.pos-cmd") for j in range(3)]
    while seen != now:
        time.sleep(0.05)  # noqa: TID251 - a process of its own, with no event loop
        seen, now = now, [hal.get_value(f"joint.{j}.pos-cmd") for j in range(3)]
    return now


component = start()
chosen = random.Random(7)
places = [(chosen.uniform(0, 500), chosen.uniform(-200, 200), chosen.uniform(-300, 0)) for _ in range(PLACES)]
rows = []
for phase, weight, count in (("before", 0.0, 5), ("in force", 1.0, PLACES), ("back", 0.0, 5)):
    hal.set_p("abbekins.weight", str(weight))
    wait(lambda: hal.get_value("abbekins.applied") == weight)  # noqa: B023 - called at once
    seen = []
    for at in places[:count]:
        go("G0 " + " ".join(f"{a}{v:.6f}" for a, v in zip("XYZ", at)))  # noqa: B905 - the control's Python
        seen.append([told - round(v, 6) for told, v in zip(joints(), at)])  # noqa: B905 - the control's Python
    rows.append({"phase": phase, "at": [[round(v, 6) for v in at] for at in places[:count]], "added": seen})
with open(sys.argv[1], "w") as file:
    json.dump(rows, file)
