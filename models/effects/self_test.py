"""What every effect must keep, ours and a user's: one runner, one line per fault."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Mapping
from typing import get_args

import numpy as np

from abbe.models.arrays import F2
from abbe.models.effects.effect import Effect, Family, Remedy, Signal, Values
from abbe.models.effects.path import Path

TESTS = ("ballbar_helix", "ballbar_circle", "laser_diagonal", "laser_linear")
UNITS = ("um", "urad", "ms", "K", "K/h", "mrad")
ADDS = (
    "second_feed", "opposite_direction", "second_radius", "planar_circles", "laser_diagonals", "ballbar", "single_axis_laser",
    "angular_interferometer", "second_tool_length", "longer_session", "reference_length",
)  # fmt: skip
KEY = re.compile(r"[XYZ]|E[XYZABC][XYZ]|XY|ZX|YZ|")
NAME = re.compile(r"[a-z][a-z0-9_]*")


def declaration_faults(effect: Effect) -> tuple[str, ...]:
    """What is wrong with what an effect says of itself; empty when nothing is. Nothing of it is computed."""
    texts = {n: getattr(effect, n) for n in ("title", "needs", "signature", "remedy_text", "source")}
    low, high = effect.typical
    checks = [
        (bool(NAME.fullmatch(effect.name)), f"name {effect.name!r}: lower-case letters, digits and _ expected"),
        (bool(effect.keys) and len(set(effect.keys)) == len(effect.keys), "keys: at least one, each once"),
        (all(KEY.fullmatch(k) for k in effect.keys), f"keys {effect.keys}: X, EYX, EAX, XY, ZX, YZ or nothing expected"),
        (effect.unit in UNITS, f"unit {effect.unit!r}: one of {', '.join(UNITS)} expected"),
        (effect.per_unit > 0.0, "per_unit: must be positive"),
        (0.0 < low <= high, f"typical {effect.typical}: smaller and larger size expected"),
        (effect.family in get_args(Family), f"family {effect.family!r}: one of {', '.join(get_args(Family))} expected"),
        (effect.remedy in get_args(Remedy), f"remedy {effect.remedy!r}: one of {', '.join(get_args(Remedy))} expected"),
        (effect.kind in ("mean", "variance"), f"kind {effect.kind!r}: mean or variance expected"),
        (set(effect.blind) < set(TESTS), f"blind {effect.blind}: some, not all, of {', '.join(TESTS)} expected"),
        (all(set(v) <= set(ADDS) and v for v in effect.separated_by.values()), f"separated_by: only {', '.join(ADDS)}"),
        *((bool(text.strip()), f"{n}: must say something") for n, text in texts.items()),
        *(
            (p.low <= min(p.starts) <= max(p.starts) <= p.high and p.low <= p.typical <= p.high and p.low < p.high, f"{p.name}: {p}")
            for p in effect.shape
        ),
    ]
    return tuple(fault for good, fault in checks if not good)


def signal_faults(effect: Effect, paths: tuple[Path, ...]) -> tuple[str, ...]:
    """What is wrong with an effect's columns, and with those of its forms, on some paths (`abbe.models.effects.probe_paths`)."""
    out: list[str] = []
    for name, signal in (("signal", effect.signal), *((f"form {f.name}", f.signal) for f in effect.forms)):
        for key, values in itertools.product(effect.keys, corners(effect)):
            found = _faults(effect, signal, paths, key, values)
            out += [f"{name} of {effect.label(key)}: {fault}" for fault in found]
            if found:
                break
    return tuple(out)


def corners(effect: Effect) -> Iterable[Values]:
    """Values of the non-linear parameters to try: usual ones, and both ends of the bounds."""
    sets: list[Mapping[str, float]] = [{p.name: p.typical for p in effect.shape}]
    if effect.shape:
        sets += [{p.name: p.low for p in effect.shape}, {p.name: p.high for p in effect.shape}]
    return sets


def _faults(effect: Effect, signal: Signal, paths: tuple[Path, ...], key: str, values: Values) -> list[str]:
    columns = signal(paths, key, values)
    shape = [np.shape(c) for c in columns]
    if len(columns) != len(paths) or any(len(s) != 2 or s[0] != p.n or s[1] != shape[0][1] for s, p in zip(shape, paths, strict=False)):
        return [f"one array (readings, coefficients) per run expected, the same number of coefficients in all, got {shape}"]
    if not all(np.isfinite(c).all() for c in columns):
        return ["a value is not finite"]
    out = [f"declared blind to {p.test} and is not" for p, c in zip(paths, columns, strict=True) if p.test in effect.blind and c.any()][:1]
    if effect.kind == "variance" and any((c < 0.0).any() for c in columns):
        out.append("extra variance must not be negative")
    if not _same_in_any_order(signal, paths, key, values, columns):
        out.append("another order of the runs gives other columns")
    return out


def _same_in_any_order(signal: Signal, paths: tuple[Path, ...], key: str, values: Values, columns: list[F2]) -> bool:
    back = signal(paths[::-1], key, values)[::-1]
    return all(np.allclose(a, b, rtol=1e-12, atol=1e-18) for a, b in zip(columns, back, strict=True))
