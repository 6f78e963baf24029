"""Samples on their way to the browsers: whole, in order, and never waited for."""

from __future__ import annotations

import json
import struct
from base64 import b64encode

import numpy as np
import pytest

from abbe.service.channel.messages import LiveSamples
from abbe.service.domain.progress import RecordedPath
from abbe.service.errors import ChannelBroken
from abbe.service.web.core_link.sample_board import HEAD, KEPT_FRAMES, MOST_EACH, MOST_LISTENERS, QUEUE, SampleBoard

PATH = RecordedPath(
    number=3,
    run="helix1",
    test="ballbar_helix",
    radius_mm=150.0,
    feed_mm_min=2000.0,
    rate_hz=1000,
    duration_s=84.2,
    angle_deg=(0.0, 90.0),
)


def told(first: int, *values: float, path: int = 3) -> LiveSamples:
    return LiveSamples("samples", path, first, 1.7e12, b64encode(np.array(values, dtype="<f4").tobytes()).decode())


def read(data: bytes) -> list[tuple[int, int, list[float]]]:
    found = []
    while data:
        version, path, first, count, arrived_ms = HEAD.unpack_from(data)
        assert (version, arrived_ms) == (1, 1.7e12)
        found.append((path, first, list(struct.unpack_from(f"<{count}f", data, HEAD.size))))
        data = data[HEAD.size + 4 * count :]
    return found


async def test_who_comes_late_gets_what_there_is_and_then_everything() -> None:
    board = SampleBoard()
    board.set_path(PATH)
    board.add_samples(told(0, 1.0, 2.0))
    board.add_samples(told(2, -0.5))
    with board.listener() as parts:
        assert parts is not None
        board.add_samples(told(3, 4.0))
        board.set_path(RecordedPath())
        board.end()
        got = [part async for part in parts()]
    assert [json.loads(part)["number"] for part in got if isinstance(part, str)] == [3, 0]
    assert [read(part) for part in got if isinstance(part, bytes)] == [[(3, 0, [1.0, 2.0]), (3, 2, [-0.5])], [(3, 3, [4.0])]]
    with board.listener() as parts:
        assert parts is not None
        board.set_path(PATH)
        board.add_samples(told(0, 1.5))
        board.end()
        got = [part async for part in parts()]
    assert [json.loads(part)["number"] for part in got if isinstance(part, str)] == [0, 3]
    assert [read(part) for part in got if isinstance(part, bytes)] == [[(3, 0, [1.5])]]  # nothing of the path before


async def test_a_slow_browser_misses_the_oldest_and_hears_of_every_path() -> None:
    board = SampleBoard()
    with board.listener() as parts:
        assert parts is not None
        board.set_path(PATH)
        for k in range(3 * QUEUE):
            board.add_samples(told(k, float(k)))
        got = parts()
        assert [json.loads(await anext(got))["number"] for _ in range(2)] == [0, 3]  # what was so, and what is
        frames = [await anext(got) for _ in range(QUEUE)]
        assert [read(frame)[0][1] for frame in frames if isinstance(frame, bytes)] == list(range(2 * QUEUE, 3 * QUEUE))
    assert board.dropped == 2 * QUEUE + 1


async def test_it_is_bounded() -> None:
    board = SampleBoard()
    board.set_path(PATH)
    for k in range(KEPT_FRAMES + 5):
        board.add_samples(told(k, 0.0))
    assert len(board._frames) == KEPT_FRAMES
    open_ones = [board.listener(f"user:{k // MOST_EACH}") for k in range(MOST_LISTENERS + 1)]
    assert [one.__enter__() is None for one in open_ones] == [False] * MOST_LISTENERS + [True]
    for one in open_ones:
        one.__exit__(None, None, None)
    of_one = [board.listener("user:vera") for _ in range(MOST_EACH + 1)]
    assert [one.__enter__() is None for one in of_one] == [False] * MOST_EACH + [True]
    with board.listener("user:olga") as parts:
        assert parts is not None
    for one in of_one:
        one.__exit__(None, None, None)


@pytest.mark.parametrize("values", ["not base64!", "AAA=", "AACAPwA="])
def test_what_are_no_samples_breaks_the_channel(values: str) -> None:
    with pytest.raises(ChannelBroken):
        SampleBoard().add_samples(LiveSamples("samples", 1, 0, 0.0, values))
