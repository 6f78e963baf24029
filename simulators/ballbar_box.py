"""``python -m abbe.simulators.ballbar_box``: only a ball-bar's box, on a pseudo terminal, at any speed. Writes the fates of its samples."""

import argparse
import asyncio
import json
import os
import secrets
import signal
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from abbe.simulators.ballbar.port import BUFFER_BYTES, PtyPort
from abbe.simulators.ballbar.wire import BallbarWire
from abbe.simulators.scenario import DEFAULT_PATH, load
from abbe.simulators.world import World

TICK_S = 0.002
RADIUS_MM = 100.0


def main(argv: Sequence[str]) -> int:
    """Run until standard input ends or SIGTERM comes, and return the exit code."""
    parser = argparse.ArgumentParser(prog="abbe.simulators.ballbar_box", description="Only a ball-bar's box, on a pseudo terminal.")
    parser.add_argument("--link", type=Path, required=True, help="stable path of the serial line")
    parser.add_argument("--ledger", type=Path, required=True, help="file for the fate of every sample, written at every STOP")
    parser.add_argument("--speed", type=float, default=1.0, help="device seconds per second; 20 at 1000 Hz gives 20,000 samples per second")
    parser.add_argument("--spoil-every", type=int, default=0, help="flip a bit in every n-th sample")
    parser.add_argument("--buffer-kib", type=int, default=BUFFER_BYTES // 1024, help="buffer of the box for a slow host")
    parser.add_argument("--samples", type=int, default=0, help="stop a stream after this many samples")
    return asyncio.run(_serve(parser.parse_args(argv)))


async def _serve(options: argparse.Namespace) -> int:
    box = _Box(options)
    await box.port.open(box.received)
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    loop.add_signal_handler(signal.SIGTERM, stop.set)
    loop.add_reader(sys.stdin.fileno(), lambda: None if os.read(sys.stdin.fileno(), 1024) else stop.set())
    sys.stdout.write(json.dumps({"ready": True, "ballbar": box.port.url}) + "\n")
    sys.stdout.flush()
    box.tick()
    await stop.wait()
    box.wire.ledger.write(options.ledger)
    await box.port.close()
    return 0


class _Box:
    """The box of a ball-bar at a machine that stands still."""

    def __init__(self, options: argparse.Namespace) -> None:
        world = World(load(DEFAULT_PATH))
        self._device, self._options = world.ballbar, options
        self._axes = np.array(world.controller.position_mm, dtype=np.float64)
        self._device.mount(RADIUS_MM, world.tool_position() + np.array([RADIUS_MM, 0.0, 0.0]), 0.0)
        self.port = PtyPort(options.link, 1024 * options.buffer_kib)
        self._loop = asyncio.get_running_loop()
        self._begin_s = self._loop.time()
        self.wire = BallbarWire(self._device, self.port, secrets.randbits(32), self._now_s)
        self.wire.spoil_every = options.spoil_every
        self._streamed = False

    def _now_s(self) -> float:
        return (self._loop.time() - self._begin_s) * float(self._options.speed)

    def received(self, data: bytes) -> None:
        """Take the host's bytes."""
        self._advance()
        self.wire.received(data)
        if self._streamed and not self._device.rate_hz:
            self._streamed = False
            self.wire.ledger.write(self._options.ledger)

    def tick(self) -> None:
        """Send the samples that are due, and repeat this every `TICK_S`."""
        self._advance()
        self.wire.flush()
        self.port.pump()
        self._loop.call_later(TICK_S, self.tick)

    def _advance(self) -> None:
        due = self._device.due_s(self._now_s())
        if not len(due):
            return
        self._streamed = True
        count = len(due)
        if self._options.samples:
            count = min(count, self._options.samples - self.wire.samples_sent - self.wire.samples_dropped)
        if count > 0:
            self._device.record(np.repeat(self._axes[None, :], count, axis=0), np.ones(count, dtype=np.bool_))
            self.wire.flush()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
