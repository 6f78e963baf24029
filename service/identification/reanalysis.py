"""Many campaigns of a database solved anew, each as `abbe solve` does it, wherever it is computed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any

from abbe.models.solvers.joint import Model
from abbe.service.campaign_data.campaign_folder import from_store, keep
from abbe.service.domain.solution_file import SolutionFile
from abbe.service.errors import AbbeError
from abbe.service.identification.effect_removal import taken_out
from abbe.service.identification.executors import Executor
from abbe.service.identification.solve import solve_runs
from abbe.service.identification.solve_report import account, solution_doc
from abbe.service.identification.table_removal import table_then
from abbe.service.storage.store import Store

HEADINGS = ("campaign", "runs", "verdict", "what")


@dataclass(frozen=True, slots=True)
class ReanalysisTask:
    """One campaign to solve. Plain values: it goes to other processes and other computers."""

    url: str
    campaign: str
    model: Model


@dataclass(frozen=True, slots=True)
class Reanalysed:
    """What became of a task: the solution's document, or one line of why there is none."""

    campaign: str
    doc: dict[str, Any] | None
    refused: str = ""


def solve_task(task: ReanalysisTask) -> Reanalysed:
    """Read a campaign, solve it, return its document; nothing is written. What is refused is an answer, not an error: the others go on."""
    try:
        with Store.open(task.url) as store:
            measured = from_store(store, task.campaign)
            known = taken_out(store, measured, table_then(store, measured))
        solved = solve_runs(known.campaign.site, known.campaign.runs, model=task.model)
        doc = {"campaign": known.campaign.name, "machine": known.campaign.site.doc} | solution_doc(account(solved)) | known.doc
        return Reanalysed(task.campaign, doc)
    except AbbeError as error:
        return Reanalysed(task.campaign, None, f"{error.code}: {error}")


def tasks_of(store: Store, url: str, pattern: str, model: Model) -> list[ReanalysisTask]:
    """Every campaign whose name matches (``june-*``), in order of their numbers."""
    return [ReanalysisTask(url, one.name, model) for one in store.campaigns.all() if fnmatchcase(one.name, pattern)]


def solve_all(tasks: Sequence[ReanalysisTask], executor: Executor, store: Store | None = None) -> Iterator[Reanalysed]:
    """Solve; with a store given, keep each solution in it, from this process: the database has one writer.

    Raises
    ------
    StoreError
        A solution cannot be kept. Those before it are.
    """
    for answer in executor.map(solve_task, tasks):
        if store is None or answer.doc is None:
            yield answer
            continue
        yield Reanalysed(answer.campaign, answer.doc | keep(store, from_store(store, answer.campaign), answer.doc))


def row(answer: Reanalysed) -> tuple[str, str, str, str]:
    """Return the cells of `HEADINGS`."""
    if answer.doc is None:
        return (answer.campaign, "", "refused", answer.refused)
    solution = SolutionFile.read(answer.doc)
    word, text = ("", "") if solution.verdict is None else (solution.verdict.word, solution.verdict.text)
    return (answer.campaign, str(len(solution.inputs.runs)), word, text)
