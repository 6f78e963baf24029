"""Executors for many independent jobs: in this process, in processes of this computer, or on a Dask cluster, with the same results."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import closing
from multiprocessing import get_context
from typing import Any, Protocol, TypeVar

from abbe.service.children import started_safely
from abbe.service.errors import ConfigError

J = TypeVar("J")
R = TypeVar("R")


class Executor(Protocol):
    """Runs jobs. The function must belong to a module, and jobs and results must be plain values, because other processes receive them."""

    def map(self, work: Callable[[J], R], jobs: Iterable[J]) -> Iterator[R]:
        """Results in the order of the jobs. The error of a job is raised in place of its result."""
        ...


class SerialExecutor:
    """Runs jobs one after the other in this process."""

    def map(self, work: Callable[[J], R], jobs: Iterable[J]) -> Iterator[R]:
        """Results in the order of the jobs."""
        return map(work, jobs)


class ProcessExecutor:
    """Runs jobs in ``workers`` new processes of this computer, which inherit neither open databases nor threads."""

    def __init__(self, workers: int) -> None:
        self._workers = workers

    def map(self, work: Callable[[J], R], jobs: Iterable[J]) -> Iterator[R]:
        """Results in the order of the jobs."""
        with started_safely():  # all processes start here; creating the pool starts the resource tracker
            pool = ProcessPoolExecutor(self._workers, mp_context=get_context("spawn"))
            found = pool.map(work, jobs)
        with pool:
            yield from found


class DaskExecutor:
    """Runs jobs on a Dask cluster (extra ``fleet``); ``address``: of its scheduler, e.g. ``tcp://127.0.0.1:8786``.

    The workers need this version of Abbe with its extra, and the database under the same URL. Anyone who can connect to the scheduler can
    run programs on the cluster: keep it in a separate network, or use TLS (``tls://``).

    Raises
    ------
    ConfigError
        The extra is not installed, or no scheduler answers.
    """

    def __init__(self, address: str) -> None:
        try:
            from distributed import Client
        except ModuleNotFoundError:
            raise ConfigError("Dask is not installed", "pip install 'abbe[fleet]', or use --workers") from None
        try:
            self._client: Any = Client(address, timeout="10s", set_as_default=False)
        except (OSError, ValueError) as err:  # TimeoutError is an OSError
            raise ConfigError(
                f"no Dask scheduler answers at {address}: {type(err).__name__}", "dask scheduler, then dask worker ADDRESS"
            ) from None

    def map(self, work: Callable[[J], R], jobs: Iterable[J]) -> Iterator[R]:
        """Results in the order of the jobs."""
        with closing(self._client) as client:
            # pure=False: Dask computes equal jobs again, like the other executors.
            for future in client.map(work, list(jobs), pure=False):
                yield future.result()
