"""The mistakes of `tests.experiments.campaigns.source_mutants` that take seconds: all at once in a copy of the tree, each noticed by its
own test."""

from __future__ import annotations

import pytest

from tests.experiments.campaigns.mutants import ROOT, copied, noticed, page, patched, stale
from tests.experiments.campaigns.source_mutants import MUTANTS, Mutant

FAST = [mutant for mutant in MUTANTS if mutant.fast]


def test_every_mistake_is_one_line_of_a_table_with_a_test_that_exists() -> None:
    assert len({mutant.name for mutant in MUTANTS}) == len(MUTANTS)
    assert [mutant.name for mutant in MUTANTS if stale(mutant)] == []
    for mutant in MUTANTS:
        assert mutant.old != mutant.new
        assert mutant.tests
        for test in mutant.tests:
            path, _, name = test.partition("::")
            assert f"def {name}" in (ROOT / path).read_text(encoding="utf-8"), test


@pytest.mark.timeout(300)
def test_the_fast_ones_are_noticed() -> None:
    assert [mutant.name for mutant in FAST if stale(mutant)] == []
    tests = [test for mutant in FAST for test in mutant.tests]
    assert len({mutant.path for mutant in FAST}) == len(FAST), "each in a file of its own: none hides another"
    with copied() as copy, patched(copy, FAST):
        found = noticed(copy, tests)
    for mutant in FAST:
        assert any(failed.startswith(test) for test in mutant.tests for failed in found.failed), (mutant.name, found.said)
    assert "Timeout" not in found.said


def test_a_mistake_that_nobody_notices_is_said_and_the_copy_is_put_right() -> None:
    harmless = Mutant("harmless", "drivers/ballbar/stream.py", "_LATE_WINDOW = 128", "_LATE_WINDOW = 129", ())
    with copied() as copy:
        path = copy / harmless.path
        before = path.read_text(encoding="utf-8")
        with patched(copy, [harmless]):
            assert "_LATE_WINDOW = 129" in path.read_text(encoding="utf-8")
            assert stale(harmless, copy)
        assert path.read_text(encoding="utf-8") == before
    assert "- **SURVIVED** in `drivers/ballbar/stream.py`: harmless" in page([(harmless, "SURVIVED", "")])
