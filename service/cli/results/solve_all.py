"""`abbe solve-all`: solve many campaigns again, here, in processes, or on a Dask cluster."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from abbe.service.cli.common import JsonOption, MachineOption, print_json, print_table
from abbe.service.cli.results.solve import ModelName

if TYPE_CHECKING:
    from abbe.service.identification.executors import Executor


def solve_all(  # noqa: PLR0913 - every one of them is an option of the command
    pattern: Annotated[str, typer.Argument(metavar="PATTERN", help="Campaigns by name, e.g. 'june-*'.")] = "*",
    model: Annotated[ModelName, typer.Option("--model", help="As for abbe solve.")] = ModelName.rigid21,
    workers: Annotated[int, typer.Option("--workers", min=1, max=256, help="Processes of this computer.")] = 1,
    dask: Annotated[
        str | None, typer.Option("--dask", metavar="ADDRESS", help="Scheduler of a Dask cluster instead.", show_default=False)
    ] = None,
    store_solutions: Annotated[bool, typer.Option("--keep", help="Store each solution.")] = False,
    db: Annotated[str | None, typer.Option("--store", "--db", metavar="URL", help="Database.", show_default=False)] = None,
    machine: MachineOption = None,
    as_json: JsonOption = False,
) -> None:
    """Solve many campaigns of a database again, each exactly as abbe solve does; exit code 1 if one was refused."""
    from abbe.service.cli.common import database_url, open_store
    from abbe.service.errors import NotStored
    from abbe.service.identification.reanalysis import HEADINGS, row, tasks_of
    from abbe.service.identification.reanalysis import solve_all as run

    url = database_url(db, machine)
    with open_store(url) as store:
        tasks = tasks_of(store, url, pattern, model.value)
        if not tasks:
            raise NotStored(f"no campaign matches {pattern!r} in {store.url}", "`abbe runs` lists what there is")
        answers = list(run(tasks, _executor(workers, dask), store if store_solutions else None))
    if as_json:
        print_json([answer.doc or {"campaign": answer.campaign, "refused": answer.refused} for answer in answers])
    else:
        print_table(HEADINGS, [row(answer) for answer in answers])
    raise typer.Exit(1 if any(answer.doc is None for answer in answers) else 0)


def _executor(workers: int, dask: str | None) -> Executor:
    from abbe.service.errors import ConfigError
    from abbe.service.identification.executors import DaskExecutor, ProcessExecutor, SerialExecutor

    if dask is None:
        return SerialExecutor() if workers == 1 else ProcessExecutor(workers)
    if workers != 1:
        raise ConfigError("--workers and --dask both say where to compute", "give one of them")
    return DaskExecutor(dask)
