"""The push protocol against every fault: no invariant is violated; with a protection taken away, one is.

Here all single faults and a fixed sample of the double ones; all of them by ``python -m tests.experiments.campaigns.push sweep``.
"""

from __future__ import annotations

import os

import pytest

from tests.push.invariants import CHECKS
from tests.push.loading import edited, real
from tests.push.mutants import BY_PROBE, MUTANTS
from tests.push.sweep import CASES, PAIRED, Count, doubles, first_violation, run, singles
from tests.push.variants import VARIANTS, Variant
from tests.push.world import World

LONG = os.environ.get("ABBE_TEST_LONG") == "1"
"""All mutants; every day a third of them."""
SAMPLE = 421
"""Every so manieth pair of faults."""


def test_every_invariant_has_its_checker() -> None:
    assert set(CHECKS) == {f"I{k}" for k in range(1, 21)} | {"C3"}


def test_no_single_fault_violates_anything() -> None:
    count = singles(real())
    assert count.examples == []
    assert count.combinations > 4000
    assert set(count.ends) == {"KEEP", "ROLLED_BACK", "ABORTED", "REJECTED", "OPERATOR", "nothing begun"}


@pytest.mark.parametrize("case", PAIRED, ids=lambda case: case.name)
def test_no_second_fault_violates_anything(case) -> None:
    count = doubles(real(), case, every=SAMPLE)
    assert count.examples == []
    assert count.combinations > 250


@pytest.mark.parametrize("variant", VARIANTS, ids=lambda variant: variant.name)
def test_without_a_protection_the_sweep_sees_it(variant: Variant) -> None:
    count = singles(edited(variant.edits), (variant.case,), until=frozenset(variant.must))
    assert set(variant.must) <= set(count.violated), count.violated


@pytest.mark.parametrize("name", MUTANTS if LONG else list(MUTANTS)[::3])
def test_every_mutant_is_killed(name: str) -> None:
    assert first_violation(edited(MUTANTS[name]))


def test_a_sign_that_both_codecs_exchange_is_stopped_by_the_probe_alone() -> None:
    world = World(edited(MUTANTS[BY_PROBE]), CASES[0], {})
    assert world.run() == []
    entries = {str(entry.state): entry.doc for entry in world.journal}
    assert "STAGED" in entries
    assert "PROBATION" in entries
    assert entries["ROLLBACK"]["why"].startswith("probe: moved -")
    assert str(world.journal[-1].state) == "ROLLED_BACK"


def test_the_same_plan_gives_the_same_run() -> None:
    plan = {25: "late_request", 40: "crash_after"}
    first, second = (run(real(), CASES[0], plan, Count()) for _ in range(2))
    assert [entry.digest for entry in first.journal] == [entry.digest for entry in second.journal]
