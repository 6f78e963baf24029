"""`abbe demo`: the whole process on a simulated machine, with a live display, a table, and a report."""

from __future__ import annotations

import tempfile
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from abbe.service.cli.common import JsonOption, conclude, print_json

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rich.console import Console

    from abbe.service.demo.demo import DemoResult

DEFAULT_FOLDER = "abbe-demo"


def demo(  # noqa: PLR0913 - one argument for each option
    seed: Annotated[int, typer.Option(help="Which simulated machine.")] = 1,
    speed: Annotated[float, typer.Option(min=1.0, max=200.0, help="Machine seconds per wall second.")] = 60.0,
    as_json: JsonOption = False,
    keep: Annotated[Path | None, typer.Option(help="Folder for database, machine file, tables and report.")] = None,
    hidden: Annotated[
        int | None,
        typer.Option(
            "--hidden", metavar="SEED", min=0, help="Find the hidden effect of this machine, if there is one.", show_default=False
        ),
    ] = None,
    artefact: Annotated[
        bool, typer.Option("--artefact", help="Measure and correct with the machine's own touch probe and a plate that nobody calibrated.")
    ] = False,
    serve: Annotated[bool, typer.Option("--serve", help="Let the service watch the machine, with its page, until Ctrl-C.")] = False,
    port: Annotated[int, typer.Option(help="Port of the page, with --serve; another one if it is taken.", min=0, max=65535)] = 8080,
) -> None:
    """Measure a simulated machine tool over real wires, correct it, and prove that it became better.

    With --serve: the service checks the machine by a timetable; the machine drifts, an alarm reports it, and a proposal waits in the page
    for a person; after approval the service pushes and verifies it. With --hidden: find the physical effect that the model of the
    machine lacks, prove it on a new measurement, and reveal the truth. With --artefact: the probe measures; the ball-bar only
    proves the sign of the tables.
    """
    if artefact:
        artefact_demo(seed, speed, as_json, keep)
        return
    if hidden is not None:
        hidden_demo(hidden, speed, as_json, keep)
        return
    from rich.console import Console

    from abbe.service.cli.running import display, run_job
    from abbe.service.demo.demo import run_demo
    from abbe.service.demo.demo_report import demo_json, demo_report
    from abbe.service.demo.demo_serve import run_served_demo
    from abbe.service.rendering.document_page import write_document

    folder = _folder(keep)

    if serve:
        with work_folder(folder, keep) as work:
            run_job(run_served_demo(seed, speed, work, port, typer.echo))
        return
    with display() as sink, work_folder(folder, keep) as work:
        result = run_job(run_demo(seed, speed, work, sink))
    report = folder / "report.html"
    write_document(demo_report(result), report)
    if as_json:
        print_json(demo_json(result))
    else:
        print_result(Console(), result)
    Console(stderr=True).print(f"report: {report}")
    conclude("abbe demo --hidden 4" if keep is None else f"abbe runs --db sqlite:///{folder / 'abbe.sqlite3'}", as_json=as_json)


def hidden_demo(seed: int, speed: float, as_json: bool, keep: Path | None) -> None:
    """Run a discovery; only the simulator knows the effect behind the seed."""
    from rich.console import Console

    from abbe.service.cli.running import display, run_job
    from abbe.service.demo.demo_hidden import hidden_json, run_hidden_demo, summary_lines
    from abbe.service.rendering.document_page import write_document
    from abbe.service.report.report_discovery import found_report

    folder = _folder(keep)
    with display() as sink, work_folder(folder, keep) as work:
        result = run_job(run_hidden_demo(["--hidden", str(seed)], speed, work, sink))
    report = folder / "discovery.html"
    assert result.job is not None
    assert result.journal is not None
    # The report leaves out the truth, which nobody knows of a real machine.
    write_document(found_report(result.job, result.journal, result.finding, result.started_utc), report)
    if as_json:
        print_json({"seed": seed, "speed": speed} | hidden_json(result))
    else:
        for line in summary_lines(result):
            typer.echo(line)
    Console(stderr=True).print(f"report: {report}")
    conclude("abbe demo --serve" if keep is None else f"abbe runs --db sqlite:///{folder / 'abbe.sqlite3'}", as_json=as_json)


def artefact_demo(seed: int, speed: float, as_json: bool, keep: Path | None) -> None:
    """Measure a plate in several poses, correct its plane, and verify in another pose."""
    from rich.console import Console

    from abbe.service.cli.running import display, run_job
    from abbe.service.demo.demo_artefact import artefact_json, artefact_report, run_artefact_demo, summary_lines
    from abbe.service.rendering.document_page import write_document

    folder = _folder(keep)
    with display() as sink, work_folder(folder, keep) as work:
        result = run_job(run_artefact_demo(seed, speed, work, sink))
    report = folder / "artefact.html"
    write_document(artefact_report(result), report)
    if as_json:
        print_json(artefact_json(result))
    else:
        for line in summary_lines(result):
            typer.echo(line)
    Console(stderr=True).print(f"report: {report}")
    conclude("abbe demo" if keep is None else f"abbe runs --db sqlite:///{folder / 'abbe.sqlite3'}", as_json=as_json)


def _folder(keep: Path | None) -> Path:
    """Create the folder of the report.

    Raises
    ------
    ConfigError
        It cannot be created.
    """
    from abbe.service.errors import ConfigError

    folder = keep or Path(DEFAULT_FOLDER)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        why = "it is not a folder" if isinstance(error, FileExistsError | NotADirectoryError) else error.strerror
        raise ConfigError(f"{folder} cannot hold the demonstration: {why}", "name another folder with --keep") from None
    return folder


@contextmanager
def work_folder(folder: Path, keep: Path | None) -> Iterator[Path]:
    """Yield the folder for database and device links: ``folder``, which must hold no other demonstration; without ``keep`` a temporary
    one."""
    if keep is None:
        with tempfile.TemporaryDirectory(prefix="abbe-") as name:
            yield Path(name)
        return
    from abbe.service.errors import AbbeError

    if (folder / "abbe.sqlite3").exists():
        raise AbbeError(f"{folder} already holds a demonstration", "name another folder with --keep, or delete it")
    yield folder.resolve()


def print_result(out: Console, result: DemoResult) -> None:
    """Print before and after as a table, then the verdict."""
    from rich.table import Table

    from abbe.service.demo.demo_report import DIAGONALS_TOLD, summary_rows, table_factor

    table = Table(title=f"Simulated machine {result.seed}: before and after")
    for name in ("figure", "before", "after", "factor", "source"):
        table.add_column(name, justify="left" if name in ("figure", "source") else "right")
    for row in summary_rows(result):
        u0 = f" ± {2 * row.u_before:.1f}" if row.u_before is not None else ""
        u1 = f" ± {2 * row.u_after:.1f}" if row.u_after is not None else ""
        table.add_row(
            row.name, f"{row.before:.1f}{u0} {row.unit}", f"{row.after:.1f}{u1} {row.unit}", f"{row.factor or 0:.1f}x", row.source
        )
    out.print(table)
    best, share = result.truths[0].best_nine_tables_rms_um, 100 * table_factor(result).share
    out.print(DIAGONALS_TOLD)
    out.print(f"nine perfect one-axis tables would leave {best:.1f} µm rms; {share:.0f} % of their improvement factor was reached")
    decision = result.corrected.decision
    out.print(("kept: " if decision.keep else "rolled back: ") + decision.text)
