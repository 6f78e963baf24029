"""The channel between core and web process: all messages, and its two ends (`Wire`).

Messages are frozen, validated at both ends, and bounded in length. They travel as four bytes of length, then JSON, over a socket pair that
the parent created; it has no file, port or name to which another process could connect.

The core reports its state (`Begin`, `Snapshot`, `Jobs`, `LivePath`, `LiveSamples`,
`LiveMachine`, `Answer`); the web process forwards what a person
requests (`StartJob`, `SteerJob`, `ConfirmPrompt`, `RollBack`, `PushNow`, `ChangeFile`). No request can name a device, a register or a file,
or carry a table: a request names the table in force by its push and CRC, and the push journal determines which table replaces it; a change
of the machine file reaches only the sections that `abbe.service.machine_changes.RIGHTS` lists.
"""

from __future__ import annotations

import asyncio
import socket
import struct
from dataclasses import dataclass, replace
from typing import Annotated, Literal, Self, TypeVar

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError

from abbe.service.domain.document import Number, Text, Word
from abbe.service.domain.machine import MachineObject, Rules
from abbe.service.domain.machine_file import FileEdit, MachineFileSummary
from abbe.service.domain.progress import DeviceStatus, JobState, MachineReading, RecordedPath, RunningCheck
from abbe.service.domain.schedule import DueSlot, Schedule
from abbe.service.errors import ChannelBroken, mistakes

T = TypeVar("T")

PROTOCOL = 1
"""Version of the channel. A web process that survived an upgrade must not talk to the new core."""

LARGEST_B = 256 * 1024
"""The longest message, bytes."""
MOST_JOBS = 50

_STRICT = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, defer_build=True)

Steering = Literal["stop", "abort", "pause", "resume"]
Outcome = Literal["done", "unknown", "busy", "forbidden", "conflict"]


@dataclass(frozen=True, slots=True)
class MachineSummary:
    """Nominal geometry of the machine and its largest feed: the input of a dry run."""

    machine: MachineObject
    max_feed_mm_min: float


@dataclass(frozen=True, slots=True)
class Begin:
    """First message of the core: the configuration of the web process. Arguments or environment variables would be readable for others."""

    __pydantic_config__ = _STRICT
    kind: Literal["begin"]
    protocol: Number
    machine: Word
    version: Word
    store_url: Text
    broker: Text
    hosts: Annotated[tuple[Word, ...], Field(max_length=100)]
    certificate: Text
    key: Text
    recipes: Annotated[tuple[Word, ...], Field(max_length=200)]
    port: Annotated[int, Field(ge=0, le=65535)]
    behind_tls: bool
    schedules: Annotated[tuple[Schedule, ...], Field(max_length=200)]
    rules: Rules
    plan: MachineSummary | None
    campaigns: Annotated[tuple[Word, ...], Field(max_length=200)]
    memory_mb: Annotated[int, Field(ge=1)]
    control: Text
    pushes_itself: bool
    stated: MachineFileSummary | None

    def stating(self, stated: MachineFileSummary) -> Begin:
        """Return this message with as much of the machine file as fits into it."""
        return replace(self, stated=stated.within(LARGEST_B - len(encode(replace(self, stated=None)))))


@dataclass(frozen=True, slots=True)
class Snapshot:
    """State of the core, sent at least once a second."""

    __pydantic_config__ = _STRICT
    kind: Literal["snapshot"]
    changes: Number
    check: RunningCheck | None
    devices: Annotated[tuple[DeviceStatus, ...], Field(max_length=50)]
    due: Annotated[tuple[DueSlot, ...], Field(max_length=200)]
    mqtt_connected: bool
    mqtt_dropped: Number
    attention: Annotated[tuple[Text, ...], Field(max_length=20)]
    core_rss_bytes: Number
    web_restarts: Number


@dataclass(frozen=True, slots=True)
class Jobs:
    """The latest jobs, newest first; sent whenever a job begins, changes its state or ends."""

    __pydantic_config__ = _STRICT
    kind: Literal["jobs"]
    jobs: Annotated[tuple[JobState, ...], Field(max_length=MOST_JOBS)]


@dataclass(frozen=True, slots=True)
class LivePath:
    """The path that is being recorded; number 0: no path."""

    __pydantic_config__ = _STRICT
    kind: Literal["path"]
    path: RecordedPath


@dataclass(frozen=True, slots=True)
class LiveSamples:
    """New samples of the path since the last message, for display only; the core drops them while the reader is slow.

    ``first``: number of the first sample, counted from the start of the path; ``arrived_ms``: arrival of the last sample, UTC milliseconds;
    ``values``: deviations in µm as little-endian float32, in base64.
    """

    __pydantic_config__ = _STRICT
    kind: Literal["samples"]
    path: Number
    first: Number
    arrived_ms: float
    values: Annotated[str, Field(max_length=LARGEST_B // 2)]


@dataclass(frozen=True, slots=True)
class LiveMachine:
    """State of the machine during a measurement; ``machine`` None: the measurement has ended."""

    __pydantic_config__ = _STRICT
    kind: Literal["machine"]
    machine: MachineReading | None


@dataclass(frozen=True, slots=True)
class Answer:
    """Outcome of a request. ``job``: the job that the request started or steered."""

    __pydantic_config__ = _STRICT
    kind: Literal["answer"]
    request: Number
    outcome: Outcome
    text: Text
    job: Word


@dataclass(frozen=True, slots=True)
class Serving:
    """Report that the web process accepts connections."""

    __pydantic_config__ = _STRICT
    kind: Literal["up"]
    protocol: Number


@dataclass(frozen=True, slots=True)
class WebHeartbeat:
    """Sign of life: the event loop of the web process is running."""

    __pydantic_config__ = _STRICT
    kind: Literal["alive"]


@dataclass(frozen=True, slots=True, kw_only=True)
class WebRequest:
    """A request to the core, and the account that makes it. The core answers with the same number ``request``."""

    __pydantic_config__ = _STRICT
    request: Number
    who: Word


@dataclass(frozen=True, slots=True, kw_only=True)
class StartJob(WebRequest):
    """Start a declared recipe now. ``key``: a repeated key starts no second job; empty: every request starts a new job.

    ``alarm``: number of the alarm whose cause a full campaign looks for; 0: no alarm. ``resume``: interrupted full campaign whose complete
    runs are kept; empty: a new campaign.
    """

    kind: Literal["start"] = "start"
    recipe: Word
    key: Word
    alarm: Number
    resume: Word


@dataclass(frozen=True, slots=True, kw_only=True)
class SteerJob(WebRequest):
    """Stop, abort, pause or resume a running job."""

    kind: Literal["steer"] = "steer"
    job: Word
    how: Steering


@dataclass(frozen=True, slots=True, kw_only=True)
class ConfirmPrompt(WebRequest):
    """Confirm a job's prompt with the number ``prompt``: its manual task is done. Refused if another prompt is open."""

    kind: Literal["hand"] = "hand"
    job: Word
    prompt: Number


@dataclass(frozen=True, slots=True, kw_only=True)
class RollBack(WebRequest):
    """Replace the table in force, identified by its push and CRC, by the table before it. ``key``: requests with the same key are one
    order."""

    kind: Literal["rollback"] = "rollback"
    push: Number
    crc: Annotated[int, Field(ge=0, le=2**32 - 1)]
    reason: Annotated[str, Field(min_length=1, max_length=500)]
    key: Word


@dataclass(frozen=True, slots=True, kw_only=True)
class PushNow(WebRequest):
    """Push a proposal with a valid approval now. ``key``: requests with the same key are one order."""

    kind: Literal["push"] = "push"
    proposal: Number
    key: Word


@dataclass(frozen=True, slots=True, kw_only=True)
class ChangeFile(WebRequest):
    """Change values of the machine file, and start anew with them; without ``edits``: only read the file again.

    ``sha256``: digest of the file whose values the person saw; ``looser``: the person knows that a limit is loosened.
    """

    kind: Literal["file"] = "file"
    sha256: Word
    edits: Annotated[tuple[FileEdit, ...], Field(max_length=100)]
    reason: Annotated[str, Field(max_length=500)]
    looser: bool


FromCore = Begin | Snapshot | Jobs | LivePath | LiveSamples | LiveMachine | Answer
CoreRequest = StartJob | SteerJob | ConfirmPrompt | RollBack | PushNow | ChangeFile
"""Requests that the core answers with an `Answer`."""
FromWeb = Serving | WebHeartbeat | CoreRequest

FROM_CORE: TypeAdapter[FromCore] = TypeAdapter(Annotated[FromCore, Field(discriminator="kind")])
FROM_WEB: TypeAdapter[FromWeb] = TypeAdapter(Annotated[FromWeb, Field(discriminator="kind")])


def encode(message: FromCore | FromWeb) -> bytes:
    """Return a message as JSON bytes, after checking it.

    Raises
    ------
    ChannelBroken
        The message does not match its type, or is too long: a defect of the sender.
    """
    if isinstance(message, FromCore):
        body = FROM_CORE.dump_json(message, warnings=False)  # the next line raises for a wrong message
        from_core(body)
    else:
        body = FROM_WEB.dump_json(message, warnings=False)
        from_web(body)
    return body


def from_core(body: bytes) -> FromCore:
    """Parse a message of the core. Raises ChannelBroken."""
    return _checked(FROM_CORE, body)


def from_web(body: bytes) -> FromWeb:
    """Parse a message of the web process. Raises ChannelBroken."""
    return _checked(FROM_WEB, body)


def _checked(adapter: TypeAdapter[T], body: bytes) -> T:
    if len(body) > LARGEST_B:
        raise ChannelBroken(f"a message of {len(body)} bytes between core and web process; the limit is {LARGEST_B}")
    try:
        return adapter.validate_json(body)
    except ValidationError as wrong:
        first = mistakes(wrong.errors(include_input=False, include_url=False))[0]
        raise ChannelBroken(f"invalid message between core and web process: {first.path}: {first.message}") from None


_LENGTH = struct.Struct(">I")
FULL_B = 2 * LARGEST_B
"""Largest number of bytes that may wait for the reader; beyond it the sender skips updates, since newer ones follow."""


class Wire:
    """Sends and receives whole messages; created by `Wire.over`."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._reader, self._writer = reader, writer

    @classmethod
    async def over(cls, end: socket.socket) -> Self:
        """Take over one end of a socket pair."""
        end.setblocking(False)
        return cls(*await asyncio.open_connection(sock=end, limit=LARGEST_B + _LENGTH.size))

    @property
    def is_full(self) -> bool:
        """Whether more than `FULL_B` bytes wait for the reader: skip updates then."""
        return self._writer.transport.get_write_buffer_size() > FULL_B

    def send(self, message: FromCore | FromWeb) -> None:
        """Send without waiting; a message to a closed channel is lost, and the reading side notices the end.

        Raises
        ------
        ChannelBroken
            The message does not match its type.
        """
        body = encode(message)
        if not self._writer.is_closing():
            self._writer.write(_LENGTH.pack(len(body)) + body)

    async def receive(self) -> bytes | None:
        """Return the next message; None when the other side has ended.

        Raises
        ------
        ChannelBroken
            The announced length is too large.
        """
        try:
            (size,) = _LENGTH.unpack(await self._reader.readexactly(_LENGTH.size))
            if size > LARGEST_B:
                raise ChannelBroken(f"a message of {size} bytes was announced between core and web process; the limit is {LARGEST_B}")
            return await self._reader.readexactly(size)
        except (asyncio.IncompleteReadError, ConnectionError):
            return None

    def close(self) -> None:
        """Close this end; the other side reads the end of the stream."""
        self._writer.close()
