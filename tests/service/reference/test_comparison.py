"""Printed numbers and their rounding; the status of a row comes from the numbers."""

import dataclasses

import pytest
from hypothesis import given
from hypothesis import strategies as st

from abbe.service.reference.comparison import Comparison, Erratum
from abbe.service.reference.printed import Computed, Given, Printed, agrees, computed_from
from abbe.service.reference.text import digits_like, lines, note


def row(text: str, computed: float | None, **more) -> Comparison:
    allowance = more.pop("allowance", 0.0)
    value = None if computed is None else Computed(computed, allowance)
    return Comparison("Table 0", "q", "µm", Printed(text, bound=more.pop("bound", False)), value, "how", "why", **more)


@pytest.mark.parametrize(
    ("text", "half"),
    [("-8.5619E-05", 5e-10), ("635", 0.5), ("43.0", 0.05), ("0.0", 0.05), ("-32", 0.5), ("1.752e-3", 5e-7), ("20", 0.5)],
)
def test_the_printed_digits_say_the_rounding(text, half):
    assert Printed(text).rounding == pytest.approx(half, rel=1e-12)


def test_padding_zeros_never_change_the_printed_rounding():
    number = Printed("4.240e-2", digits=3, padding="all end in 0")
    assert number.rounding == Printed("4.240e-2").rounding == pytest.approx(5e-6, rel=1e-12)
    assert number.rounding_if_padded == pytest.approx(5e-5, rel=1e-12)
    with pytest.raises(ValueError, match="reason"):
        Printed("4.240e-2", digits=3)


def test_a_zero_in_a_column_of_tenths_keeps_its_text_and_has_the_rounding_of_the_column():
    zero = Printed("0", last="0.1")
    assert (zero.text, zero.rounding, digits_like(0.0, zero)) == ("0", 0.05, "0.00")


@given(st.floats(-1e3, 1e3), st.integers(0, 5))
def test_whatever_was_rounded_agrees_with_its_rounding(value, decimals):
    text = f"{value:.{decimals}f}"
    assert agrees(Computed(value), Printed(text))
    half = Printed(text).rounding
    assert not agrees(Computed(float(text) + 1.01 * half), Printed(text))


def test_status_follows_the_numbers():
    assert row("1.3", 1.349).status == "reproduced"
    assert row("1.3", 1.351).status == "differs"
    assert row("1.3", 1.351, allowance=0.002).status == "consistent"
    assert row("1.3", 1.353, allowance=0.002).status == "differs"
    assert row("1.3", None).status == "not reproducible"
    assert row("0", None, given=True).status == "input"
    assert row("1.3", float("nan")).status == "differs"


def test_status_cannot_be_typed_in():
    assert "status" not in {f.name for f in dataclasses.fields(Comparison)}
    with pytest.raises(ValueError, match="has no reason"):
        Comparison("Table 0", "q", "µm", Printed("1"))
    with pytest.raises(ValueError, match="has no origin"):
        Comparison("Table 0", "q", "µm", Printed("1"), Computed(1.0))
    with pytest.raises(ValueError, match="must not be computed"):
        row("1", 1.0, given=True)


@pytest.mark.parametrize("size", [0.0, 0.2, -0.2, 0.51])
def test_a_bound_that_holds_confirms_no_digit(size):
    held = row("0.51", size, bound=True)
    assert (held.status, held.remark) == ("consistent", "bound holds")
    assert note(held).startswith("bound holds; why")
    assert held.to_document()["remark"] == "bound holds"


def test_a_bound_speaks_of_a_size_and_is_a_rounded_number_itself():
    barely = row("25", 25.000002, bound=True)
    assert barely.status == "consistent"
    assert barely.remark == "bound holds within its printed rounding: 25.000002 exceeds 25 by 2.0e-06"
    for size in (-1e9, 25.51, float("nan")):
        broken = row("25", size, bound=True)
        assert broken.status == "differs"
        assert broken.remark.startswith("bound broken")


def test_padded_zeros_make_a_row_consistent_at_most_and_say_so():
    number = Printed("4.240e-2", digits=3, padding="all end in 0")
    padded = Comparison("Table 0", "q", "", number, Computed(4.2385e-2), "how")
    assert padded.status == "consistent"
    assert padded.remark == "only if all end in 0"
    assert padded.to_document()["padding_because"] == "all end in 0"
    assert padded.to_document()["within"] == pytest.approx(5e-5)
    assert "only if all end in 0" in note(padded)
    assert Comparison("Table 0", "q", "", number, Computed(4.2404e-2), "how").status == "reproduced"
    assert Comparison("Table 0", "q", "", number, Computed(4.2451e-2), "how").status == "differs"


def test_padding_of_an_operand_is_told_from_its_rounding():
    operand = Printed("1.20", digits=2, padding="it ends in 0")
    found = computed_from(lambda a: 10.0 * a, operand)
    assert (found.allowance, found.allowance_if_padded) == pytest.approx((0.05, 0.5))
    assert Comparison("Table 0", "q", "", Printed("12.30"), found, "how").remark == "only if it ends in 0"
    by_it = Comparison("Table 0", "q", "", Printed("12.30"), Computed(13.0), "how", erratum=Erratum("slip", found))
    assert by_it.explained is False
    assert by_it.gap == "explained by the erratum only if it ends in 0"


def test_an_erratum_explains_only_what_it_gives():
    assert row("-4.1", 4.05, erratum=Erratum("sign", Computed(-4.1))).explained is True
    assert row("-4.1", 4.05, erratum=Erratum("sign", Computed(-4.3))).explained is False
    assert row("-4.1", 4.05, erratum=Erratum("sign")).explained is None
    assert row("-4.1", 4.05).explained is None
    assert "NOT explained" in note(row("-4.1", 4.05, erratum=Erratum("sign", Computed(-4.3))))


def test_rounded_operands_open_the_comparison_by_their_worst_case():
    found = computed_from(lambda a, b: a - 2.0 * b, Printed("1.0"), Printed("0.25"))
    assert found.value == pytest.approx(0.5)
    assert found.allowance == pytest.approx(0.05 + 2.0 * 0.005)


def test_a_series_is_one_line_and_shows_its_worst():
    rows = [row("1.0", 1.01, series="s"), row("2.0", 2.04, series="s"), row("3.0", 3.0, series="s"), row("4.0", 5.0, series="s")]
    shown = list(lines(rows))
    assert [line.status for line in shown] == ["reproduced", "differs"]
    assert shown[0].quantity == "s (µm), worst of 3"
    assert (shown[0].expected, shown[0].computed) == ("2.0", "2.04")
    assert digits_like(-1.23456e-5, Printed("-1.2E-05")) == "−1.23e−05"


@pytest.mark.parametrize(("found", "status"), [(1.019, "holds"), (0.981, "holds"), (1.021, "fails"), (float("nan"), "fails")])
def test_a_check_holds_inside_its_bound_only(found, status):
    check = Comparison("8", "q", "µrad", Given(1.0, 0.02), Computed(found), "how", "why", series="s", source="own check")
    assert check.status == status
    assert check.to_document()["status"] == status
    (line,) = lines([check])
    assert (line.expected, line.within, line.status) == ("1.000", "0.02", status)
