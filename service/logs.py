"""Logging of the service's processes to stderr: readable lines in a terminal, otherwise JSON with one object per line."""

from __future__ import annotations

import logging
import sys

import structlog


def configure_logs(*, as_json: bool = False) -> None:
    """Log to stderr: readable lines in a terminal; otherwise, and always with ``as_json``, JSON with one object per line."""
    terminal = sys.stderr.isatty() and not as_json
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
    # These libraries log each request or each lost connection; the service logs that once itself.
    for name, level in (
        ("mqtt", logging.CRITICAL),
        ("asyncua", logging.CRITICAL),
        ("uvicorn", logging.WARNING),
        ("asyncio", logging.WARNING),
        ("alembic", logging.WARNING),
    ):
        logging.getLogger(name).setLevel(level)
