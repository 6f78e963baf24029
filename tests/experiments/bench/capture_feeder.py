"""A ball-bar's box that sends as fast as the host reads: ``python -m tests.experiments.bench.capture_feeder SAMPLES``. Prints the
terminal's path."""

from __future__ import annotations

import os
import sys
import tty

import numpy as np

from abbe.simulators.ballbar.device import Samples
from abbe.simulators.ballbar.wire import IDENTIFY, START, Parser, encode_ack, encode_info, encode_samples
from tests.experiments.bench.capture_case import device_us, reading_nm

BLOCK = 1000


def main() -> int:
    """Answer commands; after a START send all samples, as the terminal takes them."""
    total = int(sys.argv[1])
    blocks = [_block(first, min(BLOCK, total - first)) for first in range(0, total, BLOCK)]  # encoded before the clock starts
    master, slave = os.openpty()
    tty.setraw(master)
    tty.setraw(slave)
    sys.stdout.write(os.ttyname(slave) + "\n")
    sys.stdout.flush()
    parser = Parser()
    while True:
        for kind, payload in parser.feed(os.read(master, 4096)):
            tag = int.from_bytes(payload[:2], "little")
            if kind == IDENTIFY:
                os.write(master, encode_info(tag, 1, 0))
                continue
            os.write(master, encode_ack(tag, kind, 0))
            if kind == START:
                for block in blocks:
                    rest = memoryview(block)
                    while rest:
                        rest = rest[os.write(master, rest) :]


def _block(first: int, count: int) -> bytes:
    seq = np.arange(first, first + count)
    return encode_samples(Samples(seq, device_us(seq), reading_nm(seq), np.full(count, 8)))


if __name__ == "__main__":
    sys.exit(main())
