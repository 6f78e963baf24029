"""Check that an effect, built-in or plug-in, keeps the rules of a declaration; its columns are tried on a small synthetic campaign."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Mapping
from typing import get_args

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.effects.effect import Effect, Family, Remedy, Signal, Values
from abbe.models.effects.path import Kind, Path, at_rest, driven
from abbe.models.machine import Machine
from abbe.models.paths import diagonal_ends, helix_points, step_diagonal

TESTS = ("ballbar_helix", "ballbar_circle", "laser_diagonal", "laser_linear")
UNITS = ("um", "urad", "ms", "K", "K/h", "mrad")
ADDS = (
    "second_feed", "opposite_direction", "second_radius", "planar_circles", "laser_diagonals", "ballbar", "single_axis_laser",
    "angular_interferometer", "second_tool_length", "longer_session", "reference_length",
)  # fmt: skip
KEY = re.compile(r"[XYZ]|E[XYZABC][XYZ]|XY|ZX|YZ|")
NAME = re.compile(r"[a-z][a-z0-9_]*")
MACHINE = Machine(
    "w-X-b-Y-Z-t",
    np.array([[0.0, 600.0], [0.0, 500.0], [0.0, 450.0]]),
    np.array([[300.0, 250.0, -150.0], [0.0, 320.0, 260.0], [0.0, 320.0, 260.0]]),
)
VERTICAL = 1
CENTRE_MM = np.array([290.0, 240.0, 200.0])
DEAD_PATH_MM = 900.0
STEP_S = 5.0
SENSORS = ("x", "y", "z", "spindle", "air")


def declaration_faults(effect: Effect) -> tuple[str, ...]:
    """Return one message per fault of an effect's declaration; no column is computed."""
    texts = {n: getattr(effect, n) for n in ("title", "needs", "signature", "remedy_text", "source")}
    low, high = effect.typical
    checks = [
        (bool(NAME.fullmatch(effect.name)), f"name {effect.name!r}: expected lower-case letters, digits and _"),
        (bool(effect.keys) and len(set(effect.keys)) == len(effect.keys), f"keys {effect.keys}: expected one key or more, each only once"),
        (all(KEY.fullmatch(k) for k in effect.keys), f"keys {effect.keys}: expected X, EYX, EAX, XY, ZX, YZ or nothing"),
        (effect.unit in UNITS, f"unit {effect.unit!r}: expected one of {', '.join(UNITS)}"),
        (effect.per_unit > 0.0, f"per_unit {effect.per_unit}: must be positive"),
        (0.0 < low <= high, f"typical {effect.typical}: expected two positive numbers, the smaller first"),
        (effect.family in get_args(Family), f"family {effect.family!r}: expected one of {', '.join(get_args(Family))}"),
        (effect.remedy in get_args(Remedy), f"remedy {effect.remedy!r}: expected one of {', '.join(get_args(Remedy))}"),
        (effect.kind in ("mean", "variance"), f"kind {effect.kind!r}: expected mean or variance"),
        (set(effect.blind) < set(TESTS), f"blind {effect.blind}: expected names from {', '.join(TESTS)}, but not all of them"),
        (
            all(set(v) <= set(ADDS) and v for v in effect.separated_by.values()),
            f"separated_by: expected one or more of {', '.join(ADDS)} for each rival",
        ),
        *((bool(text.strip()), f"{n}: must not be empty") for n, text in texts.items()),
        *(
            (
                p.low <= min(p.starts) <= max(p.starts) <= p.high and p.low <= p.typical <= p.high and p.low < p.high,
                f"parameter {p.name}: expected low < high, with typical and all starts between them; got {p}",
            )
            for p in effect.shape
        ),
    ]
    return tuple(fault for good, fault in checks if not good)


def signal_faults(effect: Effect, paths: tuple[Path, ...]) -> tuple[str, ...]:
    """Return one message per fault of the columns of an effect and its forms on the given paths."""
    out: list[str] = []
    for name, signal in (("signal", effect.signal), *((f"form {f.name}", f.signal) for f in effect.forms)):
        for key, values in itertools.product(effect.keys, corners(effect)):
            found = _faults(effect, signal, paths, key, values)
            out += [f"{name} of {effect.label(key)}: {fault}" for fault in found]
            if found:
                break
    return tuple(out)


def corners(effect: Effect) -> Iterable[Values]:
    """Return values of the non-linear parameters to try: the typical ones, all lower bounds, all upper bounds."""
    sets: list[Mapping[str, float]] = [{p.name: p.typical for p in effect.shape}]
    if effect.shape:
        sets += [{p.name: p.low for p in effect.shape}, {p.name: p.high for p in effect.shape}]
    return sets


def _faults(effect: Effect, signal: Signal, paths: tuple[Path, ...], key: str, values: Values) -> list[str]:
    columns = signal(paths, key, values)
    shape = [np.shape(c) for c in columns]
    if len(columns) != len(paths) or any(len(s) != 2 or s[0] != p.n or s[1] != shape[0][1] for s, p in zip(shape, paths, strict=False)):
        return [f"expected one array of shape (readings, coefficients) per run, with equally many coefficients; got shapes {shape}"]
    if not all(np.isfinite(c).all() for c in columns):
        return ["a value is not finite"]
    out = [
        f"the effect lists {p.test} in `blind`, but its columns of this test are not zero"
        for p, c in zip(paths, columns, strict=True)
        if p.test in effect.blind and c.any()
    ][:1]
    if effect.kind == "variance" and any((c < 0.0).any() for c in columns):
        out.append("the extra variance must not be negative")
    if not _same_in_any_order(signal, paths, key, values, columns):
        out.append("the columns must not depend on the order of the runs")
    return out


def _same_in_any_order(signal: Signal, paths: tuple[Path, ...], key: str, values: Values, columns: list[F2]) -> bool:
    back = signal(paths[::-1], key, values)[::-1]
    return all(np.allclose(a, b, rtol=1e-12, atol=1e-18) for a, b in zip(columns, back, strict=True))


def probe_paths(machine: Machine = MACHINE, vertical: int = VERTICAL) -> tuple[Path, ...]:
    """Return a synthetic campaign of six hours: helices and circles (both directions, two feeds, two radii), step diagonals, a line on X.

    Parameters
    ----------
    machine : Machine
        Its strokes must contain a sphere of 150 mm radius about (290, 240, 200) mm.
    vertical : int
        Index of the axis along which gravity acts.
    """
    runs: list[Path] = []
    for k, (feed, direction, radius) in enumerate(((1000.0, 1, 150.0), (1000.0, -1, 150.0), (3000.0, 1, 100.0), (3000.0, -1, 100.0))):
        runs.append(_bar((machine, vertical), (f"h{k}", "ballbar_helix"), _helix(radius), radius, (feed, direction), 1800.0 * k))
        for plane in range(3):
            start_s = 1800.0 * k + 300.0 * (plane + 1)
            runs.append(
                _bar((machine, vertical), (f"c{k}{plane}", "ballbar_circle"), _circle(radius, plane), radius, (feed, direction), start_s)
            )
    for k, diagonal in enumerate(("ppp", "npp", "ppn")):
        box = machine.stroke_mm + np.array([60.0, -60.0])
        steps = step_diagonal(*diagonal_ends(box, diagonal), 12)
        runs.append(_laser((machine, vertical), f"l{k}", "laser_diagonal", steps, 8000.0 + 4000.0 * k))
    x = np.concatenate([np.linspace(50.0, 550.0, 26), np.linspace(550.0, 50.0, 26)])
    line = np.column_stack([x, np.full(52, 240.0), np.full(52, 200.0)])
    runs.append(_laser((machine, vertical), "x0", "laser_linear", line, 21000.0))
    return tuple(runs)


def _helix(radius_mm: float) -> F2:
    return helix_points(CENTRE_MM, radius_mm, turns=4.0, n=541, axis=2, span_rad=1.55)[::-1]


def _circle(radius_mm: float, plane: int) -> F2:
    angle = np.linspace(0.0, 2.0 * np.pi, 421) + 0.3
    out = np.repeat(CENTRE_MM[None], angle.size, axis=0)
    out[:, plane] += radius_mm * np.cos(angle)
    out[:, (plane + 1) % 3] += radius_mm * np.sin(angle)
    return out


def _warm(t_s: F1) -> dict[str, F1]:
    """Return temperatures of all sensors, degree C: all rise, each at its own rate."""
    return {name: 20.0 + (k + 1) * -np.expm1(-t_s / (1500.0 + 900.0 * k)) for k, name in enumerate(SENSORS)}


def _bar(owner: tuple[Machine, int], names: tuple[str, str], q_mm: F2, radius_mm: float, drive: tuple[float, int], start_s: float) -> Path:
    """Return a ball-bar run; ``owner``: machine and vertical axis, ``names``: label and test, ``drive``: feed in mm/min and direction."""
    (label, test), (feed, direction), (machine, vertical) = names, drive, owner
    q_mm = q_mm[::direction]
    way: F1 = np.asarray(np.linalg.norm(np.diff(q_mm, axis=0, prepend=q_mm[:1]), axis=1).cumsum(), dtype=np.float64)
    t_s: F1 = np.asarray(start_s + way / (feed / 60.0), dtype=np.float64)
    set_s = 1800.0 * (start_s // 1800.0) - 120.0
    feeds = np.full(len(q_mm), feed)
    at = driven(q_mm, t_s, feeds, dwelling=False, temp_c=_warm(t_s))
    reference = at_rest(CENTRE_MM, set_s, _warm(np.array([set_s])))
    return Path(
        label, f"bar{radius_mm:.0f}-{start_s // 1800.0:.0f}", test, "bar", machine, vertical, at, reference, (q_mm - CENTRE_MM) / radius_mm,
        feeds, np.full(len(q_mm), float(direction)), np.zeros(len(q_mm)), set_s, 0.0, radius_mm, CENTRE_MM,
    )  # fmt: skip


def _laser(owner: tuple[Machine, int], label: str, test: str, q_mm: F2, start_s: float) -> Path:
    machine, vertical = owner
    kind: Kind = "laser"
    t_s: F1 = np.asarray(start_s + STEP_S * np.arange(len(q_mm)), dtype=np.float64)
    feeds = np.full(len(q_mm), 3000.0)
    at = driven(q_mm, t_s, feeds, dwelling=True, temp_c=_warm(t_s))
    far = q_mm[int(np.argmax(np.linalg.norm(q_mm - q_mm[0], axis=1)))] - q_mm[0]
    beam = far / np.linalg.norm(far)
    first = driven(q_mm[:1], t_s[:1], feeds[:1], dwelling=True, temp_c=_warm(t_s[:1]))
    first = type(first)(first.q_mm, at.sign[:1], at.since_mm[:1], first.v_mm_s, first.a_mm_s2, first.t_s, first.temp_c)
    back = np.arange(len(q_mm)) >= len(q_mm) / 2
    return Path(
        label, f"mirror-{label}", test, kind, machine, vertical, at, first, np.broadcast_to(beam, q_mm.shape), feeds,
        np.where(back, -1.0, 1.0), (q_mm - q_mm[0]) @ beam, start_s - 300.0, DEAD_PATH_MM, 0.0, np.zeros(3),
    )  # fmt: skip
