"""The second gate of a stream: what number, clock, stroke, slew and settings say about a sample that passed the check sum."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from abbe.drivers.api import BarSample
from abbe.drivers.ballbar.stream import OtherPace, OtherSettings, Reads, SequenceRestart, SequenceTracker

READS = Reads(number=3, range_nm=1_000_000)
NUMBER = 3 << 8


def bar(seq: int, nm: int = 0, us: int | None = None, status: int = NUMBER) -> BarSample:
    return BarSample(seq % 2**32, 5_000_000 + 1000 * seq if us is None else us, nm, status)


def run(*samples: BarSample, reads: Reads | None = READS) -> tuple[SequenceTracker, list[int]]:
    tracker = SequenceTracker(1000, reads)
    return tracker, [sample.seq for piece in tracker.accept(list(samples)) for sample in piece.samples]


@pytest.mark.parametrize(
    "stray",
    [bar(900, us=5_005_000), bar(5, us=5_100_000), bar(5, nm=2_000_000), bar(5, status=4 << 8), bar(5, nm=300_000)],
    ids=["number", "clock", "stroke", "settings", "slew"],
)
def test_one_sample_that_cannot_be_is_a_gap(stray):
    tracker, seqs = run(*(bar(i) for i in range(5)), stray, *(bar(i) for i in range(6, 10)))
    assert seqs == [0, 1, 2, 3, 4, 6, 7, 8, 9]
    assert (tracker.strays, tracker.lost, tracker.accepted) == (1, 1, 9)


def test_a_step_is_a_measurement():
    _, seqs = run(*(bar(i) for i in range(5)), *(bar(i, nm=300_000) for i in range(5, 10)))
    assert seqs == list(range(10))


def test_a_reading_that_the_box_itself_refuses_is_handed_on():
    out = [bar(i, nm=1_000_000, status=NUMBER | 1) for i in range(5, 8)]
    none = [bar(i, status=NUMBER | 16) for i in range(8, 10)]
    _, seqs = run(*(bar(i) for i in range(5)), *out, *none, *(bar(i, nm=400_000) for i in range(10, 12)))
    assert seqs == list(range(12))


@pytest.mark.parametrize(
    ("second", "kind"),
    [
        ([bar(5, us=5_009_000), bar(6, us=5_010_000)], OtherPace),
        ([bar(5, status=4 << 8), bar(6, status=4 << 8)], OtherSettings),
        ([bar(2), bar(0, us=17)], SequenceRestart),
    ],
    ids=["clock jumped", "switched", "restarted"],
)
def test_two_in_a_row_end_the_segment_and_what_was_good_is_kept(second, kind):
    tracker = SequenceTracker(1000, READS)
    with pytest.raises(kind) as end:
        tracker.accept([*(bar(i) for i in range(5)), *second, bar(7)])
    assert [sample.seq for piece in end.value.runs for sample in piece.samples] == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("factor", [0.5, 2.0, 10.0])
def test_another_rate_is_found_at_once(factor):
    tracker = SequenceTracker(1000, None)
    with pytest.raises(OtherPace, match="took the device"):
        tracker.accept([bar(i, us=round(1000 * i / factor), status=0) for i in range(5)])
    assert tracker.accepted == 1


def test_jitter_is_allowed():
    _, seqs = run(*(bar(i, us=1000 * i + (i * 37) % 40) for i in range(200)))
    assert seqs == list(range(200))


@pytest.mark.parametrize("rate_hz", [100, 500, 1000])
@pytest.mark.parametrize("late", [-0.3, -0.06, 0.06, 0.1, 0.3])
def test_a_clock_that_is_off_by_more_than_a_twentieth_of_a_period_does_not_confirm_the_number(rate_hz, late):
    """At 0.1 of a period and 50 mm/s the reading belongs to another place, 5 µm away at 1 kHz: such a sample is missing, not taken."""
    period_us = 1_000_000 // rate_hz
    at_us = [5_000_000 + period_us * i for i in range(10)]
    at_us[5] += round(late * period_us)
    tracker = SequenceTracker(rate_hz, READS)
    runs = tracker.accept([bar(i, us=us) for i, us in enumerate(at_us)])
    assert [(run.missing, [sample.seq for sample in run.samples]) for run in runs] == [(0, [0, 1, 2, 3, 4]), (1, [6, 7, 8, 9])]
    assert (tracker.strays, tracker.lost) == (1, 1)


@pytest.mark.parametrize("late", [-0.04, 0.04])
def test_a_clock_that_is_off_by_less_confirms_it(late):
    _, seqs = run(*(bar(i, us=5_000_000 + 1000 * i + round(1000 * late) * (i == 5)) for i in range(10)))
    assert seqs == list(range(10))


def test_without_settings_only_number_and_clock_count():
    _, seqs = run(*(bar(i, nm=(-1) ** i * 2_000_000_000, status=i << 8 & 0xFF00) for i in range(20)), reads=None)
    assert seqs == list(range(20))


def test_loss():
    tracker = SequenceTracker(1000)
    tracker.accept([bar(i) for i in range(5000)])
    tracker.accept([bar(i) for i in range(5010, 10_000)])
    assert (tracker.lost, tracker.too_lossy, tracker.was_lossy) == (10, False, False)
    tracker.accept([bar(10_001)])
    assert (tracker.lost, tracker.too_lossy, tracker.was_lossy) == (11, True, True)


def test_what_the_box_itself_lost_is_not_the_lines_loss():
    tracker = SequenceTracker(1000)
    (first, second) = tracker.accept([bar(0), bar(500, status=4), bar(501)])
    assert (first.missing, second.missing) == (0, 499)
    assert (tracker.overrun, tracker.lost, tracker.was_lossy) == (499, 0, False)


@given(st.lists(st.tuples(st.integers(0, 300), st.integers(-(10**6), 10**6), st.integers(-2000, 2000)), max_size=60), st.integers(1, 7))
def test_whatever_comes_is_in_order_and_accounted_for(raw, size):
    tracker = SequenceTracker(1000, READS)
    samples = [bar(seq, nm, 5_000_000 + 1000 * seq + off) for seq, nm, off in raw]
    runs = []
    try:
        for at in range(0, len(samples), size):
            runs += tracker.accept(samples[at : at + size])
    except (SequenceRestart, OtherPace, OtherSettings) as end:
        runs += end.runs
    expected = 0
    for piece in runs:
        expected += piece.missing
        for sample in piece.samples:
            assert sample.seq == expected
            expected += 1
    assert tracker.accepted + tracker.lost == expected
