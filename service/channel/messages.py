"""What core and web say to each other: everything there is. Frozen, checked at both ends, bounded in length.

The core says what is so (`Begin`, `Snapshot`, `Jobs`, `LivePath`, `LiveSamples`, `Answer`), the web process asks for what a person wants
(`StartJob`, `SteerJob`, `DoneByHand`, `RollBack`, `PushNow`). Nothing that it can say names a device, a register or a file, or holds a
table: the one in force is named by its push and CRC, and which one comes instead says the push journal.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import date
from typing import Annotated, Literal, TypeVar

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError

from abbe.service.domain.bounds import Number, Text, Word
from abbe.service.domain.device_status import DeviceStatus
from abbe.service.domain.job_state import JobState
from abbe.service.domain.progress import RunningCheck
from abbe.service.domain.recorded_path import RecordedPath
from abbe.service.domain.schedule import DueSlot, Schedule
from abbe.service.errors import ChannelBroken

T = TypeVar("T")

PROTOCOL = 1
"""Both processes are of one installation; a web process that was left behind by an upgrade must not talk to a new core."""

LARGEST_B = 256 * 1024
"""The longest message, bytes."""
MOST_JOBS = 50
PAGE_MEMORY_MB = 1024
"""What the page's process gets, by default, MiB."""

_STRICT = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)

How = Literal["stop", "abort", "pause", "resume"]
Outcome = Literal["done", "unknown", "busy", "forbidden", "conflict"]


@dataclass(frozen=True, slots=True)
class RulesSummary:
    """What the machine file adds to reports: limits, certificates, allowed temperature."""

    limits_um: dict[str, float]
    calibrated_until: dict[str, date] | None
    temperature_c: tuple[float, float] | None


@dataclass(frozen=True, slots=True)
class MachineSummary:
    """The machine's nominal geometry (run-format.md 1) and its largest feed: what a dry run is calculated from."""

    chain: Word
    stroke_mm: dict[str, tuple[float, float]]
    pivots_mm: dict[str, tuple[float, float, float]]
    tool_mm: tuple[float, float, float]
    max_feed_mm_min: float


@dataclass(frozen=True, slots=True)
class Begin:
    """First message of the core: all that the web process has to know. Other users could read arguments and environment."""

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
    rules: RulesSummary
    plan: MachineSummary | None
    campaigns: Annotated[tuple[Word, ...], Field(max_length=200)]
    memory_mb: Annotated[int, Field(ge=1)]
    control: Text


@dataclass(frozen=True, slots=True)
class Snapshot:
    """How things stand; at least once a second."""

    __pydantic_config__ = _STRICT
    kind: Literal["moment"]
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
    """The latest jobs, newest first; whenever one begins, changes its state or ends."""

    __pydantic_config__ = _STRICT
    kind: Literal["jobs"]
    jobs: Annotated[tuple[JobState, ...], Field(max_length=MOST_JOBS)]


@dataclass(frozen=True, slots=True)
class LivePath:
    """A path is being recorded; number 0: none is any more."""

    __pydantic_config__ = _STRICT
    kind: Literal["path"]
    path: RecordedPath


@dataclass(frozen=True, slots=True)
class LiveSamples:
    """What a path has read since the last of these, for display only: left out where the reader is slow.

    ``first``: number of the first sample, counted from the path's beginning; ``arrived_ms``: when the last one came in, UTC milliseconds;
    ``values``: deviations in µm as little-endian float32, in base64.
    """

    __pydantic_config__ = _STRICT
    kind: Literal["samples"]
    path: Number
    first: Number
    arrived_ms: float
    values: Annotated[str, Field(max_length=LARGEST_B // 2)]


@dataclass(frozen=True, slots=True)
class Answer:
    """What became of a request. ``job``: the one that was started or steered."""

    __pydantic_config__ = _STRICT
    kind: Literal["answer"]
    request: Number
    outcome: Outcome
    text: Text
    job: Word


@dataclass(frozen=True, slots=True)
class Up:
    """The web process serves."""

    __pydantic_config__ = _STRICT
    kind: Literal["up"]
    protocol: Number


@dataclass(frozen=True, slots=True)
class Alive:
    """The web process's loop goes round."""

    __pydantic_config__ = _STRICT
    kind: Literal["alive"]


@dataclass(frozen=True, slots=True)
class StartJob:
    """Somebody wants a declared recipe to be measured now. ``key``: said twice, it starts one job; empty: each request is a new one."""

    __pydantic_config__ = _STRICT
    kind: Literal["start"]
    request: Number
    recipe: Word
    key: Word
    who: Word


@dataclass(frozen=True, slots=True)
class SteerJob:
    """Somebody wants a running job to stop, pause or go on."""

    __pydantic_config__ = _STRICT
    kind: Literal["steer"]
    request: Number
    job: Word
    how: How
    who: Word


@dataclass(frozen=True, slots=True)
class DoneByHand:
    """Somebody says that what a job asks for is done: prompt number ``prompt``, and no other."""

    __pydantic_config__ = _STRICT
    kind: Literal["hand"]
    request: Number
    job: Word
    prompt: Number
    who: Word


FromCore = Begin | Snapshot | Jobs | LivePath | LiveSamples | Answer


@dataclass(frozen=True, slots=True)
class RollBack:
    """Somebody orders that the table in force, which push ``push`` brought and which has ``crc``, gives way to the one before.

    ``key``: said twice, it is one order.
    """

    __pydantic_config__ = _STRICT
    kind: Literal["rollback"]
    request: Number
    push: Number
    crc: Annotated[int, Field(ge=0, le=2**32 - 1)]
    reason: Annotated[str, Field(min_length=1, max_length=500)]
    key: Word
    who: Word


@dataclass(frozen=True, slots=True)
class PushNow:
    """Somebody orders that a proposal whose approval holds is pushed now. ``key``: said twice, it is one order."""

    __pydantic_config__ = _STRICT
    kind: Literal["push"]
    request: Number
    proposal: Number
    key: Word
    who: Word


Asked = StartJob | SteerJob | DoneByHand | RollBack | PushNow
"""What is answered with an `Answer`."""
FromWeb = Up | Alive | Asked

FROM_CORE: TypeAdapter[FromCore] = TypeAdapter(Annotated[FromCore, Field(discriminator="kind")])
FROM_WEB: TypeAdapter[FromWeb] = TypeAdapter(Annotated[FromWeb, Field(discriminator="kind")])


def encode(message: FromCore | FromWeb) -> bytes:
    """A message as bytes.

    Raises
    ------
    ChannelBroken
        It is not what its type says, or too long: a defect of the sender.
    """
    if isinstance(message, FromCore):
        body = FROM_CORE.dump_json(message, warnings=False)  # whatever is wrong with it, the next line says
        from_core(body)
    else:
        body = FROM_WEB.dump_json(message, warnings=False)
        from_web(body)
    return body


def from_core(body: bytes) -> FromCore:
    """What the core says.

    Raises
    ------
    ChannelBroken
        Not one of its messages.
    """
    return _checked(FROM_CORE, body)


def from_web(body: bytes) -> FromWeb:
    """What the web process says.

    Raises
    ------
    ChannelBroken
        Not one of its messages.
    """
    return _checked(FROM_WEB, body)


def _checked(adapter: TypeAdapter[T], body: bytes) -> T:
    if len(body) > LARGEST_B:
        raise ChannelBroken(f"a message of {len(body)} bytes on the channel of the service; allowed are {LARGEST_B}")
    try:
        return adapter.validate_json(body)
    except ValidationError as wrong:
        first = wrong.errors(include_input=False, include_url=False)[0]
        where = ".".join(str(part) for part in first["loc"])
        raise ChannelBroken(f"a message on the channel of the service is not one of ours: {where}: {first['msg']}") from None
