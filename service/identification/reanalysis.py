"""Solve many campaigns of a database again, each as `abbe solve` does, on any executor."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any

from abbe.models.solvers.joint import Model
from abbe.service.campaign_data.campaign_folder import from_store, store_solution
from abbe.service.domain.solution_file import SolutionFile
from abbe.service.errors import AbbeError
from abbe.service.identification.effect_removal import remove_effects
from abbe.service.identification.executors import Executor
from abbe.service.identification.solve import solve_runs
from abbe.service.identification.solve_report import assess, solution_doc
from abbe.service.identification.table_removal import campaign_table
from abbe.service.storage.store import Store

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
        solved = solve_runs(known.campaign.site, known.campaign.runs, model=task.model)
        doc = {"campaign": known.campaign.name, "machine": known.campaign.site.doc} | solution_doc(assess(solved)) | known.doc
        return ReanalysisResult(task.campaign, doc)
    except AbbeError as error:
        return ReanalysisResult(task.campaign, None, f"{error.code}: {error}")


def tasks_of(store: Store, url: str, pattern: str, model: Model) -> list[ReanalysisTask]:
    """One task for each campaign whose name matches the pattern (``june-*``), in order of their numbers."""
    return [ReanalysisTask(url, one.name, model) for one in store.campaigns.all() if fnmatchcase(one.name, pattern)]


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
    """Cells of `HEADINGS`."""
    if answer.doc is None:
        return (answer.campaign, "", "refused", answer.refused)
    solution = SolutionFile.read(answer.doc)
    word, text = ("", "") if solution.verdict is None else (solution.verdict.word, solution.verdict.text)
    return (answer.campaign, str(len(solution.inputs.runs)), word, text)
