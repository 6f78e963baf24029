"""Stored measurements: machines, campaigns, runs and their samples, and the process that writes a run. One record is one row.

A process is identified by pid, start time and boot id: the operating system reuses pids, and start times count from boot.
"""

from __future__ import annotations

import math
import os
import platform
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, TypeVar

from abbe.service.domain.artefact import Touched
from abbe.service.domain.document import Doc, DocumentRow, HistoryRow, record
from abbe.service.domain.machine import Point
from abbe.service.errors import StoreError

if TYPE_CHECKING:
    from abbe.models.arrays import F1, F2


@dataclass(frozen=True, slots=True)
class RunPiece:
    """An interrupted run, and the position on the whole path up to which its readings are used, mm from the first point."""

    run: int
    to_mm: float


@dataclass(frozen=True, kw_only=True, eq=False)
class CommandedPath:
    """The path of a ball-bar run, a polyline at constant feed.

    ``points_mm``: shape (n, 3), from the machine's position at the start of the path; ``measured``: numbers of the first and last point
    between which readings are used, None: all. If the path resumes an interrupted one (`abbe.service.sequences.resume_plan`), it is the
    rest of the whole path: it begins ``offset_mm`` after the start of the whole path, and ``pieces`` are the interrupted runs of the
    earlier parts.
    """

    points_mm: F2
    feed_mm_min: float
    direction: int
    measured: tuple[int, int] | None
    offset_mm: float
    pieces: tuple[RunPiece, ...]

    @classmethod
    def from_document(cls, doc: Doc) -> Self:
        """Parse ``path`` of a start document."""
        import numpy as np  # a list of runs has no path

        measured = doc.get("measured")
        return cls(
            points_mm=np.asarray(doc["points_mm"], dtype=np.float64).reshape(-1, 3),
            feed_mm_min=float(doc["feed_mm_min"]),
            direction=int(doc["direction"]),
            measured=(int(measured[0]), int(measured[1])) if measured else None,
            offset_mm=float(doc.get("offset_mm", 0.0)),
            pieces=tuple(RunPiece(int(one["run"]), float(one["to_mm"])) for one in doc.get("pieces", ())),
        )

    @property
    def feed_mm_s(self) -> float:
        """The feed in mm/s."""
        return self.feed_mm_min / 60.0

    @property
    def arc_mm(self) -> F1:
        """Length of the path up to each of its points, mm, shape (n,)."""
        return arc_of(self.points_mm)

    @property
    def counted_mm(self) -> tuple[float, float]:
        """Positions along this path between which readings are used, mm from its first point."""
        arc = self.arc_mm
        first, last = self.measured or (0, len(arc) - 1)
        return float(arc[first]), float(arc[last])


def arc_of(points_mm: F2 | Sequence[Sequence[float]]) -> F1:
    """Length of a polyline up to each of its points, mm."""
    import numpy as np

    steps = np.linalg.norm(np.diff(np.asarray(points_mm, dtype=np.float64), axis=0), axis=1)
    return np.concatenate(([0.0], np.cumsum(steps)))


@dataclass(frozen=True, slots=True, kw_only=True)
class StandstillRecord:
    """A stored reading at standstill. ``ctrl_us``: controller time, after the axes had settled."""

    ctrl_us: int
    target_mm: Point
    direction: float
    feed_mm_min: float


@dataclass(frozen=True, slots=True, kw_only=True)
class LaserRecord(StandstillRecord):
    """A reading of the laser; air in °C and Pa, NaN if unknown; ``missing``: there was no reading at that standstill."""

    displacement_tenth_nm: int
    status: int
    signal_permille: int
    air_temp_c: float = math.nan
    air_pressure_pa: float = math.nan
    missing: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class BarRecord(StandstillRecord):
    """The samples of the ball-bar at one point."""

    device_us: tuple[int, ...]
    reading_nm: tuple[int, ...]
    status: tuple[int, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class TouchedFeature(Touched):
    """The touches of a hole (``inside``) or ball.

    ``nominal_mm``: nominal place in artefact axes; ``target_mm``: axis position expected for its centre; ``sides``: unit vectors from
    the centre to each touch, machine axes; ``touches_mm``: for each side the repeated latched axis positions; ``start_deg``: direction
    of the first touch; ``resolution_mm``: travel between two readings of the probe input by the control, 0: none; ``radius_mm``:
    expected distance of the tip's centre from the feature's centre; ``u_sphere_mm``: standard uncertainty of the radius of a
    qualification sphere, None: a feature.
    """

    feature: str
    inside: bool
    nominal_mm: Point
    target_mm: Point
    sides: tuple[Point, ...]
    touches_mm: tuple[tuple[Point, ...], ...]
    start_deg: float
    feed_mm_min: float = 0.0
    false_trips: int = 0
    resolution_mm: float = 0.0
    radius_mm: float | None = None
    u_sphere_mm: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class TouchRecord(TouchedFeature):
    """A stored feature; ``ctrl_us``: controller time after its last touch."""

    ctrl_us: int
    temperature_C: float | None = None  # noqa: N815 - a name of the format


@dataclass(frozen=True, kw_only=True)
class RunTable:
    """The compensation table that was active during a run.

    ``crc``: None if the controller did not state it; ``acting``: whether it acted, None if not recorded; ``document``: as stored.
    """

    crc: int | None = None
    bank: int | None = None
    acting: bool | None = None
    boot_id: int | None = None
    document: Doc = field(default_factory=dict, repr=False)

    @classmethod
    def from_document(cls, doc: Doc | None) -> Self:
        """Parse ``table`` of a run; None counts as empty."""
        known = doc or {}
        numbers = {key: None if known.get(key) is None else int(known[key]) for key in ("crc", "bank", "boot_id")}
        return cls(**numbers, acting=known.get("acting"), document=known)

    @property
    def acting_crc(self) -> int | None:
        """CRC of the table; None if there was no table, or if it did not act."""
        return None if self.acting is False else self.crc


@dataclass(frozen=True, kw_only=True, eq=False)
class RunStart:
    """Facts known when a run begins.

    ``ctrl0_us``: zero of the campaign's clock in controller time; ``clock_us``: controller time when the document was written;
    ``path_start_us``: controller time at the start of the path, if known; ``standstills``: planned number of readings at standstill. A
    ball-bar run whose ``setup`` states the number of ``samples`` was read point by point (``point_by_point``): it has no path, and its
    records are like those of a laser run. ``imported``: the document of an imported run, without its columns; ``entry``: its entry in the
    campaign file.
    """

    setup: Doc
    machine: Doc
    ctrl0_us: int
    rate_hz: float
    path: CommandedPath | None
    table: RunTable
    clock_us: int | None
    path_start_us: int | None
    standstills: int
    imported: Doc | None = field(repr=False)
    entry: Doc | None

    @classmethod
    def from_document(cls, doc: Doc) -> Self:
        """Parse a start document; missing fields are empty or zero."""
        imported: Doc | None = doc.get("imported")
        path = doc.get("path")
        return cls(
            setup=doc.get("setup") or {},
            machine=doc.get("machine") or {},
            ctrl0_us=int(doc.get("ctrl0_us", 0)),
            rate_hz=float(doc.get("rate_hz", 1.0)),
            path=CommandedPath.from_document(path) if path else None,
            table=RunTable.from_document((doc if imported is None else imported).get("table")),
            clock_us=(doc.get("clock") or {}).get("ctrl_us"),
            path_start_us=doc.get("path_start_us"),
            standstills=int(doc.get("standstills") or 0),
            imported=imported,
            entry=doc.get("entry"),
        )

    @property
    def pieces(self) -> tuple[RunPiece, ...]:
        """The interrupted runs whose readings belong to this one, oldest first; empty for a run without interruption."""
        return () if self.path is None else self.path.pieces

    @property
    def set_s(self) -> float:
        """Time of mounting on the campaign's clock as the start document states it, s; 0 if it states none."""
        return float(self.setup.get("t_set_s", 0.0))

    @property
    def point_by_point(self) -> bool:
        """Whether a ball-bar was read at standstill."""
        return "samples" in self.setup

    @property
    def commanded(self) -> CommandedPath:
        """Commanded path of the run.

        Raises
        ------
        KeyError
            The run has no path.
        """
        if self.path is None:
            raise KeyError("path")
        return self.path

    def since_zero_s(self, ctrl_us: float) -> float:
        """Seconds of the campaign's clock at a controller time in µs."""
        return float(ctrl_us - self.ctrl0_us) * 1e-6


@dataclass(frozen=True, kw_only=True, eq=False)
class RunEnd:
    """Facts known when a run ends; all None or empty without an end document.

    ``path_start_us``, ``path_end_us``: controller time of start and end of the path; ``good_us``: controller time until which an
    interrupted path ran at constant feed; ``box_boot_id``: boot id of the ball-bar's box; ``clock_pairs``: controller time (µs) and arrival
    (host s) of status messages; ``mounted_us``: controller time at which cup or laser was mounted, if after the start document.
    """

    path_start_us: int | None = None
    path_end_us: int | None = None
    good_us: int | None = None
    box_boot_id: int | None = None
    mounted_us: int | None = None
    clock_pairs: tuple[tuple[float, float], ...] = ()

    @classmethod
    def from_document(cls, doc: Doc | None) -> Self:
        """Parse an end document; None counts as empty."""
        known = doc or {}
        pairs = tuple((float(ctrl_us), float(host_s)) for ctrl_us, host_s in known.get("clock_pairs", ()))
        return cls(
            path_start_us=known.get("path_start_us"),
            path_end_us=known.get("path_end_us"),
            good_us=known.get("good_us"),
            box_boot_id=known.get("box_boot_id"),
            mounted_us=known.get("mounted_us"),
            clock_pairs=pairs,
        )

    @property
    def path_us(self) -> tuple[int, int] | None:
        """Start and end of the path in controller time; None unless it ran to its end."""
        if not self.path_end_us or self.path_start_us is None:
            return None
        return self.path_start_us, self.path_end_us


UNKNOWN = "?"
"""Stands for the start time of a living process if the system does not show it; only the pid identifies such a process."""
_START_TIME_FIELD = 22 - 3
"""Field 22 of /proc/PID/stat, counted after the command name (field 2), which may itself hold blanks."""


@dataclass(frozen=True, slots=True)
class Owner:
    """A process that owns stored rows, e.g. the one that writes a run.

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
class CampaignHead:
    """Facts known when a campaign begins.

    ``ctrl0_us``: zero of its clock in controller time of the start ``boot_id``; None for an imported campaign, whose documents are
    ``imported`` and ``errors``.
    """

    ctrl0_us: int | None = None
    boot_id: int | None = None
    imported: Doc | None = None
    errors: Doc | None = None

    @property
    def zero_us(self) -> int:
        """Zero of the clock of a campaign that was measured here. Raises StoreError for any other campaign."""
        if self.ctrl0_us is None:
            raise StoreError("the campaign has no clock of the controller", "only a campaign that Abbe measured can be continued")
        return self.ctrl0_us


@dataclass(frozen=True, slots=True, kw_only=True)
class CampaignRecord(DocumentRow):
    """Runs that belong together: one machine, one clock zero."""

    machine_id: int
    name: str

    @property
    def head(self) -> CampaignHead:
        """The document, parsed. Raises Unusable if a field has another type."""
        return record(CampaignHead, self.doc, f"campaign {self.name}")

    @property
    def known(self) -> Doc:
        """Return what is known of machine, instruments and artefacts; for an imported campaign, the imported document."""
        return self.doc.get("imported") or self.doc


@dataclass(frozen=True, slots=True, kw_only=True)
class RunFacts:
    """Fields of a run that its full record and the summaries in lists share."""

    campaign: str
    test: str
    role: str
    status: str
    reason: str
    started_utc: str
    ended_utc: str | None


@dataclass(frozen=True, slots=True, kw_only=True)
class RunRecord(RunFacts):
    """One measured sequence. ``status``: the written status; ``visible_status``: the status that people see."""

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
            text = f"run {self.campaign}/{self.label}: its documents have a missing or invalid field: {err}"
            raise StoreError(text, "Abbe did not write this, or the database is damaged: restore a backup") from None

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
