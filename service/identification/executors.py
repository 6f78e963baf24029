"""Where many independent jobs are computed: here, in processes of this computer, or on a Dask cluster. What a job gives is the same."""

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
    """Does jobs. Function, jobs and results are handed to other processes: a function of a module, and plain values."""

    def map(self, work: Callable[[J], R], jobs: Iterable[J]) -> Iterator[R]:
        """Results in the order of the jobs. An error of a job is raised when its turn comes."""
        ...


class Here:
    """One after the other in this process."""

    def map(self, work: Callable[[J], R], jobs: Iterable[J]) -> Iterator[R]:
        """Results in the order of the jobs."""
        return map(work, jobs)


class Processes:
    """In processes of this computer, each fresh: nothing of this one (open databases, threads) is carried over.

    Parameters
    ----------
    workers : int
        How many. More than cores gain nothing.
    """

    def __init__(self, workers: int) -> None:
        self._workers = workers

    def map(self, work: Callable[[J], R], jobs: Iterable[J]) -> Iterator[R]:
        """Results in the order of the jobs."""
        with started_safely():  # all of them start here; making the pool starts the first, which watches over what they share
            pool = ProcessPoolExecutor(self._workers, mp_context=get_context("spawn"))
            found = pool.map(work, jobs)
        with pool:
            yield from found


class Dask:
    """On a Dask cluster (extra ``fleet``).

    Its workers need this version of Abbe, its extra, and the database by the same URL. Whoever reaches its scheduler can run programs on
    it: keep it in a network of its own, or use TLS (``tls://``).

    Parameters
    ----------
    address : str
        Of the scheduler, e.g. ``tcp://127.0.0.1:8786``.

    Raises
    ------
    ConfigError
        The extra is not installed, or there is no scheduler.
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
            # pure=False: equal jobs asked for twice are computed twice, as elsewhere.
            for future in client.map(work, list(jobs), pure=False):
                yield future.result()
