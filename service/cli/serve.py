"""``abbe serve MACHINE.toml``: the unattended service. Everything heavy is imported when it is run, not when ``--help`` is asked for."""

from __future__ import annotations

import logging
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from service.config import Loaded
    from service.events import ProgressSink
    from service.scheduler.ports import Check, CheckResult
    from service.scheduler.slots import Schedule
    from service.scheduler.store import ServiceStore
    from service.serve import Setup
    from service.site import Site


def serve(
    machine: Annotated[Path, typer.Argument(metavar="MACHINE.toml", help="Machine file.")],
    port: Annotated[int | None, typer.Option(help="Port of the status page, instead of [web] port; 0: any.", min=0, max=65535)] = None,
    once: Annotated[
        bool, typer.Option("--once", help="Run every recipe of the timetable once, now, and end; exit code 1 unless all pass.")
    ] = False,
) -> None:
    """Run scheduled checks unattended, publish results, show a status page. Ends on Ctrl-C or SIGTERM."""
    from service.config import load_machine
    from service.serve import serve as run

    setup = setup_of(load_machine(machine), port)
    configure_logs()
    raise typer.Exit(run(setup, once=once))


def setup_of(loaded: Loaded, port: int | None = None) -> Setup:
    """Return what the service is to do.

    Parameters
    ----------
    loaded : Loaded
        The machine file.
    port : int, optional
        Instead of the file's.

    Raises
    ------
    AbbeError
        A schedule names no recipe, or its paths leave the machine's strokes: better now than at the first slot, at night.
    """
    from service.mqtt.broker import parse
    from service.mqtt.topics import Topics
    from service.scheduler.ready import Ready, look_at
    from service.scheduler.timetable import schedules_of, windows_of
    from service.serve import Setup
    from service.site import site_of
    from service.workflows.check import run_check

    config = loaded.machine
    site = site_of(config)

    def check_on(store: ServiceStore) -> Check:
        async def check(recipe: str, progress: ProgressSink) -> CheckResult:
            return await run_check(config, store, recipe, progress)

        return check

    return Setup(
        machine=config.name,
        doc=site.doc,
        devices={role: url for role, url in config.devices.model_dump().items() if url is not None},
        schedules=_measurable(schedules_of(config), site),
        store_url=loaded.database_url,
        broker=None if config.mqtt.url is None else parse(config.mqtt.url),
        topics=Topics(config.mqtt.topic_prefix, config.name),
        host=config.web.host,
        port=config.web.port if port is None else port,
        check=check_on,
        maintenance=windows_of(config.maintenance),
        ready=lambda clock: Ready(look_at(site.urls), schedules_of(config), site.temperature_c, windows_of(config.staffed), clock),
        names=tuple(config.web.names),
        certificate=_beside(loaded.path, config.web.certificate),
        key=_beside(loaded.path, config.web.key),
    )


def _beside(machine_file: Path, name: str) -> str:
    """A file of the machine file's folder, or an absolute one; empty stays empty."""
    return str(machine_file.resolve().parent / name) if name else ""


def _measurable(schedules: tuple[Schedule, ...], site: Site) -> tuple[Schedule, ...]:
    from service.sequences.check import dry_run_campaign
    from service.workflows.check import recipe_plan

    for schedule in schedules:
        dry_run_campaign(site.machine, recipe_plan(schedule.recipe, site.machine), site.max_feed_mm_min)
    return schedules


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
