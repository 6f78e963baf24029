"""The campaign of late, doubled and abandoned replies in small: none of ours is wrong, and the stock client shows that the test can tell.

Full size: ``python -m tests.experiments.campaigns.late_replies --trials 100000``.
"""

from __future__ import annotations

import logging
import os

import pytest

from tests.experiments.campaigns.late_replies import campaign
from tests.faults.patient import patience

LONG = bool(os.environ.get("ABBE_TEST_LONG"))
TRIALS, TIMEOUT_S, LINES = (100_000, 0.05, 64) if LONG else (108, 0.1, 36)  # in CI a busy computer must not look like a slow device


@pytest.fixture(scope="module", autouse=True)
def _patient():
    with patience():
        yield


@pytest.mark.timeout(1800 if LONG else 300)
@pytest.mark.parametrize("transport", ["tcp", "rtu"])
async def test_our_client_never_takes_another_transactions_reply(transport):
    tally = await campaign(transport, TRIALS, timeout_s=TIMEOUT_S, lines=LINES)
    assert tally.trials == TRIALS
    assert tally.wrong == 0, tally.lines()
    right = sum(n for (_, outcome), n in tally.counts.items() if outcome == "right")
    assert right > TRIALS  # three operations in a trial: a client that only reports errors would be right too, and useless


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
async def test_the_stock_client_over_rtu_does(caplog):
    caplog.set_level(logging.CRITICAL, logger="pymodbus")
    logger = logging.getLogger("pymodbus")
    before = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        tally = await campaign("rtu", 200, stock=True, lines=16)
    finally:
        logger.setLevel(before)
    assert tally.wrong > 20, tally.lines()
