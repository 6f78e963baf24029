"""The table in force as mbpoll reads it, a Modbus client that nobody here wrote: its numbers, put together by docs/protocols/cnc.md alone.

mbpoll itself decodes: 16-bit numbers with their sign, 32-bit numbers from two registers, high word first. Nothing of ours takes part.
"""

from __future__ import annotations

import asyncio
import re
import subprocess
from dataclasses import dataclass

ACTIVE_BANK, BANKS, BODY = 208, (1000, 6000), 24
AT_MOST = 120
TEN_NM_MM, NM_MM = 1e-5, 1e-6


@dataclass(frozen=True, slots=True)
class Polled:
    """``position_mm[a]``: grid of input axis a; ``correction_mm[a][i]``: correction of output i there; ``bank``: which one."""

    bank: int
    table_id: int
    position_mm: list[list[float]]
    correction_mm: list[list[list[float]]]


async def poll(port: int, address: int, count: int, kind: str = "4") -> list[int]:
    """Numbers from a register on: ``kind`` 4, 16 bits with their sign; 4:int, 32 bits."""
    width = 2 if kind == "4:int" else 1
    found: list[int] = []
    for first in range(0, count, AT_MOST // width):
        n = min(AT_MOST // width, count - first)
        options = ["-m", "tcp", "-p", str(port), "-a", "1", "-0", "-1", "-q", "-B", "-t", kind]
        words = ["mbpoll", *options, "-r", str(address + first * width), "-c", str(n), "127.0.0.1"]
        told = await asyncio.to_thread(subprocess.run, words, capture_output=True, text=True, timeout=20, check=True)
        # a 16-bit number of 32768 or more is shown twice: "65533 (-3)"
        numbers = re.findall(r"^\[\d+\]:\s+(-?\d+)(?: \((-\d+)\))?$", told.stdout, re.MULTILINE)
        assert len(numbers) == n, told.stdout
        found += [int(signed or plain) for plain, signed in numbers]
    return found


async def poll_table(port: int) -> Polled:
    """Nine one-axis tables of the bank that is in force."""
    (bank,) = await poll(port, ACTIVE_BANK, 1)
    base = BANKS[bank]
    magic, form, kind, length = await poll(port, base, 4)
    assert (magic & 0xFFFF, form, kind) == (0xABBE, 1, 1)
    (table_id,) = await poll(port, base + 4, 1, "4:int")
    (lsb_nm,) = await poll(port, base + 6, 1)
    counts = await poll(port, base + 8, 3)
    assert length == BODY + 3 * sum(counts)
    start, step = await poll(port, base + 12, 3, "4:int"), await poll(port, base + 18, 3, "4:int")
    body = iter(await poll(port, base + BODY, length - BODY))
    position = [[(start[a] + k * step[a]) * TEN_NM_MM for k in range(counts[a])] for a in range(3)]
    correction = [[[next(body) * lsb_nm * NM_MM for _ in range(counts[a])] for _ in range(3)] for a in range(3)]
    return Polled(bank, table_id, position, correction)
