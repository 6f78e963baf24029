#!/usr/bin/python3
"""Runs beside the control, with its Python: tells what the drives get. One line in, one answer on stdout.

``get NAME...``: the values of HAL items. ``rows``: what `SAMPLER` of instance.py has taken in every servo period with the path output on,
since the last ``rows``: their number and then the rows, X Y Z of the command and X Y Z of the drives in mm.
"""

import sys

import hal

SHAPE = "ffffff"


def values(names):
    return [float(hal.get_value(name)) for name in names]


def rows():
    found = []
    while samples.readable:
        found.append(samples.read())
    if samples.num_overruns:
        sys.exit("the sampler's memory was too small")
    return found


component = hal.component("drives-probe")
samples = hal.stream(component, hal.sampler_base, SHAPE)
component.ready()
for line in sys.stdin:
    what, *names = line.split()
    answer = [values(names)] if what == "get" else rows()
    text = "".join(" ".join(map(repr, row)) + "\n" for row in answer)
    sys.stdout.write(text if what == "get" else f"{len(answer)}\n{text}")
    sys.stdout.flush()
