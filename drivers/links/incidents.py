"""Trouble on a link as an account that a person can read: one entry when it is noticed, one when it is over, however often it is met."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from abbe.drivers.errors import NO_RUN, DriverError

_KEPT = 256


@dataclass(frozen=True, slots=True)
class Incident:
    """One entry.

    Parameters
    ----------
    kind : str
        ``detected`` or ``outcome``.
    code, device, run, text : str
        Of the first error of the trouble.
    host_s : float
        Monotonic host seconds.
    state : str
        Of an outcome: ``recovered`` (it answers again), ``accepted`` (somebody identified it anew), ``closed``.
    times : int
        Of an outcome: how many errors belonged to it.
    """

    kind: str
    code: str
    device: str
    run: str
    text: str
    host_s: float
    state: str = ""
    times: int = 1


class Incidents:
    """The latest incidents of one link, at most one of them open.

    Parameters
    ----------
    listen : callable, optional
        Is called with every entry; must not block or raise.

    Attributes
    ----------
    run : str
        The run that the link serves now. What no caller asked for (the heartbeat, a cable that is pulled) happens to it, too.
    """

    def __init__(self, listen: Callable[[Incident], None] | None = None) -> None:
        self.listen = listen
        self.run = NO_RUN
        self.entries: deque[Incident] = deque(maxlen=_KEPT)
        self._open: DriverError | None = None
        self._latched = False
        self._times = 0

    @property
    def open(self) -> DriverError | None:
        """The error that began the present trouble; None when there is none."""
        return self._open

    def note(self, error: DriverError, *, latched: bool = False) -> None:
        """Note an error as it goes to the caller or was overcome. Only the first of a trouble makes an entry.

        Parameters
        ----------
        latched : bool
            A good reply does not end this trouble (another device, a restart): somebody has to accept it.
        """
        if error.run == NO_RUN:
            error.run = self.run
        self._latched = self._latched or latched
        self._times += 1
        if self._open is None:
            self._open = error
            self._add("detected", error)

    def good(self) -> None:
        """A request was answered as it should be: what was not latched is over."""
        if not self._latched:
            self._end("recovered")

    def accepted(self) -> None:
        """Somebody identified the device anew: whatever it was is over."""
        self._end("accepted")

    def closed(self) -> None:
        """The link is closed: nothing more will come of it."""
        self._end("closed")

    def _end(self, state: str) -> None:
        if self._open is not None:
            self._add("outcome", self._open, state)
        self._open, self._latched, self._times = None, False, 0

    def _add(self, kind: str, error: DriverError, state: str = "") -> None:
        entry = Incident(kind, error.code, error.device, error.run, str(error), time.monotonic(), state, max(self._times, 1))
        self.entries.append(entry)
        if self.listen is not None:
            self.listen(entry)
