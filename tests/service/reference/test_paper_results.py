"""The papers row by row: what comes out, what is an erratum, what is only consistent, what is not counted."""

import pytest

from abbe.service.reference.comparison import Comparison
from abbe.service.reference.paper_results import TITLES, results


@pytest.fixture(scope="module")
def everything():
    return {found.paper: found for found in results()}


def one(found, where: str, quantity: str) -> Comparison:
    (hit,) = [r for r in found.numbers if r.location == where and r.quantity == quantity]
    return hit


def test_all_four_papers_have_rows_and_every_row_has_its_reason(everything):
    assert set(everything) == set(TITLES)
    for found in everything.values():
        assert found.numbers
        for r in found.numbers:
            assert (r.computed is not None and r.how) or r.why
            assert not (r.status == "differs" and not (r.erratum or r.why)), f"{r.location} {r.quantity}: differs without a reason"


def test_yang_tables_come_out_as_math_md_8_says(everything):
    yang = everything["yang"]
    bar = [r for r in yang.numbers if r.series == "bar column"]
    apart = [r for r in yang.numbers if r.series == "laser − bar column"]
    assert len(bar) == len(apart) == 23
    assert {r.status for r in (*bar[1:], *apart[1:])} == {"reproduced"}
    assert [(r.status, r.expected.text, r.expected.rounding) for r in (bar[0], apart[0])] == [("input", "0", 0.05)] * 2
    assert one(yang, "Table 3", "mean |laser − bar|").computed.value == pytest.approx(2.817, abs=5e-4)
    assert one(yang, "Table 3", "eighth position").computed.value == pytest.approx(254.0)
    assert one(yang, "3.3", "difference of the two lines at 812.8 mm").computed.value == pytest.approx(1.27, abs=5e-3)
    through = one(yang, "Table 2", "dxx, laser, line through origin")
    ordinary = one(yang, "Table 2", "dxx, laser, ordinary line")
    assert through.computed.value == pytest.approx(-8.5604e-5, abs=5e-10)
    assert (through.status, ordinary.status) == ("consistent", "differs")
    assert ordinary.computed.value == pytest.approx(-8.7837e-5, abs=5e-10)
    assert "intercept 1.25 µm" in ordinary.why
    assert all(r.status == "reproduced" for r in yang.numbers if r.quantity.startswith("interval of"))


def test_known_slips_of_yang_differ_and_are_explained(everything):
    yang = everything["yang"]
    for where, quantity in (
        ("Table 2", "Syz, laser − bar"),
        ("Table 5", "Sxy·y, laser − bar"),
        ("Table 6", "Syz·y, laser − bar"),
    ):
        r = one(yang, where, quantity)
        assert (r.status, r.explained) == ("differs", True), quantity
    assert one(yang, "Table 5", "Sxy·y, laser − bar").computed.value == pytest.approx(-3.528, abs=1e-3)
    assert one(yang, "Table 6", "Syz·y, laser − bar").computed.value == pytest.approx(4.047, abs=1e-3)
    assert one(yang, "Table 6", "Sxz·x, laser − bar").status == "reproduced"


def test_the_laser_column_comes_back_from_the_helix_as_a_check_and_not_as_print(everything):
    yang = everything["yang"]
    checks = yang.of("own check")
    assert len(checks) == 12
    for c in checks:
        assert c.within == 0.02
        assert abs(c.difference) < 0.02
        assert c.status == "holds"
        assert abs(c.difference) > 1e-6  # the exact model is not the one that is fitted
    assert yang.counts("own check") == {"holds": 12, "fails": 0}
    assert not [r for r in yang.numbers if "helix" in r.quantity]


def test_the_inverse_returns_the_commands_as_a_check(everything):
    checks = everything["kwon"].of("own check")
    assert [c.expected.value for c in checks] == [0.4, 1.1, 1.7]
    assert [c.status for c in checks] == ["holds"] * 3
    assert not [r for r in everything["kwon"].numbers if r.quantity.startswith("λ")]


def test_pahk_diagonals_are_not_claimed_and_the_evidence_is_computed(everything):
    pahk = everything["pahk"]
    for name in ("CMM A", "CMM B"):
        diagonals = [r for r in pahk.numbers if r.series == f"diagonals of {name}"]
        assert len(diagonals) == 4
        assert {r.status for r in diagonals} == {"not reproducible"}
    assert "32 µrad" in next(r.why for r in pahk.numbers if r.series == "diagonals of CMM A")
    assert "42 µrad" in next(r.why for r in pahk.numbers if r.series == "diagonals of CMM B")


def test_wang_numbers(everything):
    wang = everything["wang"]
    assert one(wang, "IV.B", "cosine error, beam askew by 1 mm in 1 m").computed.value == pytest.approx(0.5, abs=1e-5)
    assert one(wang, "IV.C", "mirror askew by 0.5 mrad, step of 50 mm").computed.value == pytest.approx(25.0, abs=1e-4)
    assert [r.status for r in wang.numbers if r.expected.bound] == ["consistent", "consistent"]
    assert "25.000002 exceeds 25" in one(wang, "IV.C", "mirror askew by 0.5 mrad, step of 50 mm").remark
    assert one(wang, "IV.A", "the same as the text writes it, 1/√3²").explained is True


def test_kwon_forensics_of_the_two_tables(everything):
    kwon = everything["kwon"]
    plane = one(kwon, "Table 1", "plane Z of the fit")
    assert (plane.status, plane.computed.value) == ("differs", pytest.approx(97.616, abs=5e-4))
    quotients = [r for r in kwon.numbers if r.series == "plane Z by quotients"]
    assert len(quotients) == 29
    assert all(abs(r.computed.value - 97.6165) <= r.computed.allowance for r in quotients)
    assert {r.status for r in quotients} == {"differs"}
    exponent = one(kwon, "Table 1", "β10 of e_x")
    assert exponent.computed.value == pytest.approx(-1.752e-5, rel=1e-3)
    assert exponent.explained is True
    sums = {c: one(kwon, "Table 2", f"regression sum of squares of {c}") for c in ("e_x", "e_y", "e_z")}
    assert [sums[c].fit for c in sums] == ["rounding", "padding", "no"]
    totals = [one(kwon, "Table 2", f"total sum of squares of {c}") for c in sums]
    assert [r.fit for r in totals] == ["padding", "padding", "equal"]
    assert all("padding" in r.to_document()["remark"] for r in (sums["e_y"], *totals[:2]))
    assert [r.computed.value for r in sums.values()] == pytest.approx([4.2385e-2, 4.5149e-2, 1.2110e-2], abs=5e-7)
    for c, largest in (("e_x", 50.1), ("e_y", 79.7), ("e_z", 74.5)):
        row_ = one(kwon, "4.2", f"largest |{c}|")
        assert row_.status == "differs"
        assert row_.computed.value == pytest.approx(largest, abs=0.05)
    assert one(kwon, "4.2", "largest |e_x|").why.startswith("within the stated residuals")
    assert one(kwon, "4.2", "largest |e_y|").why.startswith("beyond the stated residuals")


def test_kwon_analysis_of_variance(everything):
    kwon = everything["kwon"]
    assert [one(kwon, "Table 2", f"F of {c}").status for c in ("e_x", "e_y", "e_z")] == ["differs", "differs", "consistent"]
    e_x, e_y = (one(kwon, "Table 2", f"F of {c}") for c in ("e_x", "e_y"))
    assert "61" in e_x.erratum.text
    assert e_x.erratum.again.value == pytest.approx(981.93, abs=5e-3)
    assert e_x.again_fit == "padding"
    assert "61" not in f"{e_y.why} {e_y.erratum.text}"
    assert e_y.why.startswith("unexplained. Nearest is the ratio of the printed mean squares, 437.62 (437.48 to 437.76")
    assert (e_y.erratum.again.value, e_y.explained) == (pytest.approx(2.301e-3 / 5.258e-6), False)
    assert one(kwon, "Table 2", "mean square of the residual of e_y").erratum is None
    assert one(kwon, "Table 2", "mean square of the residual of e_x").explained is True
    assert [one(kwon, "Table 2", f"degrees of freedom of the {n}").computed.value for n in ("regression", "residual")] == [9, 71]
    assert one(kwon, "4.2", "critical F(20, 60, 0.01)").status == "reproduced"
    for c, f in (("e_x", 2540), ("e_y", 1130), ("e_z", 951)):
        assert one(kwon, "6", f"F of {c}, 9 and 71 degrees of freedom").computed.value == pytest.approx(f, abs=0.5)


def test_what_math_md_states_is_reproduced_but_for_slips_of_its_last_digits(everything):
    differ = {(f.paper, r.quantity) for f in everything.values() for r in f.numbers if r.source == "math.md" and r.status == "differs"}
    assert differ == {
        ("pahk", "ppp of squareness alone"),
        ("kwon", "ball centre at λ = (0.4, 1.1, 1.7), y"),
        ("kwon", "ball centre at λ = (0.4, 1.1, 1.7), z"),
        ("kwon", "smallest λ for a square of ± 1 mm"),
    }


def test_the_probe_pattern_has_its_101_points(everything):
    pahk = everything["pahk"]
    names = ("circles of latitude", "points on the circles", "points of the pattern")
    assert [one(pahk, "3.2", n).computed.value for n in names] == [5, 100, 101]


def test_every_printed_number_is_counted_once(everything):
    yang = everything["yang"]
    # Table 1: 12, Table 2: 18, Table 3: 1 + 69 + 2, text 1, Table 4: 4, Table 5: 3, Table 6: 6
    assert sum(yang.counts().values()) == 12 + 18 + 1 + 69 + 2 + 1 + 4 + 3 + 6
    assert sum(everything["wang"].counts().values()) == 4
    # Table 1: 60, Table 2: 9 sums, 6 mean squares, 3 F, 2 dof
    # text: plane, points, critical F, 3 largest, 2 turns, residual, 3 repeatabilities
    assert sum(everything["kwon"].counts().values()) == 60 + 9 + 6 + 3 + 2 + 1 + 1 + 1 + 3 + 2 + 1 + 3


def test_inputs_are_told_from_what_cannot_be_reproduced(everything):
    assert {p: (f.counts()["input"], f.counts()["not reproducible"]) for p, f in everything.items()} == {
        "pahk": (7, 28),
        "kwon": (0, 68),
        "yang": (25, 21),
        "wang": (0, 0),
    }
