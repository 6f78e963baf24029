"""The bank of candidates: seven digits choose as all digits do, and what is kept is what would be made again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from abbe.models.discovery.baseline import baseline_of
from abbe.models.discovery.candidate_bank import Bank, bank_of, gain_of, starts_of, taken
from abbe.models.discovery.whitened_problem import WhitenedProblem, whiten, with_projection
from abbe.models.effects.catalogue import CATALOGUE
from tests.models.discovery.test_discovery_search import campaign

NAMES = ("backlash", "cyclic_error", "lateral_play", "dead_path")
"""``dead_path``: of a laser; no run of this campaign sees it."""
PICKS = [p for p in starts_of(CATALOGUE) if p.effect.name in NAMES]


@pytest.fixture(scope="module")
def problem() -> WhitenedProblem:
    case = campaign(backlash_um=3.0)
    return whiten(case, baseline_of(case))


def same(a: Bank, b: Bank) -> None:
    assert [p.start for p in a.picks] == [p.start for p in b.picks]
    assert dict(a.known) == dict(b.known)
    for name in ("first", "size", "own", "rhs", "prior_sd", "logs"):
        assert np.array_equal(getattr(a, name), getattr(b, name)), name
    for x, y in zip((*a.gram, *a.parts), (*b.gram, *b.parts), strict=True):
        assert np.array_equal(x, y)


def test_gains_of_a_bank_are_those_of_each_pick_alone(problem: WhitenedProblem) -> None:
    bank = bank_of(problem, PICKS)
    assert len(bank.parts) > 1
    assert {p.effect.name for p in bank.picks} == {"backlash", "cyclic_error", "lateral_play"}
    for beside in (taken(problem, []), taken(problem, [PICKS[0]])):
        gains = bank.gains(problem.projection.y, beside.rows)
        alone = np.array([gain_of(problem, p, beside) for p in bank.picks])
        assert gains == pytest.approx(alone, rel=1e-4, abs=1e-3)
    assert gain_of(problem, PICKS[0], taken(problem, [])) > 100.0


def test_what_another_bank_holds_is_not_made_again_and_is_the_same(problem: WhitenedProblem, monkeypatch: pytest.MonkeyPatch) -> None:
    alone = replace(problem, banks=type(problem.banks)())
    mixed = [*PICKS[7:60:3], *PICKS[:5], *(p for p in PICKS if p.effect.name == "dead_path")]
    fresh = bank_of(alone, mixed)
    held = bank_of(problem, PICKS)
    monkeypatch.setattr(WhitenedProblem, "white", None)  # nothing is whitened a second time
    found = bank_of(problem, mixed)
    assert np.concatenate(found.parts) == pytest.approx(np.concatenate(fresh.parts), rel=1e-5, abs=1e-7)
    assert found.rhs == pytest.approx(fresh.rhs, rel=1e-9, abs=1e-9)
    assert [p.start for p in found.picks] == [p.start for p in fresh.picks]
    assert found.known == fresh.known
    same(bank_of(problem, PICKS), held)


def test_another_scene_starts_without_banks(problem: WhitenedProblem) -> None:
    bank = bank_of(problem, PICKS[:3])
    assert bank in problem.banks
    assert not with_projection(problem).banks
    del bank
    assert not any(isinstance(b, Bank) and len(b.known) == 3 for b in problem.banks)  # nobody else keeps it


def test_a_pick_that_is_asked_for_twice_is_held_once(problem: WhitenedProblem) -> None:
    """Two chosen effects may each ask for the same second one."""
    twice, once = (bank_of(problem, picks) for picks in ([*PICKS[:5], *PICKS[:3]], PICKS[:5]))
    same(twice, once)
    assert list(bank_of(problem, PICKS[1:4]).known) == [p.start for p in PICKS[1:4]]  # taken over from those


def test_a_gain_is_computed_once_and_not_for_another_problem(problem: WhitenedProblem, monkeypatch: pytest.MonkeyPatch) -> None:
    beside = taken(problem, [PICKS[0]])
    gains = [gain_of(problem, p, beside) for p in PICKS[1:4]]
    alone = gain_of(problem, PICKS[1], taken(problem, []))
    assert alone != gains[0]  # the same pick beside others is another question
    assert not with_projection(problem).gains
    monkeypatch.setattr(WhitenedProblem, "white", None)  # nothing is whitened a second time
    assert [gain_of(problem, p, beside) for p in PICKS[1:4]] == gains
