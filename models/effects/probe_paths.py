"""A small campaign made up for tests of effects: every kind of test, both directions, two feeds, two radii, early and late."""

from __future__ import annotations

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.effects.path import Kind, Path, driven, standing
from abbe.models.machine import Machine
from abbe.models.paths.helix import helix_points
from abbe.models.paths.lines import diagonal_ends, step_diagonal

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


def probe_paths(machine: Machine = MACHINE, vertical: int = VERTICAL) -> tuple[Path, ...]:
    """Helices and circles (both directions, two feeds, two radii), step diagonals, a line along X; six hours on the clock.

    Parameters
    ----------
    machine : Machine
        Its strokes must hold 150 mm around (290, 240, 200).
    vertical : int
        Axis that gravity acts along.
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
    """Temperatures of all sensors, degrees C: all of them rise, each at its own pace."""
    return {name: 20.0 + (k + 1) * -np.expm1(-t_s / (1500.0 + 900.0 * k)) for k, name in enumerate(SENSORS)}


def _bar(owner: tuple[Machine, int], names: tuple[str, str], q_mm: F2, radius_mm: float, drive: tuple[float, int], start_s: float) -> Path:
    """``owner``: machine and vertical axis; ``names``: label and test; ``drive``: feed and direction."""
    (label, test), (feed, direction), (machine, vertical) = names, drive, owner
    q_mm = q_mm[::direction]
    way: F1 = np.asarray(np.linalg.norm(np.diff(q_mm, axis=0, prepend=q_mm[:1]), axis=1).cumsum(), dtype=np.float64)
    t_s: F1 = np.asarray(start_s + way / (feed / 60.0), dtype=np.float64)
    set_s = 1800.0 * (start_s // 1800.0) - 120.0
    feeds = np.full(len(q_mm), feed)
    at = driven(q_mm, t_s, feeds, dwelling=False, temp_c=_warm(t_s))
    reference = standing(CENTRE_MM, set_s, _warm(np.array([set_s])))
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
