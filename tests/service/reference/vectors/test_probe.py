"""`probe.json` through its reader: every number compared, and an altered digit noticed."""

import random
import re

import pytest

from abbe.service.reference.vector_results import check_file
from tests.service.reference.vectors.altering import changed, load, numbers, read


@pytest.fixture
def doc(shared) -> dict:
    return load(shared, "probe")


def test_every_number_is_read_and_holds(shared):
    checks = check_file(shared / "vectors" / "probe.json")
    assert checks.ok, [q.failures for q in checks.quantities.values() if not q.ok]
    assert not checks.unread
    assert not checks.not_computable


def test_an_altered_eighth_digit_is_noticed(doc):
    for path in random.Random(20261121).sample(list(numbers(doc)), 80):
        assert not read("probe", changed(doc, path)).ok, path


def test_other_numbers_in_the_stated_lobing_are_used(doc):
    doc["note"] = re.sub(r"0\.004 ", "0.0040001 ", doc["note"])
    checks = read("probe", doc)
    assert not checks.quantities["probe error of a touch"].ok


def test_an_unknown_lobing_is_left_out_by_name(doc):
    doc["note"] = "lobe(ph,th)=something else"
    checks = read("probe", doc)
    assert checks.ok
    assert sum(n.numbers for n in checks.not_computable) == len(doc["combined"])
