"""A change that is surely there is named, also beside a larger one that is not."""

from __future__ import annotations

from abbe.service.discovery.changed_text import largest_sure


def test_the_largest_change_beyond_its_uncertainty_is_named() -> None:
    assert largest_sure({"EZZ": (12e-6, 10e-6), "EXX": (10e-6, 2e-6), "C0Y": (-5e-6, 1e-6)}) == "EXX"
    assert largest_sure({"EZZ": (12e-6, 10e-6), "EXX": (3e-6, 2e-6)}) is None
    assert largest_sure({}) is None
