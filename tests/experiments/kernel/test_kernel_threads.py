"""Compiled kernels entered by several threads at once, and by a forked process; each in a process of its own, since what fails aborts."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys

import pytest

from tests.experiments.kernel.test_kernel import NO_NUMBA

PREPARE = """
import os, sys, threading
import numpy as np
from tests.experiments.kernel import fast, kernel
from tests.experiments.kernel.test_kernel import machine, points
fast.WORTH_COMPILING = 1
tables, p = machine(), points(20_000)
expected = kernel.scattered(tables, p)
def differs(all_cores):
    return np.abs(fast.scattered(tables, p, all_cores=all_cores) - expected).max() > 1e-12
"""
THREADS = """
wrong = []
start = threading.Barrier(4)
def work():
    start.wait()
    for _ in range(20):
        if differs(sys.argv[1] == "all"):
            wrong.append(1)
threads = [threading.Thread(target=work) for _ in range(4)]
for t in threads: t.start()
for t in threads: t.join()
print("wrong" if wrong else fast.path(all_cores=True))
"""
FORK = """
assert not differs(True)
child = os.fork()
if child == 0:
    os._exit(3 if differs(False) else 0)
print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""


def run(code, *arguments, **variables):
    """Exit code 0 demanded; what was printed."""
    environment = {**os.environ, "NUMBA_NUM_THREADS": "2", **variables}
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", PREPARE + code, *arguments],
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
        env=environment,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


pytestmark = pytest.mark.skipif(not os.environ.get("ABBE_TEST_LONG"), reason="an experiment that no command uses: ABBE_TEST_LONG=1 runs it")


@pytest.fixture(autouse=True)
def numba(require):
    """All of this is about the extra ``fast``."""
    require("numba", importlib.util.find_spec("numba") is not None, NO_NUMBA)


@pytest.mark.parametrize("cores", ["one", "all"])
def test_four_threads_at_once_where_numba_has_only_its_workqueue(cores):
    assert run(THREADS, cores, NUMBA_THREADING_LAYER="workqueue") == "compiled, 1 thread"


def test_four_threads_at_once_that_all_ask_for_all_cores():
    assert run(THREADS, "all").startswith("compiled, ")


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
def test_a_process_forked_after_a_call_on_all_cores_goes_on_with_one_core():
    assert run(FORK) == "0"
