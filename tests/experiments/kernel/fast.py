"""The fastest path there is here: compiled when numba is installed (extra ``fast``) and the points are many, otherwise numpy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import ArrayLike

from abbe.models.arrays import F2
from tests.experiments.kernel import kernel
from tests.experiments.kernel.table_machine import TableMachine

WORTH_COMPILING = 200_000
"""Points from which on the compiled path is taken: loading it takes as long as numpy needs for some million points, once per process."""


@dataclass(frozen=True, slots=True)
class Compiled:
    """The compiled kernels (`tests.experiments.kernel.compiled`), and how many cores they use when asked for all."""

    scattered: Callable[..., F2]
    threads: Callable[[], int]


@cache
def compiled_path() -> Compiled | None:
    """The compiled path, or None without numba. The first call of a process loads it, the first on a computer compiles it."""
    try:
        from tests.experiments.kernel import compiled
    except ImportError:
        return None
    return Compiled(compiled.scattered, compiled.threads)


def scattered(tables: TableMachine, axes_mm: ArrayLike, out: F2 | None = None, *, all_cores: bool = False) -> F2:
    """First-order deviation at any positions, by the path that suits; parameters, result and errors as in `kernel.scattered`.

    The paths agree to rounding (about 1e-15 mm for a usual machine). Any number of threads may call it at once.

    ``all_cores``: the compiled path may share the points among all cores. A process forked after such a call must not ask for it again
    (GNU OpenMP ends such a process); without ``all_cores`` it may go on.
    """
    axes = np.asarray(axes_mm, dtype=np.float64)
    if len(np.atleast_1d(axes)) >= WORTH_COMPILING and (found := compiled_path()) is not None:
        return found.scattered(tables, axes, out, all_cores=all_cores)
    return kernel.scattered(tables, axes, out)


def path(*, all_cores: bool = False) -> str:
    """What many points are worked out by, in words for a report: ``"compiled, 2 threads"``, ``"compiled, 1 thread"`` or ``"numpy"``."""
    found = compiled_path()
    if found is None:
        return "numpy"
    n = found.threads() if all_cores else 1
    return f"compiled, {n} thread{'s' * (n > 1)}"
