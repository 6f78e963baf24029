#!/usr/bin/python3
"""Runs beside the control, with its Python: tells what the drives get. One line in, one answer on stdout.

``get NAME...``: the values of HAL items. ``path``: waits for the path output and, as long as it is on, takes joint commands and drive
commands of one instant; answers with the number of rows and then the rows, X Y Z of the command and X Y Z of the drives in mm.
"""

import signal
import sys
import time

import hal

COMMANDS = [f"joint.{n}.pos-cmd" for n in range(3)]
DRIVES = [f"drive-{a}" for a in "xyz"]
PERIOD_S = 0.003
PATIENCE_S = 20.0


def values(names):
    return [float(hal.get_value(name)) for name in names]


def rows():
    """Rows whose values did not change while they were read: the servo thread does not wait for us."""
    found = []
    begin = time.monotonic()
    while not hal.get_value("abbe-path.out") and time.monotonic() < begin + PATIENCE_S:
        signal.sigtimedwait([], PERIOD_S)
    while hal.get_value("abbe-path.out"):
        once, again = values(COMMANDS + DRIVES), values(COMMANDS + DRIVES)
        if once == again:
            found.append(once)
        signal.sigtimedwait([], PERIOD_S)
    return found


component = hal.component("drives-probe")
component.ready()
for line in sys.stdin:
    what, *names = line.split()
    answer = [values(names)] if what == "get" else rows()
    text = "".join(" ".join(map(repr, row)) + "\n" for row in answer)
    sys.stdout.write(text if what == "get" else f"{len(answer)}\n{text}")
    sys.stdout.flush()
