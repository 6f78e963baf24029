"""Solve many campaigns of a database again, each as `abbe solve` does, on any executor."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from multiprocessing import get_context
from typing import Any, Protocol, TypeVar

from abbe.models.solvers.joint import Model
from abbe.service.campaign_data.campaign_folder import from_store, store_solution
from abbe.service.children import started_safely
from abbe.service.domain.solution_file import SolutionFile
from abbe.service.errors import AbbeError, ConfigError
from abbe.service.identification.removal import campaign_table, remove_effects
from abbe.service.identification.solve import solve_runs
from abbe.service.identification.solve_report import assess, solution_doc
from abbe.service.storage.store import Store

J = TypeVar("J")
R = TypeVar("R")


class Executor(Protocol):
    """Runs jobs. Other processes receive them: ``work`` must be a function of a module, jobs and results must be plain values."""

    def map(self, work: Callable[[J], R], jobs: Iterable[J]) -> Iterator[R]:
        """Return the results in the order of the jobs. The error of a job is raised in place of its result."""
        ...


class SerialExecutor:
    """Runs jobs one after the other in this process."""

    def map(self, work: Callable[[J], R], jobs: Iterable[J]) -> Iterator[R]:
        """Return the results in the order of the jobs."""
        return map(work, jobs)


class ProcessExecutor:
    """Runs jobs in ``workers`` new processes of this computer, which inherit neither open databases nor threads."""

    def __init__(self, workers: int) -> None:
        self._workers = workers

    def map(self, work: Callable[[J], R], jobs: Iterable[J]) -> Iterator[R]:
        """Return the results in the order of the jobs."""
        with started_safely():  # all processes start here; creating the pool starts the resource tracker
            pool = ProcessPoolExecutor(self._workers, mp_context=get_context("spawn"))
            found = pool.map(work, jobs)
        with pool:
            yield from found


class DaskExecutor:
    """Runs jobs on a Dask cluster (extra ``fleet``); ``address``: address of its scheduler, e.g. ``tcp://127.0.0.1:8786``.

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
                f"no Dask scheduler answers at {address}: {type(err).__name__}", "start `dask scheduler`, then `dask worker ADDRESS`"
            ) from None

    def map(self, work: Callable[[J], R], jobs: Iterable[J]) -> Iterator[R]:
        """Return the results in the order of the jobs."""
        with closing(self._client) as client:
            # pure=False: Dask computes equal jobs again, like the other executors.
            for future in client.map(work, list(jobs), pure=False):
                yield future.result()


HEADINGS = ("campaign", "runs", "verdict", "what")


@dataclass(frozen=True, slots=True)
class ReanalysisTask:
    """One campaign to solve, as plain values for other processes and computers."""

    url: str
    campaign: str
    model: Model


@dataclass(frozen=True, slots=True)
class ReanalysisResult:
    """Result of a task: the solution's document, or one line with the reason for its refusal."""

    campaign: str
    doc: dict[str, Any] | None
    refused: str = ""


def solve_task(task: ReanalysisTask) -> ReanalysisResult:
    """Read and solve a campaign without writing anything. A refusal is a result, not an error, so that the other tasks continue."""
    try:
        with Store.open(task.url) as store:
            measured = from_store(store, task.campaign)
            known = remove_effects(store, measured, campaign_table(store, measured))
        tools = known.campaign.doc.get("instruments")
        solved = solve_runs(known.campaign.site, known.campaign.runs, model=task.model, instruments=tools)
        found = assess(solved, unknown_table=bool(known.not_removed))
        doc = {"campaign": known.campaign.name, "machine": known.campaign.site.doc} | solution_doc(found) | known.doc
        return ReanalysisResult(task.campaign, doc)
    except AbbeError as error:
        return ReanalysisResult(task.campaign, None, f"{error.code}: {error}")


def tasks_of(store: Store, url: str, pattern: str, model: Model) -> list[ReanalysisTask]:
    """Return one task for each campaign whose name matches the pattern (``june-*``), in order of their numbers."""
    return [ReanalysisTask(url, name, model) for name in store.campaigns.matching(pattern)]


def solve_all(tasks: Sequence[ReanalysisTask], executor: Executor, store: Store | None = None) -> Iterator[ReanalysisResult]:
    """Solve all tasks. With a store, this process writes each solution to it: the database has one writer.

    Raises
    ------
    StoreError
        A solution cannot be written. The earlier ones are stored.
    """
    for answer in executor.map(solve_task, tasks):
        if store is None or answer.doc is None:
            yield answer
            continue
        yield ReanalysisResult(answer.campaign, answer.doc | store_solution(store, from_store(store, answer.campaign), answer.doc))


def row(answer: ReanalysisResult) -> tuple[str, str, str, str]:
    """Return the cells of one result under `HEADINGS`."""
    if answer.doc is None:
        return (answer.campaign, "", "refused", answer.refused)
    solution = SolutionFile.read(answer.doc)
    word, text = ("", "") if solution.verdict is None else (solution.verdict.word, solution.verdict.text)
    return (answer.campaign, str(len(solution.inputs.runs)), word, text)
