"""What adds up to nothing in the book of a machine's model, and what only looks unsure."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from abbe.models.effects.catalogue import CATALOGUE
from abbe.service.domain.discovery import FindingSource
from abbe.service.domain.finding import EffectFound, Finding, PackedCovariance
from abbe.service.effects.effect_sums import total
from abbe.service.effects.model_book import extended_book

SOURCE = FindingSource(campaign="c1", machine_digest="m")


def found(label: str, strength: float, u_strength: float, **more: Any) -> EffectFound:
    name, _, key = label.partition(":")
    head = {"label": label, "name": name, "key": key, "title": name, "family": "geometry", "kind": "mean", "unit": "um", "remedy": "table"}
    return EffectFound(**head, strength=strength, u_strength=u_strength, **more)


def finding(*effects: EffectFound) -> Finding:
    return Finding(verdict="named", effects=effects)


@pytest.mark.parametrize(
    ("strengths", "gone"),
    [((5.0, -4.9), True), ((5.0, -2.0), False), ((10.0, 2.5), False)],
    ids=["repaired", "half of it repaired", "a size without a sign, more of it"],
)
def test_only_strengths_of_opposite_sign_cancel(strengths: tuple[float, float], gone: bool) -> None:
    """A straightness is known to 60 %; more of it found later is not a repair."""
    u = (0.1, 0.1) if min(strengths) < 0 else (6.2, 1.6)
    effects = [found("a", s, v) for s, v in zip(strengths, u, strict=True)]
    book = extended_book(None, finding(*effects), SOURCE, 1)
    assert book.gone == (("a",) if gone else ())
    assert len(book.effects) == (0 if gone else 2)


def straight(coefficients: tuple[float, ...], noise: float = 0.05) -> EffectFound:
    """A straightness of two bends: an rms, so without a sign; stated whole, known to 60 %."""
    effect = next(e for e in CATALOGUE if e.name == "straightness")
    c = np.array(coefficients)
    strength = effect.unseen[0] * effect.strength(c, {}) / effect.per_unit
    covariance = PackedCovariance.of(noise**2 * np.eye(c.size))
    return found("straightness:EYX", strength, 0.6 * strength, coefficients=coefficients, covariance=covariance)


@pytest.mark.parametrize(
    ("change", "gone", "share"),
    [
        ((-3.0, -4.0), True, 0.0),
        ((-2.9, -4.1), True, 0.02),
        ((-1.5, -2.0), False, 0.5),
        ((3.0, 4.0), False, 2.0),
        ((4.0, -3.0), False, 1.4),
    ],
    ids=["repaired", "repaired but for noise", "half of it repaired", "twice as much", "another bend"],
)
def test_sizes_without_a_sign_add_up_as_their_coefficients_do(change: tuple[float, ...], gone: bool, share: float) -> None:
    first, second = straight((3.0, 4.0)), straight(change)
    book = extended_book(None, finding(first, second), SOURCE, 1, CATALOGUE)
    assert book.gone == (("straightness:EYX",) if gone else ())
    effect = next(e for e in CATALOGUE if e.name == "straightness")
    assert total([first, second], effect).strength == pytest.approx(share * first.strength, abs=0.05 * first.strength)
    bent = replace(second, forms=("another form",))
    assert total([first, bent], effect).strength == pytest.approx(first.strength + second.strength)
