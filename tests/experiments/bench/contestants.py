"""Who takes part, by name: our paths, the peers, and the floor that memory sets."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np

from abbe.models.arrays import F2
from abbe.models.geometry.field import field_mm
from tests.experiments.bench import peers
from tests.experiments.bench.case import Case
from tests.experiments.kernel import fast, kernel

Run = Callable[[], F2]


def _numpy(case: Case) -> Run:
    return partial(kernel.scattered, case.tables, case.points)


def _path() -> fast.Compiled:
    found = fast.compiled_path()
    if found is None:
        raise SystemExit("numba is not installed here: use make bench")
    return found


def _compiled(case: Case) -> Run:
    return partial(_path().scattered, case.tables, case.points, all_cores=True)


def _compiled_one(case: Case) -> Run:
    return partial(_path().scattered, case.tables, case.points)


def _product(case: Case) -> Run:
    """What `abbe errors` and every map of a solution call."""
    return lambda: field_mm(case.tables.machine, case.tables.motions, case.points)


def _copy(case: Case) -> Run:
    """Floor of any points: read 24 MB, write 24 MB, into the same place each time."""
    out = np.zeros_like(case.points)

    def run() -> F2:
        np.copyto(out, case.points)
        return out

    return run


def _copy_all(case: Case) -> Run:
    """The same with all cores."""
    out, cores = np.zeros_like(case.points), cpu_count()
    parts = [slice(k * len(out) // cores, (k + 1) * len(out) // cores) for k in range(cores)]
    pool = ThreadPoolExecutor(cores)

    def run() -> F2:
        list(pool.map(lambda s: np.copyto(out[s], case.points[s]), parts))
        return out

    return run


def _fill(case: Case) -> Run:
    """Floor of the grid: write 24 MB."""
    out = np.zeros_like(case.points)

    def run() -> F2:
        out.fill(1.0)
        return out

    return run


def cpu_count() -> int:
    """Cores this process may use."""
    import os

    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


OURS: dict[str, dict[str, Callable[[Case], Run]]] = {
    "scattered": {"product": _product, "numpy": _numpy, "compiled": _compiled, "compiled-1": _compiled_one},
    "grid": {"product": _product},
}
PEERS: dict[str, Callable[[Case], Run]] = {"htm": peers.htm, "sympy": peers.sympy, "pytransform3d": peers.pytransform3d}
EXTRA: dict[str, dict[str, Callable[[Case], Run]]] = {
    "scattered": {
        "htm-small-even": partial(peers.htm, small_angles=True, even=True),
        "sympy-even": partial(peers.sympy, even=True),
        "sympy-g-even": partial(peers.sympy, even=True, rule_g=True),
    },
    "grid": {"htm-small": partial(peers.htm, small_angles=True), "sympy-open": partial(peers.sympy, open_grid=True)},
}
"""Peers with more help than a user would give them at first; they have no goal."""
FLOORS: dict[str, dict[str, Callable[[Case], Run]]] = {
    "scattered": {"copy": _copy, "copy-all": _copy_all},
    "grid": {"copy": _copy, "fill": _fill},
}


def look_up(name: str, case: Case) -> Callable[[], object] | None:
    """The look-up of table values alone, as a peer does it; None for our paths and floors."""
    if name not in PEERS and name not in EXTRA[case.name]:
        return None
    return peers.look_up(case, open_grid=name == "sympy-open", even=name.endswith("-even"))


def contestants(case: str) -> dict[str, Callable[[Case], Run]]:
    """All that take part in a case."""
    return {**OURS[case], **PEERS, **EXTRA[case], **FLOORS[case]}
