"""Run a job that moves axes: any signal that ends this process first cancels the job, so that the axes stop."""

from __future__ import annotations

import asyncio
import errno
import signal
import sys
from collections.abc import Callable, Coroutine, Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Any, TypeVar

from abbe.service.errors import Stopped
from abbe.service.sequences.control import Control

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
        Of a measurement: the first Ctrl-C only asks it to stop at a safe place, and SIGUSR1 pauses or resumes it.

    Raises
    ------
    SystemExit
        After a signal, with 128 + its number: 130 Ctrl-C, 143 SIGTERM, 129 terminal closed.
    """
    received: list[int] = []
    results: list[T] = []

    async def work() -> None:
        # Not returned: at its end asyncio formats the main task with its result, which takes seconds for a solution.
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


async def _cancelled_by_signal(job: Coroutine[Any, Any, T], received: list[int], control: Control | None) -> T:
    loop, task = asyncio.get_running_loop(), asyncio.current_task()
    assert task is not None

    def stop(number: int, _frame: FrameType | None) -> None:
        # A second signal cancels once more: what must reach the machine is shielded from it (abbe.drivers.links.shielded).
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
            continue  # started with nohup: it must survive the terminal
        before[number] = signal.signal(number, stop)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
