"""Files of instruments, written for these tests after the formats' public readers and writers."""

from __future__ import annotations

import struct
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


POS = """Machine: VMC-1
Axis: Y
Date: 2026-11-22

Position   \tBidirectional Avg Error
0.0000\t0.0015
100.0000\t-0.00375
200.0000\t-0.0095
Position   \tForward Directional Avg Error
0.0000\t0.0000
100.0000\t-0.0050
200.0000\t-0.0110
Position   \tReverse Directional Avg Error
0.0000\t0.0030
100.0000\t-0.0025
200.0000\t-0.0080
"""

REN = """Machine: VMC-1
Axis: X
Compensation type : combined
Compensation units : micrometres
Compensation spacing : 50.000
Compensation start   : 0.000
Compensation end     : 150.000

No.     Axis position        Combined
1       0.000                0.0
2       50.000               -1.5
3       100.000              -3.0
4       150.000              2.5
"""

B5R = """<?xml version="1.0" encoding="{encoding}"?>
<BALLBAR_TEST>
 <TEST_SPEC NAME="XY 360 150mm"/>
 <OPERATOR>a</OPERATOR>
 <DATE_STARTED>2026-11-22</DATE_STARTED>
 <MACHINE_TESTED NAME="{machine}"/>
 <SERIAL_NUMBER>172001002</SERIAL_NUMBER>
 <PLANE TEST_PLANE="XY"/>
 <ANALYSIS><RENISHAW_DIAGNOSTICS>
  <FEATURE NAME="AF_CIRCULARITY" DT="UT_LENGTH_UM">11.4</FEATURE>
  <FEATURE NAME="AF_CIRCULARITY" DT="UT_RANKING">3</FEATURE>
  <FEATURE NAME="AF_CIRCULARITY" DT="UT_PERCENT">12.0</FEATURE>
  <FEATURE NAME="AF_SQUARENESS" DT="UT_SQUARENESS">-18.2</FEATURE>
  <FEATURE NAME="AF_SERVO_MISMATCH" DT="UT_SERVO_MISMATCH">0.21</FEATURE>
  <FEATURE NAME="AF_BACKLASH_A_POS" DT="UT_LENGTH_UM">-2.6</FEATURE>
 </RENISHAW_DIAGNOSTICS><OTHER>
  <FEATURE NAME="AF_CIRCULARITY" DT="UT_LENGTH_UM">99.0</FEATURE>
 </OTHER></ANALYSIS>
</BALLBAR_TEST>
"""


def rtx(samples: Sequence[float] = (0.0, 1.5e-3, -2.0), rate: str = "50000.0", count: object = None, end: bytes = b"EOF::\r\n") -> bytes:
    """A .rtx with the names of the one real header that is public."""
    facts = {
        "Owner": "CARTO-Dynamic", "Version no": "4.13.9237.28405", "File Type": "rtx", "Velocity": "0.0", "Sample rate": "50000.0",
        "Sample no": len(samples) if count is None else count, "Actual sample rate": rate, "Trigger point": "0.0",
        "Trigger interval": "2e-05", "Flags": "0 1 2 0 2", "Machine": "", "Serial No": "", "Date": "10/02/2025 12:58:22", "By": "User",
        "Axis": "", "Location": "",
    }  # fmt: skip
    head = "".join(f"{key}: {value}\r\n" for key, value in facts.items())
    return f"HEADER::\r\n{head}Data:\r\n".encode() + struct.pack(f"<{len(samples)}d", *samples) + end


TABLE = """Axis test of mill 7
Target;Reading;Dir;Air
0,0;0,0000;+;20,5
100,0;99,9950;+;20,5
200,0;199,9890;+;20,6
200,0;199,9920;-;20,6
100,0;99,9975;-;20,6
0,0;0,0030;-;20,6
"""
COLUMNS = """axis = "X"
heading = 2
decimal = ","
[target]
column = "Target"
unit = "mm"
[measured]
column = "Reading"
unit = "mm"
[direction]
column = "Dir"
[air_temperature]
column = "Air"
unit = "C"
"""
