"""Progress display: with ETA on a terminal, one line per stage elsewhere."""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Iterator

    from abbe.service.domain.progress import Progress, ProgressSink


@contextmanager
def display() -> Iterator[ProgressSink]:
    """Yield a sink for progress: a bar with ETA on a terminal, one line per stage elsewhere."""
    from rich.console import Console

    log = Console(stderr=True)
    if not log.is_terminal:
        last = ["", ""]

        def plain(p: Progress) -> None:
            waits = _waits(p)
            if p.stage != last[0]:
                last[0] = p.stage
                log.print(f"{p.stage}: {p.message}", highlight=False)
            if waits and waits != last[1]:
                log.print(f"{p.stage}: {waits}", highlight=False)
            last[1] = waits

        yield plain
        return
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bars

    columns: tuple[Any, ...] = (
        TextColumn("{task.fields[stage]:<14}"),
        BarColumn(),
        TextColumn("{task.fields[eta]:>9}"),
        TimeElapsedColumn(),
    )
    with Bars(*columns, TextColumn("{task.description}"), console=log) as bars:
        tasks: dict[str, Any] = {}

        def live(p: Progress) -> None:
            if p.stage not in tasks:
                tasks[p.stage] = bars.add_task(p.message, stage=p.stage, eta="", total=p.total)
            eta = "" if p.eta_s is None else f"{p.eta_s:.0f} s left"
            bars.update(tasks[p.stage], completed=p.done, description=_waits(p) or p.message, eta=eta)

        yield live


def _waits(p: Progress) -> str:
    """Return what a measurement waits for; empty while it runs."""
    return f"{p.state}: {p.why}" if p.state in ("paused", "suspended") else ""
