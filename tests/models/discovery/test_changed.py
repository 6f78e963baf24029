"""What has changed in a machine since it was solved: counted over machines that no solver here can represent."""

import os
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from abbe.models.discovery.changed_since import LINEAR, Changed, changed_since
from abbe.models.uncertainty.known_field import KnownField
from tests.models.solvers.truth import MACHINE, SolvedTruth, Truth

SEEDS = range(40) if os.environ.get("ABBE_TEST_LONG") == "1" else range(1)
Hide = Callable[[Truth, np.random.Generator], dict[str, float]]


Known = Callable[[int], KnownField]


@pytest.fixture(scope="module")
def known(solved_truth: SolvedTruth) -> Known:
    """By seed: the machine as it was solved."""

    def of(seed: int) -> KnownField:
        old = solved_truth(seed)[1]
        return KnownField(MACHINE, old.terms, old.coefficients, old.term_covariance)

    return of


def linear(truth: Truth, name: str, size: float) -> None:
    if name[0] == "E":
        truth.slope["XYZ".index(name[1]), "XYZ".index(name[1])] += size
    else:
        truth.square[("C0Y", "B0Z", "A0Z").index(name)] += size


def nothing(truth: Truth, rng: np.random.Generator) -> dict[str, float]:
    return {}


def one(truth: Truth, rng: np.random.Generator) -> dict[str, float]:
    """A scale or squareness by 5 to 200 µm/m."""
    name, size = str(rng.choice(LINEAR)), float(rng.choice([-1, 1]) * 10.0 ** rng.uniform(-5.3, -3.7))
    linear(truth, name, size)
    return {name: size}


def two(truth: Truth, rng: np.random.Generator) -> dict[str, float]:
    names = [str(n) for n in rng.choice(LINEAR, 2, replace=False)]
    found = {name: float(rng.choice([-1, 1]) * 10.0 ** rng.uniform(-5.0, -4.0)) for name in names}
    for name, size in found.items():
        linear(truth, name, size)
    return found


def heat(truth: Truth, rng: np.random.Generator) -> dict[str, float]:
    """All axes grow alike by 5 to 30 µm/m: but for its calibration a laser's wavelength would explain that."""
    size = float(rng.choice([-1, 1]) * 10.0 ** rng.uniform(-5.3, -4.5))
    for name in LINEAR[:3]:
        linear(truth, name, size)
    return dict.fromkeys(LINEAR[:3], size)


def pitch(truth: Truth, rng: np.random.Generator) -> dict[str, float]:
    """The pitch of X grows along its stroke by 20 to 60 µrad; rms over it: 1 / sqrt(3) of that."""
    end = float(rng.uniform(20e-6, 60e-6))
    truth.slope[0, 4] += end / MACHINE.length_mm[0]
    return {"EBX shape": end / np.sqrt(3.0)}


def changed(known: Known, seed: int, hide: Hide) -> tuple[dict[str, float], Changed]:
    """What was hidden in machine ``seed``, and what was found; measured anew with other cups, mirrors and noise."""
    truth = Truth(seed)
    truth.rng = np.random.default_rng([seed, 1])
    hidden = hide(truth, np.random.default_rng([seed, 2]))
    return hidden, changed_since(known(seed), truth.campaign())


def test_where_nothing_has_changed_nothing_is_named(known: Known) -> None:
    found = [changed(known, seed, nothing)[1] for seed in SEEDS]
    named = sum(bool(f.changes) for f in found)
    print(f"nothing: {named} of {len(found)} named something")  # noqa: T201 - the figure of the test
    assert named <= 0.05 * len(found)
    for f in found:
        assert f.before_mm is not None
        assert f.before_mm == pytest.approx(f.floor_mm, rel=0.1)
        assert f.hidden.keys() == set(LINEAR)
        assert all(0.1e-6 < u < 4e-6 for u in f.hidden.values())


@pytest.mark.parametrize("hide", [one, two, heat, pitch])
def test_what_has_changed_is_named_with_a_size_that_its_uncertainty_holds(known: Known, hide: Hide) -> None:
    inside, names, proved, gaps = [], [], [], []
    for seed in SEEDS:
        hidden, found = changed(known, seed, hide)
        told = {c.name: c for c in found.changes}
        names.append(told.keys() == hidden.keys() and all(c.halves == 2 and not c.rivals for c in told.values()))
        proved.append((found.judged or 0.0) > 3.0)
        inside += [abs(told[n].value - size) <= 2.0 * told[n].u for n, size in hidden.items() if n in told]
        assert found.before_mm is not None
        assert found.after_mm is not None
        gaps.append((found.after_mm - found.floor_mm) / (found.before_mm - found.floor_mm))
    counts = f"{sum(names)} of {len(names)} named, {sum(proved)} proved, {sum(inside)} of {len(inside)} within U"
    print(f"{hide.__name__}: {counts}, gap left {np.median(gaps):.3f}")  # noqa: T201 - the figures of the test
    assert np.mean(names) >= 0.95
    assert np.mean(proved) >= 0.95
    assert np.mean(inside) >= 0.9
    if hide is not heat:  # a wavelength, refitted, takes most of that
        assert np.median(gaps) < 0.05, "of the gap, on runs that did not choose"


def test_a_motion_that_another_explains_as_well_is_told_as_its_rival(known: Known) -> None:
    """On one body diagonal alone scales and squareness change the reading alike."""
    truth = Truth(0)
    truth.rng = np.random.default_rng([0, 3])
    linear(truth, "EXX", 60e-6)
    diagonal = [r for r in truth.campaign() if r.label == "dpppXYZ"]
    middle = diagonal[0].axes_mm.shape[0]
    along = [
        replace(r, **{k: getattr(r, k)[: middle // 2 : 3] for k in ("axes_mm", "deviation_mm", "sign", "t_s", "weight_n")})
        for r in diagonal
    ]
    found = changed_since(known(0), tuple(along))
    assert found.before_mm is None, "one set-up judges nothing"
    assert found.changes[0].rivals


def test_no_runs_are_refused(known: Known) -> None:
    with pytest.raises(ValueError, match="no runs"):
        changed_since(known(0), ())
