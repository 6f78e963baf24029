"""Clean-up reaches its end under any number of cancellations, and the cancellation still arrives."""

from __future__ import annotations

import asyncio

import pytest

from abbe.drivers.errors import run_to_end


async def test_result_and_error_pass_through():
    async def fine() -> int:
        return 3

    async def broken() -> None:
        raise ValueError("x")

    assert await run_to_end(fine()) == 3
    with pytest.raises(ValueError, match="x"):
        await run_to_end(broken())


@pytest.mark.parametrize("fails", [False, True])
async def test_cancelled_many_times(fails):
    release, started = asyncio.Event(), asyncio.Event()
    ended = False

    async def work() -> None:
        nonlocal ended
        started.set()
        await release.wait()
        ended = True
        if fails:
            raise ValueError("nobody is left to hear this")

    task = asyncio.create_task(run_to_end(work()))
    await started.wait()
    for _ in range(5):
        task.cancel()
        await asyncio.sleep(0)
    assert not task.done()
    release.set()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert ended


async def test_an_outer_timeout_still_counts():
    async def work() -> None:
        await asyncio.sleep(0.05)

    with pytest.raises(TimeoutError):
        async with asyncio.timeout(0.01):
            await run_to_end(work())
