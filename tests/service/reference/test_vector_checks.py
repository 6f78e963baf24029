"""The frame of `abbe vectors`: what counts as off, and that no number of a file can be overlooked."""

import json

import numpy as np
import pytest

from abbe.service.errors import FileFormatError
from abbe.service.reference.vector_checks import Checks
from abbe.service.reference.vector_file import VectorCase
from abbe.service.reference.vector_results import check_file, vector_files


def case(doc) -> VectorCase:
    return VectorCase(doc, ("x.json",))


def test_a_number_nobody_looked_at_is_named():
    c = case({"units": "mm", "in": [1.0, 2.0], "out": {"a": 3.0, "b": None}})
    assert c.unread() == ["x.json/in/0", "x.json/in/1", "x.json/out/a"]
    c.array("in")
    c.at("out").number("a")
    assert c.unread() == []


def test_a_file_with_unread_numbers_is_not_ok():
    checks = Checks("x.json")
    c = case({"a": 1.0, "b": 2.0})
    checks.compare("a", 1.0, c.at("a"), unit="mm")
    checks.unread = c.unread()
    assert not checks.ok
    checks.leave_out("b", c.at("b"), "drawn at random, seed not in the file")
    checks.unread = c.unread()
    assert checks.ok
    assert checks.not_computable[0].numbers == 1


def test_a_file_that_compares_nothing_is_not_ok():
    assert not Checks("x.json").ok


@pytest.mark.parametrize(("stored", "unit"), [(0.012345678, "mm"), (1140.4494, "mm"), (5.4e-5, "rad"), (2540.3, "1")])
def test_the_eighth_digit_counts(stored, unit):
    digit = 10.0 ** (np.floor(np.log10(stored)) - 7)
    for off, ok in ((0.0, True), (1e-16 * stored, True), (digit, False), (-digit, False)):
        checks = Checks("x.json")
        checks.compare("q", stored + off, case(stored), unit=unit)
        assert checks.ok is ok


def test_the_limit_is_never_wider_than_a_nanometre_of_a_millimetre_unless_the_rounding_is_stated():
    checks = Checks("x.json")
    checks.compare("q", 1140.0 + 2e-9, case(1140.0), unit="mm")
    assert not checks.ok
    checks = Checks("x.json")
    checks.compare("q", 1140.0 + 2e-9, case(1140.0), unit="mm", floor=5e-9, rounding="printed to 8 digits")
    assert checks.ok


@pytest.mark.parametrize("computed", [np.nan, np.inf, [1.0, 2.0]])
def test_no_number_and_a_wrong_shape_are_deviations(computed):
    checks = Checks("x.json")
    checks.compare("q", computed, case(1.0), unit="1")
    assert not checks.ok
    assert "x.json" in checks.quantities["q"].failures[0]


@pytest.mark.parametrize(
    ("read", "says"),
    [
        (lambda c: c.number("missing"), "'missing' is missing"),
        (lambda c: c.array("ragged"), "rows of equal length"),
        (lambda c: c.array("words"), "expected a finite number, got 'a'"),
        (lambda c: c.number("row"), "expected one number"),
        (lambda c: c.text("row"), "expected a text"),
        (lambda c: c.at("row").keys(), "expected an object"),
        (lambda c: c.at("words", 0).parts(), "expected a list"),
    ],
)
def test_what_the_layout_lacks_is_named(read, says):
    with pytest.raises(FileFormatError, match=says):
        read(case({"ragged": [[1.0], [1.0, 2.0]], "words": ["a"], "row": [1.0]}))


def test_folders_and_files_that_are_no_vectors(tmp_path):
    with pytest.raises(FileFormatError, match="no such folder"):
        vector_files(tmp_path / "none")
    with pytest.raises(FileFormatError, match="no vector file"):
        vector_files(tmp_path)
    other = tmp_path / "other.json"
    other.write_text("{}")
    assert "no reader" in check_file(other).error
    broken = tmp_path / "probe.json"
    for text, says in (("{", "not JSON"), ("[]", "expected an object")):
        broken.write_text(text)
        assert says in check_file(broken).error
    broken.write_text(json.dumps({"units": "mm"}))
    assert "missing" in check_file(broken).error


def test_an_input_that_a_function_refuses_is_reported_with_its_file(tmp_path, shared):
    doc = json.loads((shared / "vectors" / "yang_helix.json").read_text())
    doc["sets"][0]["R"] = -175.0
    (tmp_path / "yang_helix.json").write_text(json.dumps(doc))
    checks = check_file(tmp_path / "yang_helix.json")
    assert not checks.ok
    assert "radius" in checks.refused
    assert "yang_helix.json/sets/0" in checks.refused


@pytest.mark.parametrize(
    ("read", "says"),
    [
        (lambda c: c.at("none").parts(), "the list is empty"),
        (lambda c: c.at("void").keys(), "the object is empty"),
        (lambda c: list(c.at("void").items()), "the object is empty"),
        (lambda c: c.array("none"), "at least one number"),
        (lambda c: c.array("row", shape=(3,)), r"expected 3 numbers, got shape \(2,\)"),
        (lambda c: c.array("row", shape=(None, 2)), "expected n x 2 numbers"),
        (lambda c: list(c.at("two").named("a")), "key 'b' is unknown"),
        (lambda c: list(c.at("two").named("a", "b", "c")), "'c' is missing"),
        (lambda c: c.at("nan").skip(), "expected a finite number, got nan"),
        (lambda c: c.at("flag").skip(), "expected a finite number, got True"),
        (lambda c: c.at("none").skip(), "expected numbers"),
    ],
)
def test_what_is_empty_unknown_or_no_number_is_refused(read, says):
    layout = {"none": [], "void": {}, "row": [1.0, 2.0], "two": {"a": 1.0, "b": 2.0}, "nan": [1.0, float("nan")], "flag": True}
    with pytest.raises(FileFormatError, match=says):
        read(case(layout))


def test_every_comparison_is_held_to_its_own_rounding_and_the_largest_is_shown():
    checks = Checks("x.json")
    checks.compare("q", 1.0 + 1e-6, case(1.0), unit="mm", floor=1e-5, rounding="coarse")
    checks.compare("q", 1.0 + 1e-6, case(1.0), unit="mm", floor=1e-15)
    q = checks.quantities["q"]
    assert (q.floor, q.rounding, len(q.failures)) == (1e-5, "coarse", 1)
    with pytest.raises(TypeError, match="compared in mm and in rad"):
        checks.compare("q", 1.0, case(1.0), unit="rad")


def test_what_acted_where_a_quantity_is_farthest_off_is_shown():
    checks = Checks("x.json")
    checks.compare("q", [1.0, 600.0 + 1e-12], case([1.0, 600.0]), unit="mm", floor=3e-13)
    assert checks.quantities["q"].to_document()["allowed_at_worst"] == 1e-9


def test_forms_count_apart_and_do_not_make_a_file_compared():
    checks = Checks("x.json")
    checks.check_form("digits", 1.5, case(1.5))
    assert not checks.ok  # nothing was computed
    checks.compare("q", 1.0, case(1.0), unit="1")
    assert checks.ok
    assert [q["name"] for q in checks.to_document()["quantities"]] == ["q"]
    assert [q["name"] for q in checks.to_document()["forms"]] == ["digits"]
    checks.check_form("digits", 1.5, case(1.50000001))
    assert not checks.ok


def test_a_deviation_that_is_no_number_is_null_in_the_answer():
    checks = Checks("x.json")
    checks.compare("q", np.nan, case(1.0), unit="1")
    json.dumps(checks.to_document(), allow_nan=False)
    assert checks.to_document()["quantities"][0]["max_abs_deviation"] is None
