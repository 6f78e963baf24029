"""Small runs for tests of the discovery: circles and helices of a bar, step diagonals of a laser."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.discovery.case import Case, CaseRun
from abbe.models.effects.path import Path, Places, at_rest, driven
from abbe.models.machine import Machine
from abbe.models.paths import diagonal_ends, helix_points, step_diagonal

MACHINE = Machine("w-X-b-Y-Z-t", np.array([[0.0, 700.0], [0.0, 500.0], [0.0, 450.0]]))
CENTRE = np.array([350.0, 250.0, 200.0])


def bar(
    label: str,
    q_mm: F2,
    t_set_s: float,
    *,
    setup: str = "A",
    feed: float = 1500.0,
    back: bool = False,
    centre: F1 = CENTRE,
    test: str = "ballbar_circle",
) -> Path:
    """A ball-bar run over given positions."""
    q = q_mm[::-1] if back else q_mm
    way = np.linalg.norm(np.diff(q, axis=0, prepend=q[:1]), axis=1).cumsum()
    start = 600.0 if setup == "A" else t_set_s - 10.0
    t = t_set_s + way / (feed / 60.0)
    t = t[0] + (t[-1] - t[0]) * np.arange(len(t)) / (len(t) - 1)
    f = np.full(len(q), feed)
    at = driven(q, t, f, dwelling=False, temp_c={})
    away = q - centre
    length = np.linalg.norm(away, axis=1, keepdims=True)
    ones = np.full(len(q), -1.0 if back else 1.0)
    return Path(
        label, setup, test, "bar", MACHINE, 2, at, at_rest(centre, start, {}), away / length, f, ones, 0 * ones, start, 0.0,
        float(np.median(length)), centre,
    )  # fmt: skip


def circle(plane: tuple[int, int], n: int = 240, radius: float = 150.0) -> F2:
    """A circle about `CENTRE`, both ends included."""
    angle = np.linspace(0.0, 2.0 * np.pi, n)
    q = np.tile(CENTRE, (n, 1))
    q[:, plane[0]] += radius * np.cos(angle)
    q[:, plane[1]] += radius * np.sin(angle)
    return q


def laser(label: str, diagonal: str, start_s: float) -> Path:
    """A step diagonal out and back."""
    a, b = diagonal_ends(np.array([[20.0, 680.0], [20.0, 480.0], [20.0, 430.0]]), diagonal)
    q, beam = step_diagonal(a, b, 15), (b - a) / np.linalg.norm(b - a)
    n = len(q)
    t, feed = start_s + 5.0 * np.arange(n), np.full(n, 3000.0)
    at = driven(q, t, feed, dwelling=True, temp_c={})
    first = Places(q[:1], at.sign[:1], at.since_mm[:1], at.v_mm_s[:1], at.a_mm_s2[:1], t[:1], {})
    way = np.where(np.arange(n) < n // 2, 1.0, -1.0)
    return Path(
        label, f"L{diagonal}", "laser_diagonal", "laser", MACHINE, 2, at, first, np.tile(beam, (n, 1)), feed, way, (q - q[0]) @ beam,
        start_s, 900.0, 0.0, np.zeros(3),
    )  # fmt: skip


def campaign() -> tuple[Path, ...]:
    """Three planes and a helix at two feeds, both ways; two diagonals, two runs each."""
    out, t = [], 620.0
    for k, plane in enumerate(((0, 1), (1, 2), (2, 0))):
        for feed in (1000.0, 3000.0):
            for back in (False, True):
                out.append(bar(f"c{k}{feed:.0f}{back:d}", circle(plane), t, feed=feed, back=back))
                t += 75.0
    helix = helix_points(CENTRE, 150.0, turns=8.0, n=320, axis=2)
    for back in (False, True):
        out.append(bar(f"h{back:d}", helix, t, setup="B", back=back, feed=2000.0, test="ballbar_helix"))
        t += 100.0
    return (*out, *(laser(f"l{d}{k}", d, t + 500.0 * (k + 2 * i)) for i, d in enumerate(("ppp", "npp")) for k in range(2)))


def case_of_paths(paths: tuple[Path, ...], *includes: str) -> Case:
    """A case without readings."""
    runs = tuple(CaseRun(p, "identify", np.zeros(p.n), np.ones(p.n, dtype=bool)) for p in paths)
    return Case("t", MACHINE, frozenset(includes), runs, {"bar": 1e-4, "laser": 1e-5})


def noise(paths: tuple[Path, ...], seed: int) -> tuple[F1, ...]:
    """White noise of unit variance by run."""
    rng = np.random.default_rng(seed)
    return tuple(rng.standard_normal(p.n) for p in paths)


def moved(path: Path, seconds: float) -> Path:
    """The same run later."""
    return replace(path, at=replace(path.at, t_s=path.at.t_s + seconds))
