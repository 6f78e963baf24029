"""The sign rule of every format (controllers.md 5.7), e = actual − nominal. No other code depends on these signs.

A number in a file is ``per_error`` times e, plus the nominal position if the control expects the reached position.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from abbe.models.arrays import F1

Evidence = Literal["verified by execution", "by manual"]


@dataclass(frozen=True, slots=True)
class SignRule:
    """Conversion of an error to a number in a file.

    ``per_error``: +1 or −1. ``adds_position``: the number is a reached position. ``sure``: False if no manual states the sign explicitly;
    then the 10 µm step must be verified on the machine before anything is loaded.
    """

    per_error: Literal[1, -1]
    adds_position: bool
    evidence: Evidence
    sure: bool
    words: str


SIGNS: dict[str, SignRule] = {
    "isg": SignRule(1, False, "by manual", False, "the error itself; the kernel can turn it over (parameter negate)"),
    "linuxcnc-1": SignRule(-1, False, "verified by execution", True, "what is added to the motor's command: −e"),
    "linuxcnc-0": SignRule(1, True, "verified by execution", True, "the position that was reached: nominal + e"),
    "linuxcnc-hal": SignRule(-1, False, "verified by execution", True, "what is added to the drive's command: −e"),
    "siemens-eec": SignRule(1, False, "by manual", True, "corrects the ACTUAL value; a positive number moves the axis in −: +e"),
    "siemens-cec": SignRule(-1, False, "by manual", False, "added to the setpoint of the compensated axis: −e; not stated in a manual"),
    "fanuc-pitch": SignRule(-1, False, "by manual", False, "pulses that are added from point to point: −Δe; not stated in a manual"),
    "fanuc-lattice": SignRule(-1, False, "by manual", False, "pulses that are added: −e; not stated in a manual"),
    "heidenhain": SignRule(-1, False, "by manual", False, "compensation value: −e; manuals differ (error or correction)"),
    "mach4": SignRule(-1, False, "by manual", True, "expected − actual: −e"),
    "centroid": SignRule(-1, False, "by manual", False, "amount of correction to apply: −e; not stated in a manual"),
}


def to_file(rule: str, correction: F1, position_mm: F1) -> F1:
    """Numbers of a file for corrections at positions of its axis."""
    sign = SIGNS[rule]
    value = -sign.per_error * np.asarray(correction, dtype=np.float64)
    return value + position_mm if sign.adds_position else value


def from_file(rule: str, number: F1, position_mm: F1) -> F1:
    """Corrections from numbers of a file."""
    sign = SIGNS[rule]
    value = np.asarray(number, dtype=np.float64)
    return -sign.per_error * (value - position_mm if sign.adds_position else value) + 0.0
