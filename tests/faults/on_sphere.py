"""The oracle of all that is said about bars: while one hangs in, the commanded way stays on its sphere.

As a process (``python -m tests.faults.on_sphere FILE ...``) it is ``python -m abbe.simulators ...`` that writes into FILE what went wrong.
"""

from __future__ import annotations

import asyncio
import json
import sys
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from abbe.simulators.world import World

NEAR_MM = 1.0
"""The bar's stroke."""
F = NDArray[np.float64]


class OnSphere:
    """Looks at every motion when it starts, all of it: a bar that hangs in must stay within its stroke, or come from the cup outwards."""

    def __init__(self, world: World, say: Callable[[str], None] | None = None) -> None:
        self.wrong: list[str] = []
        self.looked = 0
        self._say = say or self.wrong.append
        self._world, self._cup_mm, self._radius_mm, self._hangs = world, np.zeros(3), 0.0, False
        bar, controller = world.ballbar, world.controller
        mount, take_out, change, unmount, start = bar.mount, bar.take_out, bar.change, bar.unmount, controller._start

        def mounted(radius_mm: float, tool_mm: F, now_s: float) -> None:
            mount(radius_mm, tool_mm, now_s)
            self._cup_mm, self._radius_mm, self._hangs = controller.position_mm.copy(), radius_mm, True

        def taken_out() -> bool:
            self._hangs = False
            return take_out()

        def changed(radius_mm: float, now_s: float) -> bool:
            self._radius_mm, self._hangs = radius_mm, True
            self._look(np.stack([controller.position_mm] * 2), "a bar is hung in")
            return change(radius_mm, now_s)

        def unmounted() -> None:
            self._hangs = False
            unmount()

        def started(vertices_mm: F, feed_mm_min: float) -> None:
            self._look(vertices_mm, "a motion")
            start(vertices_mm, feed_mm_min)

        for device, name, instead in (
            (bar, "mount", mounted),
            (bar, "take_out", taken_out),
            (bar, "change", changed),
            (bar, "unmount", unmounted),
            (controller, "_start", started),
        ):
            setattr(device, name, instead)

    def _look(self, way_mm: F, what: str) -> None:
        if not self._hangs:
            return
        self.looked += 1
        off = np.linalg.norm(way_mm - self._cup_mm, axis=1)
        near = nearest(way_mm, self._cup_mm)
        low, high = self._radius_mm - NEAR_MM, self._radius_mm + NEAR_MM
        if off[0] < low and what == "a motion":  # it was mounted at the centre, and comes out
            low = off[0] - 1e-6
        if near < low or off.max() > high:
            self._say(
                f"{what} with the {self._radius_mm:g} mm bar goes {near:.2f}..{off.max():.2f} mm from the cup: "
                f"{way_mm[0].round(3).tolist()} to {way_mm[-1].round(3).tolist()}"
            )


def nearest(way_mm: F, place_mm: F) -> float:
    """Smallest distance of a polyline from a place."""
    begin, along = way_mm[:-1], np.diff(way_mm, axis=0)
    share = np.clip(((place_mm - begin) * along).sum(axis=1) / np.maximum((along * along).sum(axis=1), 1e-18), 0.0, 1.0)
    return float(np.linalg.norm(begin + share[:, None] * along - place_mm, axis=1).min())


@asynccontextmanager
async def looked_at(file: Path, args: list[str]) -> AsyncIterator[dict[str, Any]]:
    """Simulators as a child with this oracle; gives what they say when they are ready, and fails at the end if a bar left its sphere."""
    process = await asyncio.create_subprocess_exec(
        *words(file), *args, "--watch-stdin", stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE
    )
    assert process.stdin is not None
    assert process.stdout is not None
    try:
        yield json.loads(await process.stdout.readline())
    finally:
        process.stdin.close()
        await process.wait()
    wrong = await asyncio.to_thread(file.read_text)
    assert not wrong, wrong


def words(file: Path) -> list[str]:
    """The command line of such simulators."""
    return [sys.executable, "-m", "tests.faults.on_sphere", str(file)]


def main() -> int:
    """Put the oracle into every world that is made, then be the simulators."""
    from abbe.simulators.__main__ import main as serve

    file, made = Path(sys.argv[1]), World.__init__
    file.write_text("")

    def say(text: str) -> None:
        with file.open("a") as out:
            out.write(text + "\n")

    def with_oracle(self: World, *args: Any, **more: Any) -> None:
        made(self, *args, **more)
        OnSphere(self, say)

    World.__init__ = with_oracle  # type: ignore[method-assign]
    return serve(sys.argv[2:])


if __name__ == "__main__":
    sys.exit(main())
