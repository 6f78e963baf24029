"""Files of instruments, written for these tests after the formats' public readers and writers."""

from __future__ import annotations

from collections.abc import Sequence

ENVIRONMENT = """
ENVIRONMENT::
Air temp    : 20.5 20.6 20.7
Air press   : 1012.1 1012.2 1012.3
Air humid   : 45 45 46
Mat temp 1  : 21.0 21.2 21.4
Mat temp 2  : 21.2 21.4 21.6
Mat temp 3  : 0.0 0.0 0.0
Env factor  : 1.0002 1.0002 1.0002
Exp coeff   : 0.0 0.0 0.0
Date Time   : "2026-11-22 10:00" "2026-11-22 10:10" "2026-11-22 10:20"
"""


def renishaw(
    runs: Sequence[Sequence[float]] = ((0, -5, -11), (3, -2.5, -8), (0, -5, -11), (3, -2.5, -8)),
    targets: Sequence[float] = (0, 100, 200),
    *,
    both: bool = True,
    kind: str = "rtl",
    user: str = "Machine:VMC-1\nSerial No:1\nDate:2026-11-22 10:00:00\nBy:a\nAxis:X\nLocation:b\nTITLE:t",
    environment: str = "",
) -> str:
    """A .rtl or .rta; each run holds its deviations in the order of the targets, and every second one is written backwards if ``both``."""
    owner = {"rtl": "Linear", "rta": "Angular"}[kind]
    rows = []
    for number, run in enumerate(runs, start=1):
        order = range(len(targets)) if not both or number % 2 else reversed(range(len(targets)))
        rows += [f"{number}   {t + 1}      {float(run[t])}" for t in order]
    written = "\n".join("  ".join(f"{t:.4f}" for t in targets[k : k + 5]) for k in range(0, len(targets), 5))
    return f"""HEADER::
File type  : {kind}
Owner      : {owner}
Version no : V20.02.02

TARGET DATA::
Filetype  : ISO
Target-count: {len(targets)}
Targets :
{written}
Flags: 0 {0 if both else 1} 2 0

USER-TEXT::
{user}

RUNS::
Run-count:{len(runs)}

DEVIATIONS::
Run Target Data:
{chr(10).join(rows)}
{environment}
EOF::
"""
