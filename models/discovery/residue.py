"""Names that are only what a stronger effect's formula leaves of its true form: no machine is true to a formula."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from abbe.models.discovery.answer import NamedEffect

RESIDUE_SHARE = 0.001
"""A name with less evidence than this share of the largest is nothing that can be told from what the largest one's formula leaves."""
SCATTER_SHARE, SMOOTH_SHARE, SCATTER = 0.01, 0.003, ("stick_slip", "vibration")
"""Scatter of readings that move along with the axes: below this share of the strongest effect of the mean, at any axis, it is its rest; a
smooth effect leaves less that looks like scatter than one with corners or waves (a true stick-slip lay at 1.0 % of a pitch error)."""
AXIS_SHARE = 0.02
AT_TURNS = ("backlash", "backlash_position_dependent", "reversal_spike", "lateral_play", "servo_mismatch")
"""What a drive shows at the turns of its axis is told from another such effect of the same axis by its form only: below this share it is
that one's form."""
ROUGH = (*AT_TURNS, "cyclic_error")
"""Effects with corners or waves."""
KIN_SHARE = 0.03
CLOCK = ("bar_thermal", "axis_thermal_growth", "spindle_thermal_drift", "squareness_thermal")
LAG = ("contour_lag", "servo_mismatch")
SHAPE = ("straightness", "angular_error", "positioning_nonlinear", "nonrigid_bed", "ram_sag")
"""Effects that live on the same clock, are curves over the same positions, or lags of the drives: what one's formula leaves, off by a sixth
(3 % squared), is shaped like another. Counted on 345 cases (lags on 150 others): ten false names of these kinds at 0.2 to 2.9 % of the
strong one, one true one, at 9 %."""


def residues(effects: Sequence[NamedEffect], scatter: frozenset[str]) -> Mapping[str, str]:
    """Names that a stronger one's form explains.

    A name is a residue with evidence below

    - 0.1 % of the strongest name's;
    - 1 % of the strongest effect of the mean's, where it is stick-slip or vibration, whatever the axis (0.3 % where that effect is smooth);
    - 2 % of a stronger effect's of the same drive (lost motion, its change along the axis, spikes, play across, servo mismatch: keys that
      end with the same axis);
    - 3 % of a stronger one's of its kin: what warms up on the same clock (a bar from the hand too), is a curve over the same axis or in the
      same direction (and positioning beside thermal growth of the same axis), or is a lag (of all drives, of one of them).

    What is weak but of another kind, or shares neither axis nor direction, stays: it is no form of the strong one.

    Parameters
    ----------
    effects : everything with a name. scatter : labels of those that were found in the scatter of the readings.

    Returns
    -------
    dict
        Why, by label, for people.
    """
    out: dict[str, str] = {}
    for small in effects:
        for big in sorted(effects, key=lambda e: -e.evidence):
            share = _share(small, big, big.label in scatter)
            if small.evidence < share * big.evidence:
                told = f"{small.evidence:.0f} nats, {small.evidence / big.evidence:.1%} of {big.label}'s"
                out[small.label] = f"{told}: too small beside it to be more than what its formula leaves"
                break
    return out


def _share(small: NamedEffect, big: NamedEffect, big_is_scatter: bool) -> float:
    """Share of the bigger one's evidence below which the smaller one is its residue."""
    if small.name in AT_TURNS and big.name in AT_TURNS and small.key[-1:] == big.key[-1:]:
        return AXIS_SHARE
    grown = small.name == "positioning_nonlinear" and big.name == "axis_thermal_growth" and small.key == big.key
    clock = small.name in CLOCK and big.name in CLOCK
    lag = small.name in LAG and big.name in LAG and small.name != big.name
    if grown or clock or lag or (small.name in SHAPE and big.name in SHAPE and _together(small.key, big.key)):
        return KIN_SHARE
    if small.name in SCATTER and not big_is_scatter:
        return SCATTER_SHARE if big.name in ROUGH else SMOOTH_SHARE
    return RESIDUE_SHARE


def _together(a: str, b: str) -> bool:
    """Whether two error motions (EYX) or axes (X) share the moving axis or the direction that deviates; the ram's sag (no key) with all."""
    if not a or not b or a[-1] == b[-1]:
        return True
    directions = [key[1] for key in (a, b) if len(key) == 3 and key[1] in "XYZ"]
    return len(directions) == 2 and directions[0] == directions[1]
