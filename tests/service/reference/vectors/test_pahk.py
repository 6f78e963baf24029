"""Pahk's four vector files through their readers: every number compared, and an altered digit noticed."""

import random

import pytest

from abbe.service.errors import FileFormatError
from abbe.service.reference.vector_results import check_file
from tests.service.reference.vectors.altering import changed, load, noticed, numbers, read, value

FILES = {
    "pahk_abbe": ("measured", "squareness_measured", "true_translational", "squareness_true"),
    "pahk_volumetric": ("delta_first_order", "delta_exact_rot", "delta_paper_matrix"),
    "pahk_random": ("RX_RY_RZ", "printed_eq5"),
    "pahk_diagonals": ("first_order", "full"),
}
"""File and the keys under which its results stand; everything else is an input."""
ROUNDING_MM = 2e-13 / 5e-8
"""An altered digit of a smaller result drowns in the rounding of the coordinates that were subtracted to make it."""


def is_noticed(name, doc, path) -> bool:
    # The readers take each type for itself, so that the altered type alone will do.
    part = {**doc, "types": {path[1]: doc["types"][path[1]]}} if path[0] == "types" else doc
    return noticed(name, changed(part, path))


@pytest.mark.parametrize("name", FILES)
def test_every_number_is_read_and_holds(shared, name):
    checks = check_file(shared / "vectors" / f"{name}.json")
    assert checks.ok, [q.failures for q in checks.quantities.values() if not q.ok]
    assert not checks.unread
    assert not checks.not_computable


@pytest.mark.parametrize("name", FILES)
def test_an_altered_eighth_digit_of_a_result_is_noticed(shared, name):
    doc = load(shared, name)
    results = [p for p in numbers(doc) if set(p) & set(FILES[name]) and (abs(value(doc, p)) > ROUNDING_MM or "squareness" in str(p))]
    for path in random.Random(20261121).sample(results, min(40, len(results))):
        assert is_noticed(name, doc, path), path


@pytest.mark.parametrize(("name", "least"), [("pahk_abbe", 0.7), ("pahk_volumetric", 0.9), ("pahk_random", 0.95), ("pahk_diagonals", 0.75)])
def test_an_altered_eighth_digit_of_most_inputs_is_noticed(shared, name, least):
    """Not of all: the roll of a tool-side axis without probe offset, or a slope that is fitted away, changes no result at all."""
    doc = load(shared, name)
    inputs = [p for p in numbers(doc) if not set(p) & set(FILES[name])]
    drawn = random.Random(20261122).sample(inputs, 60)
    assert sum(is_noticed(name, doc, p) for p in drawn) >= least * len(drawn)


def test_another_chain_than_ours_is_refused(shared):
    doc = load(shared, "pahk_volumetric")
    doc["types"] = {"MB1": doc["types"]["MB1"] | {"chain": "FXYZ"}}
    with pytest.raises(FileFormatError, match="MB1 is FYXZ"):
        read("pahk_volumetric", doc)
