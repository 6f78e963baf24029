"""Writes docs/reference/faults.md from the catalogue: ``python -m tests.faults.page`` (``--check``: only say whether it is current)."""

from __future__ import annotations

import sys
from pathlib import Path

from tests.faults.catalogue import Row, rows
from tests.faults.contract import OBLIGATIONS
from tests.written_page import run

PAGE = Path(__file__).resolve().parents[2] / "docs" / "reference" / "faults.md"
_HEAD = """# Faults that the tests play

What can go wrong between Abbe and its devices. The test named in a row plays each of its cases against real sockets, pseudo-terminals and
simulators. One checker (`tests/faults/contract.py`) judges five obligations:

{obligations}

**A** is judged where the link itself raises an incident. Faults that only leave counted bytes, flagged samples or gaps (S2 to S5, S7 to S9,
S12, and the slow but timely answers of M5 and M6) are data; the run records them.

`make test ARGS=tests/faults` prints the cases tried and passed; `make test ARGS='tests/faults --collect-only'` names every case.
`python -m tests.faults.page` writes this page; a test checks that it is current.

| row | fault | cases | beyond the five obligations | test |
|---|---|---|---|---|
"""


def page() -> str:
    """The whole page."""
    found = rows()
    text = _HEAD.format(obligations="\n".join(f"- **{name}** {what}" for name, what in OBLIGATIONS.items()))
    text += "".join(f"| {r.name} | {r.fault} | {len(r.cases)} | {r.required} | `{r.test}` |\n" for r in found)
    text += f"\n{sum(len(r.cases) for r in found)} cases in all.\n"
    return text + _left_out(found)


def _left_out(found: list[Row]) -> str:
    lines = [f"- **{r.name}** {what}: {why}\n" for r in found for what, why in r.left_out]
    return "\n## Left out, and why\n\n" + "".join(lines) if lines else ""


if __name__ == "__main__":
    sys.exit(run(PAGE, page, "tests.faults.page", __doc__))
