"""The way of samples without a line: bytes to the framer, frames to the stream's gates. For the rows in which only bytes matter."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from abbe.drivers.api import BarSample
from abbe.drivers.ballbar.driver import Box
from abbe.drivers.ballbar.frames import Bad, BarCounters, Conversation, FrameDecoder
from abbe.drivers.ballbar.stream import Reads, SegmentEnd, Stream
from abbe.drivers.errors import DriverError, on_behalf_of
from abbe.simulators.faults.serial_bytes import Sample
from tests.faults.contract import Observed, assert_fault_contract, told_of
from tests.faults.serial_rig import Tap, accounted

READS = Reads(number=1, range_nm=1_000_000)
NO_ACCOUNT = "bytes only, no link: the counters say it, the account is tried on the pty"


def honest(count: int) -> list[Sample]:
    """Samples of a bar that breathes by 0.2 mm, from a box with settings number 1."""
    return [Sample(i, 5_000_000 + 1000 * i, round(200_000 * math.sin(i / 50.0)), 1 << 8) for i in range(count)]


@dataclass
class Heard:
    """What came of some bytes."""

    stream: Stream
    tap: Tap = field(default_factory=Tap)
    bad_bytes: int = 0
    pending: int = 0
    error: DriverError | None = None


async def hear(pieces: Iterable[bytes], *, name: str = "ball-bar") -> Heard:
    """Feed pieces until they end or the stream does; must be called in an event loop, as the driver is."""

    async def nowhere(data: bytes) -> None:
        raise AssertionError(data)

    tap = Tap()
    heard = Heard(Stream(name, 1000, 1e6, tap, 1, reads=READS), tap)
    box = Box(name, Conversation(name, nowhere, BarCounters(), lambda: 1.0, lambda: 0.0), None)
    decoder = FrameDecoder()
    for piece in pieces:
        frames = decoder.feed(piece)
        heard.bad_bytes += sum(frame.n_bytes for frame in frames if isinstance(frame, Bad))
        try:
            heard.stream.put(0.0, [frame for frame in frames if isinstance(frame, BarSample)], overran=False)
        except SegmentEnd as end:
            heard.error = box.error_of(end)
        heard.error = heard.error or heard.stream._error
        if heard.error is not None:
            break
    heard.pending = decoder.pending
    if heard.error is None and heard.stream.tracker.was_lossy:
        heard.error = heard.stream.lossy()
    return heard


async def judged(row: str, case: str, pieces: Iterable[bytes], sent: Sequence[Sample]) -> Heard:
    """Play one case of bytes: what was sent last has to arrive unless the stream was ended with an error, which must then be clear."""
    with on_behalf_of(f"{row} {case}"):
        heard = await hear(pieces)
    whole = heard.error is None
    wrong, unaccounted = accounted(heard.tap.batches, sent, whole=whole)
    assert_fault_contract(
        Observed(
            row,
            case,
            told=None if heard.error is None else told_of(heard.error),
            absorbed=whole,
            wrong_values=wrong,
            unaccounted=unaccounted,
            state="streaming" if whole else f"aborted: {heard.error.code if heard.error else ''}",
            resumed=await _resumes(),
            left_out={"A": NO_ACCOUNT},
        )
    )
    return heard


async def _resumes() -> bool:
    sent = honest(20)
    heard = await hear([b"".join(sample.frame() for sample in sent)])
    return heard.error is None and len(heard.tap.samples) == len(sent)
