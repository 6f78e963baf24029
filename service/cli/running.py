"""Run a job at the console: signals that stop the axes first, the display of progress, questions, and the wait for a safe machine."""

from __future__ import annotations

import asyncio
import errno
import os
import signal
import sys
from collections.abc import Callable, Coroutine, Iterator
from contextlib import asynccontextmanager, contextmanager, suppress
from importlib import import_module
from types import FrameType
from typing import TYPE_CHECKING, Any, TypeVar

import typer

from abbe.service.errors import ConfigError, Stopped
from abbe.service.sequences.control import Control

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator

    from abbe.service.devices.session import Ask, Session
    from abbe.service.domain.progress import Progress, ProgressSink
    from abbe.service.site import Site
    from abbe.service.storage.store import Store


ENDING = ("SIGINT", "SIGTERM", "SIGHUP")
T = TypeVar("T")
Handler = Callable[[int, FrameType | None], None]


def run_job(job: Coroutine[Any, Any, T], control: Control | None = None) -> T:
    """Run a job to its end; Ctrl-C, SIGTERM and a closed terminal cancel it, and its clean-up runs before the process ends.

    Parameters
    ----------
    job : coroutine
        Stops the axes by its own motion guards and clean-up.
    control : Control, optional
        Control of a measurement. With it, the first Ctrl-C only asks for a stop at a safe place, and SIGUSR1 pauses or resumes.

    Raises
    ------
    SystemExit
        After a signal, with 128 + its number: 130 Ctrl-C, 143 SIGTERM, 129 terminal closed.
    """
    received: list[int] = []
    results: list[T] = []

    async def work() -> None:
        # Not returned: asyncio would format the main task's result at the end, which takes seconds for a solution.
        results.append(await _cancelled_by_signal(job, received, control))

    try:
        asyncio.run(work())
        return results[0]
    except Stopped as error:
        if not received:
            raise
        with suppress(OSError):
            sys.stderr.write(f"stopped: {error.remedy}\n")
        raise SystemExit(128 + received[0]) from None
    except (asyncio.CancelledError, OSError) as error:
        # A closed terminal also fails the display's last output with EIO; a device's error (some are OSErrors) must not get lost.
        if not received or (isinstance(error, OSError) and error.errno != errno.EIO):
            raise
        with suppress(OSError):  # the terminal may be gone
            for text in getattr(error, "__notes__", []):
                sys.stderr.write(f"stopped: {text}\n")
        raise SystemExit(128 + received[0]) from None


async def loaded_beside(*modules: str) -> None:
    """Import modules in another thread, while open links go on: for what a command needs only once the devices have answered."""
    for name in modules:
        await asyncio.to_thread(import_module, name)


async def _cancelled_by_signal(job: Coroutine[Any, Any, T], received: list[int], control: Control | None) -> T:
    loop, task = asyncio.get_running_loop(), asyncio.current_task()
    assert task is not None

    def stop(number: int, _frame: FrameType | None) -> None:
        # A second signal cancels again; `abbe.drivers.errors.run_to_end` shields commands that must reach the machine.
        received.append(number)
        gently = control is not None and number == signal.SIGINT and len(received) == 1
        if control is not None:  # code that mistakes the cancellation for something else still sees the request
            loop.call_soon_threadsafe(control.stop if gently else control.abort)
        if not gently:
            loop.call_soon_threadsafe(task.cancel)

    def toggle(_number: int, _frame: FrameType | None) -> None:
        if control is not None:
            loop.call_soon_threadsafe(control.resume if control.pausing else control.pause)

    with _handled(stop, ENDING), _handled(toggle, ("SIGUSR1",) if control is not None else ()):
        return await job


@contextmanager
def _handled(stop: Handler, names: tuple[str, ...]) -> Iterator[None]:
    before: dict[int, Any] = {}
    for name in names:
        number = getattr(signal, name, None)  # Windows has no SIGHUP
        if number is None or (name == "SIGHUP" and signal.getsignal(number) is signal.SIG_IGN):
            continue  # started with nohup: the process must survive the terminal
        before[number] = signal.signal(number, stop)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def display() -> Iterator[ProgressSink]:
    """Yield a sink for progress: a bar with ETA on a terminal, one line for each run or step elsewhere."""
    from rich.console import Console

    log = Console(stderr=True)
    if not log.is_terminal:
        last = ["", ""]

        def plain(p: Progress) -> None:
            waits = _waits(p)
            if (step := f"{p.stage}: {p.message}") != last[0]:
                last[0] = step
                share = f" ({p.done / p.total:.0%} done)" if p.done > 0.0 and p.total > 0.0 else ""
                log.print(step + share, highlight=False, markup=False)
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
    """Return the reason why a measurement waits; empty while it runs."""
    return f"{p.state}: {p.why}" if p.state in ("paused", "suspended") else ""


@asynccontextmanager
async def rollback_when_safe(session: Session, store: Store, site: Site, wait_s: float) -> AsyncIterator[None]:
    """If a job ends in `StillActive`, wait at the console and roll back as soon as that is safe (exit code 1).

    Without a console, or with ``wait_s`` 0, the error is raised: the next start of any command rolls back first. Ctrl-C ends the wait with
    the same consequence.
    """
    from abbe.service.clock import SystemClock
    from abbe.service.compensation.recover import finish_when_safe
    from abbe.service.errors import StillActive

    try:
        yield
    except StillActive as error:
        if wait_s <= 0.0 or not sys.stdin.isatty():
            raise
        notes = list(getattr(error, "__notes__", []))
        print_line("; ".join([str(error), *notes]) + "\a")
        print_line("make the machine ready: Abbe restores the old table as soon as that is safe; Ctrl-C ends the wait")
        try:
            done = await finish_when_safe(session.controller, store, site, limit_s=wait_s, clock=SystemClock(), notify=print_line)
        except asyncio.CancelledError as ended:
            ended.add_note("the unverified table is STILL ACTIVE; the next abbe command rolls it back before anything else")
            raise
        except Exception as ended:
            for note in (*notes, "the unverified table may still be active; the next abbe command rolls it back before anything else"):
                ended.add_note(note)
            raise
        print_line(f"rolled back: {done or 'nothing was left to roll back'}")
        for note in notes:  # cup and bar may still be mounted
            print_line(note)
        raise typer.Exit(1) from None


def print_line(text: str) -> None:
    """Print one line on stderr."""
    typer.echo(text, err=True)


async def console_ask(text: str) -> None:
    """Print what to do and wait for Enter. Input typed before the question is discarded: people confirm only what they have read.

    Raises
    ------
    ConfigError
        No person is at the console (standard input is closed or not a terminal).
    """
    import termios  # here: a platform without termios still plans and reads

    if not sys.stdin.isatty():
        raise ConfigError(
            f"no one is at the console, but a person has to act: {text}", "run this from a terminal, or configure a remote fixture"
        )
    # The descriptor itself: Python's buffer would keep a pasted second line for the next question, out of reach of tcflush.
    line = sys.stdin.fileno()
    termios.tcflush(line, termios.TCIFLUSH)
    sys.stderr.write(f"\n>> {text}\n   press Enter when done: ")
    sys.stderr.flush()
    if await _entered(line) == b"":
        raise ConfigError("standard input was closed", "start again from a terminal")


def person_at_console() -> Ask:
    """Return the function that asks a person: `console_ask` at a terminal, else `no_console`, which refuses before anything moves."""
    from abbe.service.devices.session import no_console

    return console_ask if sys.stdin is not None and sys.stdin.isatty() else no_console


async def _entered(line: int) -> bytes:
    """Return what is typed up to Enter; empty when the terminal is gone."""
    loop = asyncio.get_running_loop()
    entered: asyncio.Future[bytes] = loop.create_future()

    def ready() -> None:
        if entered.done():
            return
        try:
            entered.set_result(os.read(line, 4096))
        except OSError:
            entered.set_result(b"")  # the terminal is gone

    loop.add_reader(line, ready)
    try:
        return await entered
    finally:
        loop.remove_reader(line)


async def console_confirm(text: str) -> bool:
    """Ask a yes/no question; the answer is no if no one is at the console."""
    import termios

    if not sys.stdin.isatty():
        return False
    line = sys.stdin.fileno()
    termios.tcflush(line, termios.TCIFLUSH)
    sys.stderr.write(f"\n>> {text}\n   type yes, or press Enter for no: ")
    sys.stderr.flush()
    return (await _entered(line)).strip().lower() in (b"y", b"yes")
