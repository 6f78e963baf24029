"""A thread that only reads bytes from a descriptor into a bounded ring, so that the kernel's small buffer does not overflow because of a
busy loop, disk or solver.

Bytes that do not fit into the ring are counted and reported as lost; ``Ring.on_mark`` warns before that.
"""

from __future__ import annotations

import os
import select
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass

MARKS = (0.5, 0.8, 1.0)
"""Fill levels: warning, stop of the machine, loss of data."""
_READ_BYTES = 65536
_STOP_S = 2.0


@dataclass(frozen=True, slots=True)
class ReadPiece:
    """Bytes that arrived together. ``lost_before``: number of bytes lost just before them for lack of room."""

    host_s: float
    data: bytes
    lost_before: int = 0


class Ring:
    """A thread-safe FIFO of at most ``capacity`` bytes, for one thread that puts and one that takes."""

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self.lost_bytes = 0
        self.highest = 0.0
        self.on_mark: Callable[[float], None] = lambda mark: None
        """Called in the reading thread when the fill rises to a mark of ``MARKS``; again only after the fill was below 0.25."""
        self._pieces: deque[ReadPiece] = deque()
        self._bytes = 0
        self._lost = 0
        self._last_mark = 0.0
        self._ended = self._idle = False
        self._news = threading.Condition()

    @property
    def fill(self) -> float:
        """Fill of the ring, 0 to 1."""
        return self._bytes / self.capacity

    def put(self, host_s: float, data: bytes) -> None:
        """Append bytes that arrived at monotonic ``host_s``; count them as lost if they do not fit."""
        with self._news:
            if self._bytes + len(data) > self.capacity:
                self._lost += len(data)
                self.lost_bytes += len(data)
                fill = 1.0
            else:
                self._pieces.append(ReadPiece(host_s, data, self._lost))
                self._lost = 0
                self._bytes += len(data)
                fill = self._bytes / self.capacity
                self._news.notify_all()
            self.highest = max(self.highest, fill)
            marks = [mark for mark in MARKS if self._last_mark < mark <= fill]
            self._last_mark = fill if marks else (0.0 if fill < MARKS[0] / 2 else self._last_mark)
        for mark in marks:
            self.on_mark(mark)

    def take(self, timeout_s: float) -> list[ReadPiece] | None:
        """Wait for bytes and return the oldest pieces, about 64 KiB at most; an empty list after ``timeout_s``, None after the end."""
        with self._news:
            if not self._pieces:
                self._idle = True  # the taker returns only after processing what it took before
                self._news.notify_all()
                if not self._ended:
                    self._news.wait(timeout_s)
            self._idle = self._ended and not self._pieces
            pieces: list[ReadPiece] = []
            size = 0
            while self._pieces and size < _READ_BYTES:  # never all of a full ring: taken bytes no longer count towards its fill
                pieces.append(self._pieces.popleft())
                size += len(pieces[-1].data)
            self._bytes -= size
            return pieces if pieces or not self._ended else None

    def drained(self, timeout_s: float) -> bool:
        """Wait until everything put so far is taken and processed; return False on timeout."""
        with self._news:
            return self._news.wait_for(lambda: self._idle and not self._pieces, timeout_s)

    def end(self) -> None:
        """Mark the end: no more puts."""
        with self._news:
            self._ended = True
            self._news.notify_all()


class ReadingThread:
    """Reads a descriptor into a ring until it is stopped or the device is lost. It neither parses nor logs nor waits.

    Parameters
    ----------
    descriptor : int
        Non-blocking; duplicated here, so that its number stays valid while the thread lives.
    ring : Ring
        Destination of the bytes; it ends with the thread.
    lost : callable
        Called in the thread with the reason (None: end of file) when the device is lost, but not after a stop.

    Raises
    ------
    OSError, RuntimeError
        No more descriptors or threads; nothing stays open.
    """

    def __init__(self, descriptor: int, ring: Ring, lost: Callable[[OSError | None], None], name: str) -> None:
        self._ring = ring
        self._lost = lost
        self._thread = threading.Thread(target=self._run, name=f"read {name}", daemon=True)
        with ExitStack() as undo:
            self._descriptor = os.dup(descriptor)
            undo.callback(os.close, self._descriptor)
            self._wake_read, self._wake_write = os.pipe()
            undo.callback(os.close, self._wake_read)
            undo.callback(os.close, self._wake_write)
            self._thread.start()
            undo.pop_all()

    def stop(self) -> None:
        """End the thread and wait for it (milliseconds); stopping twice does nothing."""
        if self._wake_write < 0:
            return
        os.close(self._wake_write)  # the other end becomes readable
        self._wake_write = -1
        if self._thread is not threading.current_thread():
            self._thread.join(_STOP_S)

    def _run(self) -> None:
        try:
            gone, error = self._read_all()
        except Exception as defect:  # noqa: BLE001 - a silent end of the thread would look like a silent device
            gone, error = True, OSError(f"the reading thread failed: {defect!r}")
        finally:
            self._ring.end()
            os.close(self._descriptor)
            os.close(self._wake_read)
        if gone:
            self._lost(error)

    def _read_all(self) -> tuple[bool, OSError | None]:
        poll = select.poll()
        poll.register(self._descriptor, select.POLLIN)
        poll.register(self._wake_read, select.POLLIN)
        empty = 0
        while True:
            ready = poll.poll()
            if any(number == self._wake_read for number, _ in ready):
                self._read_rest()
                return False, None
            try:
                data = os.read(self._descriptor, _READ_BYTES)
            except BlockingIOError:
                continue
            except OSError as error:
                return True, error
            if data:
                empty = 0
                self._ring.put(time.monotonic(), data)
                continue
            empty += 1  # a flushed line reads as empty once, a lost one repeatedly
            if empty > 1:
                return True, None

    def _read_rest(self) -> None:
        """Read the bytes that the kernel still holds when the line closes: they may be the end of a run."""
        left = self._ring.capacity
        with suppress(OSError):
            while left > 0 and (data := os.read(self._descriptor, _READ_BYTES)):
                self._ring.put(time.monotonic(), data)
                left -= len(data)
