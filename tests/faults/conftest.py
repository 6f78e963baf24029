"""The fault matrix prints its table at the end of the test run."""

from __future__ import annotations

import pytest

from tests.faults.catalogue import rows
from tests.faults.contract import BOOK


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Rows, cases tried and passed, obligations kept; and which enumerated cases were not played."""
    if not BOOK.rows:
        return
    terminalreporter.section("fault matrix")
    for line in BOOK.table():
        terminalreporter.write_line(line)
    for row in rows():
        if row.name in BOOK.rows and (missing := sorted(set(row.cases) - BOOK.rows[row.name].cases)):
            terminalreporter.write_line(f"{row.name}: {len(missing)} cases not played in this run, e.g. {missing[0]}")
