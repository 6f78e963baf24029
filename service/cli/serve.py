"""``abbe serve MACHINE.toml``: the unattended service. Everything heavy is imported when it is run, not when ``--help`` is asked for."""

from __future__ import annotations

import logging
import sys
from pathlib import Path
from typing import Annotated

import typer

PROBLEM = 2


def serve(
    machine: Annotated[Path, typer.Argument(help="Machine file (TOML).")],
    port: Annotated[int | None, typer.Option(help="Port of the status page, instead of [web] port.", min=0, max=65535)] = None,
    once: Annotated[
        bool, typer.Option("--once", help="Run every recipe of the timetable once, now, and end: exit code 1 unless all pass.")
    ] = False,
) -> None:
    """Run scheduled checks unattended, publish their results, show a status page. Ends on Ctrl-C or SIGTERM."""
    from service.errors import AbbeError
    from service.serve import serve as run

    configure_logs()
    try:
        code = run(_setup(machine, port), once=once)
    except AbbeError as problem:
        typer.echo(f"abbe serve: {problem} [{problem.code}]", err=True)
        raise typer.Exit(PROBLEM) from problem
    raise typer.Exit(code)


def _setup(machine: Path, port: int | None) -> object:
    raise NotImplementedError


def configure_logs() -> None:
    """Log to stderr: one JSON object a line for machines, readable lines in a terminal."""
    import structlog

    terminal = sys.stderr.isatty()
    shared: list[structlog.typing.Processor] = [
        structlog.contextvars.merge_contextvars,
        structlog.stdlib.add_log_level,
        structlog.stdlib.add_logger_name,
        structlog.processors.TimeStamper(fmt="iso", utc=True),
    ]
    structlog.configure(
        processors=[*shared, structlog.stdlib.ProcessorFormatter.wrap_for_formatter],
        logger_factory=structlog.stdlib.LoggerFactory(),
        wrapper_class=structlog.stdlib.BoundLogger,
        cache_logger_on_first_use=True,
    )
    last: list[structlog.typing.Processor] = [structlog.stdlib.ProcessorFormatter.remove_processors_meta]
    if terminal:
        last.append(structlog.dev.ConsoleRenderer())
    else:
        last += [structlog.processors.format_exc_info, structlog.processors.JSONRenderer(ensure_ascii=False)]
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(structlog.stdlib.ProcessorFormatter(foreign_pre_chain=shared, processors=last))
    logging.basicConfig(handlers=[handler], level=logging.INFO, force=True)
    # Libraries that have something to say at each request or each lost connection: we say it ourselves, once.
    for name, level in (
        ("mqtt", logging.CRITICAL),
        ("uvicorn", logging.WARNING),
        ("asyncio", logging.WARNING),
        ("alembic", logging.WARNING),
    ):
        logging.getLogger(name).setLevel(level)
