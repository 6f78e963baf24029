"""A machine that is corrected again does not become worse. Ten machines, three times each: `tests.experiments.campaigns.repeated`."""

import os

import pytest

from tests.experiments.campaigns.repeated import Round, rounds_of, summary

pytestmark = [pytest.mark.scenario, pytest.mark.timeout(900)]


@pytest.mark.skipif(not os.environ.get("ABBE_TEST_LONG"), reason="two whole corrections: ABBE_TEST_LONG=1 plays them")
async def test_the_second_correction_is_kept_or_refused_and_harms_nothing(tmp_path):
    first, second = await rounds_of(2, 2, 60.0, tmp_path)
    assert first.end == "kept", first.why
    assert first.after_um < 0.5 * first.before_um
    assert second.end in ("kept", "refused"), second.why
    assert not second.worse


def test_the_summary_counts_what_became_worse():
    better, worse = (Round(1, n, 10.0, after, 2.0, None, "kept", "") for n, after in ((1, 3.0), (2, 10.3)))
    assert [better.worse, worse.worse] == [False, True]
    assert summary([better, worse])[-1] == "made worse: 1 of 2"
