#!/usr/bin/python3
"""Runs beside the control until its input ends: keeps the comparator of contact.hal at the hole that the tool is nearest to.

Argument: JSON with ``holes`` (where the tool must be to stand in the middle of each, mm), ``reach_mm``, and ``field``: coefficients
of `error_mm`. The comparison itself runs in the servo thread.
"""

import json
import select
import sys

import hal

PERIOD_S = 0.004
GIVEN = json.loads(sys.argv[1])


def error_mm(x, y):
    """Actual minus commanded in X and Y, mm: scales, squareness and bent axes."""
    a, b, c, d, e = GIVEN["field"]
    u, v = x - 300.0, y - 250.0
    return a * u + c * v + d * v * v, b * v + e * u * u


component = hal.component("contact")
component.ready()
told = False
while not select.select([sys.stdin], [], [], PERIOD_S)[0]:
    x, y = hal.get_value("drive-x"), hal.get_value("drive-y")
    ex, ey = error_mm(x, y)
    cx, cy = min(GIVEN["holes"], key=lambda c: (c[0] - x) ** 2 + (c[1] - y) ** 2)
    hal.set_p("contact-x.offset", repr(ex - cx))
    hal.set_p("contact-y.offset", repr(ey - cy))
    if not told:
        hal.set_p("contact-reach.in0", repr(GIVEN["reach_mm"]))
        sys.stdout.write("ready\n")
        sys.stdout.flush()
        told = True
