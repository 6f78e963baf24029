"""Frames per second of one core: the product's framer of the ball-bar's box against what one would write first."""

from __future__ import annotations

import time
from collections.abc import Callable

from tests.experiments.bench.parser_case import CONTESTANTS, stream

NEED_HZ = 1000
FRAMES = 100_000
REPEATS = 5
WORDS = {
    "ours": "ours",
    "frame": "cut one frame after the other, struct, C check sum",
    "byte": "state machine, byte by byte, table check sum",
}


def compared(rounds: int, progress: Callable[[str], None]) -> dict:
    """All contestants in turns, so that a busy moment hits all; CPU time, the best counts. What they find is compared as well."""
    data, noisy = stream(FRAMES), stream(2_000, noise_every=50)
    times: dict[str, list[float]] = {name: [] for name in CONTESTANTS}
    for n in range(rounds * REPEATS):
        for name, framer in CONTESTANTS.items():
            progress(f"parsers, round {n + 1} of {rounds * REPEATS}: {name}")
            began = time.process_time()
            framer(data)
            times[name].append(time.process_time() - began)
    progress("")
    true, true_noisy = CONTESTANTS["ours"](data), CONTESTANTS["ours"](noisy)
    return {
        name: {
            "frames": FRAMES,
            "per_core_hz": FRAMES / min(times[name]),
            "right": CONTESTANTS[name](data) == true and len(true) == FRAMES,
            "lost_in_noise": len(true_noisy) - len(CONTESTANTS[name](noisy)),
        }
        for name in CONTESTANTS
    }


def lines(found: dict) -> list[str]:
    """The printed table."""
    out = ["", f"{'Ball-bar frames from bytes':<54}{'1/s per core':>14}{'x 1 kHz':>9}{'ours is x':>11}{'lost in noise':>15}"]
    for name, one in found.items():
        ratio = found["ours"]["per_core_hz"] / one["per_core_hz"]
        wrong = "" if one["right"] else "   DIFFERS"
        rate = one["per_core_hz"]
        out.append(f"  {WORDS[name]:<52}{rate:14,.0f}{rate / NEED_HZ:9,.0f}{ratio:11.1f}{one['lost_in_noise']:15}{wrong}")
    goal = 100_000
    met = "met" if found["ours"]["per_core_hz"] >= goal else "NOT MET"
    return [
        *out,
        f"  Goal: {goal:,} frames/s on one core: {met}. Lost in noise: good frames of 2,000 with 7 bytes of noise before every 50th.",
    ]
