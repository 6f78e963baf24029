"""A million spoilt frames against all parsers: ``python -m tests.experiments.campaigns.parsers`` (``--help``). Exits with 1 when one gives
way."""

from __future__ import annotations

import argparse
import sys
import time

from abbe.simulators.faults.serial_bytes import Sample
from tests.experiments.bench.parser_case import framed, stream
from tests.experiments.campaigns.parser_mutations import SHARES, spoil

HANG_S = 0.01
LEAST_PER_S = 100_000


def main() -> int:
    """Spoil, count, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=1_000_000, help="how many frames are spoilt in all (default 1,000,000)")
    parser.add_argument("--seed", type=int, default=1, help="other damage (default 1)")
    options = parser.parse_args()

    def progress(done: int) -> None:
        sys.stderr.write(f"\r{done:,} of {options.frames:,} frames ")
        sys.stderr.flush()

    began = time.perf_counter()
    found = spoil(options.frames, options.seed, progress)
    sys.stderr.write("\r" + " " * 40 + "\r")
    columns = ("frames", "crashes", "not_resynchronised", "single_bit_accepted", "kept_too_much", "swallowed", "false")
    sys.stdout.write(f"{'parser':10}" + "".join(f"{name.replace('_', ' '):>20}" for name in columns) + f"{'slowest [ms]':>14}\n")
    for name in SHARES:
        tally = found[name]
        sys.stdout.write(f"{name:10}" + "".join(f"{getattr(tally, c):>20,}" for c in columns) + f"{1e3 * tally.slowest_s:>14.2f}\n")
        if tally.first_crash:
            sys.stdout.write(f"{'':10}first crash: {tally.first_crash}\n")
    rate = framed(stream(200_000))
    sys.stdout.write(f"{sum(t.frames for t in found.values()):,} frames in {time.perf_counter() - began:.0f} s; ")
    sys.stdout.write(f"the framer takes {rate:,.0f} frames/s of one core ({len(Sample(0, 0, 0, 0).frame())} bytes each)\n")
    good = all(tally.good() and tally.slowest_s < HANG_S for tally in found.values()) and rate >= LEAST_PER_S
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
