"""Gaps, duplicates, latecomers and restarts told apart by numbers and device time alone."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from abbe.drivers.api import BarSample
from abbe.drivers.ballbar.stream import SequenceRestart, SequenceTracker


def bar(seq: int, us: int | None = None) -> BarSample:
    return BarSample(seq % 2**32, 5_000_000 + 1000 * seq if us is None else us, 0, 0)


def test_no_gap_is_one_run():
    tracker = SequenceTracker(1000)
    (run,) = tracker.accept([bar(i) for i in range(10)])
    assert (run.missing, len(run.samples)) == (0, 10)
    (run,) = tracker.accept([bar(10)])
    assert run.missing == 0


def test_gaps_split_runs():
    tracker = SequenceTracker(1000)
    runs = tracker.accept([bar(2), bar(3), bar(7), bar(8)])
    assert [(run.missing, [s.seq for s in run.samples]) for run in runs] == [(2, [2, 3]), (3, [7, 8])]


def test_duplicates_and_latecomers_are_dropped_and_counted():
    tracker = SequenceTracker(1000)
    runs = tracker.accept([bar(0), bar(0), bar(1), bar(3), bar(2), bar(4)])
    assert [(run.missing, [s.seq for s in run.samples]) for run in runs] == [(0, [0, 1]), (1, [3, 4])]
    assert tracker.duplicates == 2


def test_the_number_wraps():
    tracker = SequenceTracker(1000)
    tracker._next = 2**32 - 2
    (run,) = tracker.accept([bar(2**32 - 2), bar(2**32 - 1), bar(2**32), bar(2**32 + 1)])
    assert [s.seq for s in run.samples] == [2**32 - 2, 2**32 - 1, 0, 1]


@pytest.mark.parametrize(
    "restart",
    [bar(0), bar(0, 1000), bar(999, 3_000), bar(1500, 3_000)],
    ids=["old number", "new boot", "recent number, other clock", "later number, earlier clock"],
)
def test_a_restart_is_never_joined(restart):
    tracker = SequenceTracker(1000)
    tracker.accept([bar(i) for i in range(1000)])
    with pytest.raises(SequenceRestart):
        tracker.accept([restart])


@given(st.sets(st.integers(0, 300), min_size=1), st.lists(st.integers(1, 50)))
def test_every_sample_is_delivered_or_missing(present, sizes):
    tracker = SequenceTracker(1000)
    samples = [bar(i) for i in sorted(present)]
    runs = []
    while samples:
        size = sizes.pop() if sizes else len(samples)
        runs += tracker.accept(samples[:size])
        samples = samples[size:]
    assert sum(run.missing + len(run.samples) for run in runs) == max(present) + 1
    assert [s.seq for run in runs for s in run.samples] == sorted(present)
