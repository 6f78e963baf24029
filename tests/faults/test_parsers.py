"""Spoilt frames against all parsers; the whole million runs with ABBE_TEST_LONG=1, or as ``python -m
tests.experiments.campaigns.parsers``."""

from __future__ import annotations

import os

from tests.experiments.campaigns.parser_mutations import SHARES, WAYS, spoil

FRAMES = 1_000_000 if os.environ.get("ABBE_TEST_LONG") == "1" else 100_000


def test_no_parser_gives_way():
    found = spoil(FRAMES, seed=6)
    assert sum(tally.frames for tally in found.values()) == FRAMES
    for name in SHARES:
        assert found[name].good(), (name, found[name])
    assert len(found["ball-bar"].ways) == len(WAYS)
    # CRC-16 lets one damaged frame in 65536 through; what that one meets is the second gate (row S4)
    assert found["ball-bar"].swallowed <= 10 * FRAMES * SHARES["ball-bar"] / 65536
    assert found["ball-bar"].false <= 10 * FRAMES * SHARES["ball-bar"] / 65536
    assert found["rtu"].false <= 10 * FRAMES * SHARES["rtu"] / 65536
    assert found["registers"].false == 0


def test_a_parser_that_gives_way_is_found():
    tally = spoil(1000, seed=6)["ball-bar"]
    assert tally.good()
    tally.single_bit_accepted += 1
    assert not tally.good()
