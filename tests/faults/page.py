"""Writes docs/faults.md from the catalogue: ``python -m tests.faults.page`` (``--check``: only say whether it is current)."""

from __future__ import annotations

import sys
from pathlib import Path

from tests.faults.catalogue import Row, rows
from tests.faults.contract import OBLIGATIONS
from tests.written_page import run

PAGE = Path(__file__).resolve().parents[2] / "docs" / "faults.md"
_HEAD = """# Faults that are played on purpose

What can go wrong between Abbe and its devices, as rows of cases. Each case is played against real sockets, ptys and simulators by the test
named in its row, and judged by one checker (`tests/faults/contract.py`) on five obligations:

{obligations}

**A** is judged where the link itself raises an incident. What only leaves counted bytes, flagged samples or gaps in the stream (S2 to
S5, S7 to S9 and S12, the slow but timely answers of M5 and M6) is data, and whoever measures notes it in the run; the table shows
those cases as not judged (0/0), and this page counts rows, not obligations.

The test run prints the table of cases tried and passed at its end (`make test ARGS=tests/faults`). This page is written by
`python -m tests.faults.page` from the same lists that the tests take their cases from; a test checks that it is current.

| row | fault | cases | beyond the five obligations | test |
|---|---|---|---|---|
"""


def page() -> str:
    """The whole page."""
    found = rows()
    text = _HEAD.format(obligations="\n".join(f"- **{name}** {what}" for name, what in OBLIGATIONS.items()))
    text += "".join(f"| {r.name} | {r.fault} | {len(r.cases)} | {r.required} | `{r.test}` |\n" for r in found)
    text += f"\n{sum(len(r.cases) for r in found)} cases in all.\n"
    return text + _left_out(found) + "\n## The cases\n" + "".join(f"\n**{r.name}** {'; '.join(r.cases)}\n" for r in found)


def _left_out(found: list[Row]) -> str:
    lines = [f"- **{r.name}** {what}: {why}\n" for r in found for what, why in r.left_out]
    return "\n## Left out, and why\n\n" + "".join(lines) if lines else ""


if __name__ == "__main__":
    sys.exit(run(PAGE, page, "tests.faults.page", __doc__))
