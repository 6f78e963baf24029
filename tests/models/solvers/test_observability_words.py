"""Null vectors become sentences: names, parts, proportions, sets of motions as small as they come."""

import numpy as np
import pytest

from abbe.models.functions.motions import motion_names
from abbe.models.geometry.bases import smooth_terms
from abbe.models.solvers.observability.hidden import families, motion_text, part_text, sentence

TERMS = smooth_terms(4)
NAMES = [t.name for t in TERMS]
ONES = np.ones(len(TERMS))


def null_space(*vectors):
    """Orthonormal basis of combinations given as {name: weight}."""
    a = np.zeros((len(TERMS), len(vectors)))
    for k, v in enumerate(vectors):
        for name, weight in v.items():
            a[NAMES.index(name), k] = weight
    return np.linalg.qr(a)[0]


def said(*vectors):
    return [(f.motions, f.vectors.shape[1], sentence(TERMS, f)) for f in families(TERMS, null_space(*vectors), ONES)]


def test_every_motion_has_a_name_of_its_own():
    words = [motion_text(m) for a in "XYZ" for m in motion_names(a)] + [motion_text(s) for s in ("C0Y", "B0Z", "A0Z")]
    assert len(set(words)) == 21
    assert motion_text("EAX") == "the roll of X (EAX)"
    assert motion_text("EBY") == "the roll of Y (EBY)"
    assert motion_text("ECZ") == "the roll of Z (ECZ)"
    assert motion_text("EZX") == "the straightness of X in Z (EZX)"
    assert motion_text("B0Z") == "the squareness of X and Z (B0Z)"


@pytest.mark.parametrize(
    ("motion", "orders", "words"),
    [
        ("EXX", [1], "the scale of X (EXX)"),
        ("EXX", [1, 2, 3], "the positioning of X (EXX)"),
        ("EAX", [1], "the slope of the roll of X (EAX)"),
        ("EAX", [2, 3], "the shape (orders 2 to 3) of the roll of X (EAX)"),
        ("EYX", [3], "the shape (order 3) of the straightness of X in Y (EYX)"),
        ("C0Y", [0], "the squareness of X and Y (C0Y)"),
    ],
)
def test_parts_of_a_motion(motion, orders, words):
    assert part_text(motion, orders) == words


def test_a_motion_alone():
    assert said({"ECY.1": 1.0}, {"ECY.2": 1.0}) == [(("ECY",), 2, "The yaw of Y (ECY) leaves no trace")]


def test_a_pair_with_its_proportion():
    found = said({"EAX.1": 1.0, "C0Y": -4.0})
    # 1 rad of EAX.1 is 2 rad over the stroke and goes with -4 rad of C0Y: so 10 urad of it look like 20 urad of C0Y
    assert found[0][2] == (
        "The slope of the roll of X (EAX) and the squareness of X and Y (C0Y) cannot be distinguished: "
        "10 µrad of EAX over the stroke look like 20 µrad of C0Y"
    )
    with_length = said({"EXX.1": 1.0, "EBX.1": -0.01})[0][2]
    assert with_length.endswith("10 µm of EXX over the stroke look like 100 µrad of EBX over the stroke")


def test_orders_of_the_same_motions_are_one_family_and_mixing_the_basis_changes_nothing():
    vectors = [{f"EXY.{k}": 1.0, f"EBY.{k}": 0.5} for k in (2, 3, 4)]
    basis = null_space(*vectors, {"EBY.1": 1.0, "C0Y": 0.3})
    rng = np.random.default_rng(0)
    turned = basis @ np.linalg.qr(rng.normal(size=(4, 4)))[0]
    found = families(TERMS, turned, ONES)
    assert {(f.motions, f.vectors.shape[1]) for f in found} == {(("EXY", "EBY"), 3), (("EBY", "C0Y"), 1)}
    pair = next(f for f in found if f.motions == ("EXY", "EBY"))
    assert sentence(TERMS, pair).startswith(
        "The shape (orders 2 to 4) of the straightness of Y in X (EXY) and the shape (orders 2 to 4) of"
    )
    for k in range(3):
        used = np.flatnonzero(pair.vectors[:, k])
        assert len({TERMS[i].order for i in used}) == 1


def test_what_was_told_is_not_told_again():
    basis = null_space({"ECY.1": 1.0}, {"EXX.1": 1.0, "EYY.1": 1.0, "EZZ.1": 1.0})
    told = null_space({"ECY.1": 1.0})
    found = families(TERMS, basis, ONES, found=told)
    assert [f.motions for f in found] == [("EXX", "EYY", "EZZ")]
    assert "cannot be distinguished" in sentence(TERMS, found[0], " with one tool length")
    assert sentence(TERMS, found[0], " with one tool length").endswith("(EZZ) cannot be distinguished with one tool length")


def test_mixtures_of_many_motions_are_counted():
    names = ["EXX.1", "EYY.1", "EZZ.1", "EAX.1", "EBY.1", "ECZ.1", "C0Y"]
    rng = np.random.default_rng(1)
    found = said(*[dict(zip(names, rng.normal(size=7), strict=True)) for _ in range(2)])
    assert sum(count for _, count, _ in found) == 2
    assert all("motions (" in text for _, _, text in found)
    assert "leave no trace" in found[0][2]


def test_nothing_hidden_says_nothing():
    assert families(TERMS, np.zeros((len(TERMS), 0)), ONES) == []
