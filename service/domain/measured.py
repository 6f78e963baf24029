"""Stored measurements: machines, campaigns, runs and their samples, and the process that writes a run. One record is one row.

The identity of a process is unique even across restarts of process and computer: the operating system reuses pids, hence the start time;
start times count from boot, hence the boot id.
"""

from __future__ import annotations

import os
import platform
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

from abbe.service.domain.document import Doc, DocumentRow, HistoryRow
from abbe.service.domain.run_start import RunEnd, RunStart
from abbe.service.errors import StoreError

UNKNOWN = "?"
"""Start time of a living process if the system does not show it; only its pid identifies such a process."""
_START_TIME_FIELD = 22 - 3
"""Field 22 of /proc/PID/stat, counted after the command name (field 2), which may itself hold blanks."""


@dataclass(frozen=True, slots=True)
class Owner:
    """The process that writes a run.

    ``host``: network name of the computer; ``start``: boot id and start time, empty if the system does not show them.
    """

    host: str
    pid: int
    start: str

    def is_gone(self) -> bool:
        """Whether this process certainly no longer runs; False if that is unknown, as on another computer."""
        if self.host != platform.node():
            return False
        now = process_start(self.pid)
        return now not in (self.start, UNKNOWN)


def process_start(pid: int) -> str:
    """Boot id and start time of a process, ``"boot_id/ticks"``.

    Empty if there is no such process; `UNKNOWN` if it lives and /proc does not show its start.
    """
    try:
        stat = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
    except OSError:  # no such process, no /proc, or a /proc that hides other accounts
        return _without_proc(pid)
    fields = stat.rpartition(")")[2].split()
    if fields[0] in {"Z", "X"}:  # a zombie writes nothing any more
        return ""
    return f"{_boot_id()}/{fields[_START_TIME_FIELD]}"


def this_process() -> Owner:
    """The running process."""
    pid = os.getpid()
    return Owner(platform.node(), pid, process_start(pid))


@cache
def _boot_id() -> str:
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    except OSError:
        return "?"


def _without_proc(pid: int) -> str:
    if os.name == "nt":  # os.kill would terminate the process there
        return UNKNOWN
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return ""
    except PermissionError:
        pass
    return UNKNOWN


T = TypeVar("T")

RUNNING = "running"
INCOMPLETE = "incomplete"
INTERRUPTED = "interrupted"
DISK_FULL = "disk_full"
FINISHED = ("complete", "stopped", "aborted", "failed", INTERRUPTED, DISK_FULL)


@dataclass(frozen=True, slots=True, kw_only=True)
class MachineRecord(DocumentRow):
    """A description of a machine; another description is another record."""

    name: str
    doc_hash: str


@dataclass(frozen=True, slots=True, kw_only=True)
class CampaignRecord(DocumentRow):
    """Runs that belong together: one machine, one clock zero."""

    machine_id: int
    name: str


@dataclass(frozen=True, slots=True, kw_only=True)
class RunFacts:
    """Fields of every run record: a field here that is also a column appears in the lists of page, API and command line."""

    campaign: str
    test: str
    role: str
    status: str
    reason: str
    started_utc: str
    ended_utc: str | None


@dataclass(frozen=True, slots=True, kw_only=True)
class RunRecord(RunFacts):
    """One measured sequence. ``status``: as written; ``visible_status``: as people see it."""

    id: int
    campaign_id: int
    label: str
    start_doc: Doc
    end_doc: Doc | None
    owner: Owner

    @property
    def start(self) -> RunStart:
        """The start document, parsed. Raises StoreError if a field has another type."""
        return self._parsed(RunStart.from_document, self.start_doc)

    @property
    def end(self) -> RunEnd:
        """The end document, parsed. Raises StoreError if a field has another type."""
        return self._parsed(RunEnd.from_document, self.end_doc)

    def _parsed(self, parse: Callable[[Any], T], doc: Doc | None) -> T:
        try:
            return parse(doc)
        except (AttributeError, KeyError, TypeError, ValueError) as err:
            text = f"run {self.campaign}/{self.label}: its documents lack or garble {err}"
            raise StoreError(text, "it was not written by Abbe") from None

    @property
    def visible_status(self) -> str:
        """``"incomplete"`` if the run was never finished and its process no longer runs, otherwise ``status``."""
        return visible_status(self.status, self.owner)


def visible_status(status: str, owner: Owner) -> str:
    """State of a run as people see it: an unfinished run is incomplete once its process no longer runs."""
    return INCOMPLETE if status == RUNNING and owner.is_gone() else status


@dataclass(frozen=True, slots=True)
class ChunkRecord:
    """Samples as they arrived, checked against their CRC-32. Never changed after writing.

    ``first_host_s``, ``last_host_s``: monotonic host time of the first and last arrival; ``first_device_us``, ``last_device_us``:
    device time of the first and last sample.
    """

    run_id: int
    channel: str
    seq: int
    n: int
    codec: str
    crc32: int
    payload: bytes = field(repr=False)
    first_host_s: float
    last_host_s: float
    first_device_us: int
    last_device_us: int


@dataclass(frozen=True, slots=True)
class ChannelRecord:
    """Summary of one channel of a run, without the samples."""

    channel: str
    codec: str
    chunks: int
    samples: int


@dataclass(frozen=True, slots=True, kw_only=True)
class CheckpointRecord(HistoryRow):
    """One entry of a campaign's journal."""

    campaign_id: int
    kind: str


@dataclass(frozen=True, slots=True)
class ImportedRun:
    """A run from an exchange file, packed for the store."""

    label: str
    test: str
    role: str
    start_doc: Doc
    n: int
    codec: str
    payload: bytes = field(repr=False)
