"""Parameter-offset (Abbe) transformation: one derivation against the ten sets of rules of math.md 2.1, and against a table that moves."""

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from abbe.models.functions.polynomial import straight_line
from abbe.models.notation.pahk import TYPES
from abbe.models.papers.pahk.offset import OffsetSetup, as_measured, line_deviation_mm, offset_terms, refer_to_origin
from abbe.models.papers.pahk.volume_map import ParameterTables

# math.md 2.1, corrected value = measured + terms; <> only with the functional point at the probe tip.
RULES = {
    "MB1": "dx(X)-ZoEy(X); dy(Y)+ZoEx(Y)-XoEz(Y); dy(X)+ZoEx(X); dx(Y)-ZoEy(Y); dz(Y)+XoEy(Y);"
    "alpha+Ez(Yo)-Zom[Ex(X)]+Zom[Ey(Y)]; beta1+Ey(Xo); beta2-Ex(Xo)-Ex(Yo)-Xom[Ey(Y)]",
    "MB2": "dx(X)-ZoEy(X)+YoEz(X); dy(Y)+ZoEx(Y); dy(X)+ZoEx(X); dz(X)-YoEx(X); dx(Y)-ZoEy(Y);"
    "alpha-Ez(Xo)-Zom[Ex(X)]+Zom[Ey(Y)]; beta1+Ey(Xo)+Ey(Yo)+Yom[Ex(X)]; beta2-Ex(Yo)",
    "MH1": "dy(Y)+ZoEx(Y)-XoEz(Y); dz(Z)+XoEy(Z); dx(Y)-ZoEy(Y); dz(Y)+XoEy(Y); dy(Z)-XoEz(Z);"
    "alpha+Ez(Yo)+Ez(Zo)+Zom[Ey(Y)]; beta1-Ey(Zo); beta2-Ex(Yo)-Xom[Ey(Y)]+Xom[Ez(Z)]",
    "MH2": "dx(X)-ZoEy(X)+YoEz(X); dz(Z)-YoEx(Z); dy(X)+ZoEx(X); dz(X)-YoEx(X); dx(Z)+YoEz(Z);"
    "alpha-Ez(Xo)-Ez(Zo)-Zom[Ex(X)]; beta1+Ey(Xo)+Yom[Ex(X)]-Yom[Ez(Z)]; beta2+Ex(Zo)",
    "FB1": "dx(X)-ZoEy(X); dy(Y)-ZoEx(Y)+XoEz(Y); dy(X)+ZoEx(X); dx(Y)-ZoEy(Y)<+YEz(Y)>; dz(Y)+XoEy(Y)<-YEx(Y)>;"
    "alpha-Ez(Yo)-Zom[Ex(X)]-Zom[Ey(Y)]<+m[YEz(Y)]>; beta1+Ey(Xo); beta2-Ex(Xo)+Ex(Yo)+Xom[Ey(Y)]<-m[YEx(Y)]>",
    "FB2": "dx(X)+ZoEy(X)-YoEz(X); dy(Y)+ZoEx(Y); dy(X)+ZoEx(X)<-XEz(X)>; dz(X)-YoEx(X)<+XEy(X)>; dx(Y)-ZoEy(Y);"
    "alpha-Ez(Xo)-Zom[Ex(X)]-Zom[Ey(Y)]<+m[XEz(X)]>; beta1-Ey(Xo)+Ey(Yo)-Yom[Ex(X)]<+m[XEy(X)]>; beta2-Ex(Yo)",
    "CX": "dx(X)+ZoEy(X); dy(Y)-ZoEx(Y)+XoEz(Y); dy(X)+ZoEx(X)<-XEz(X)>; dz(X)<+XEy(X)>; dx(Y)-ZoEy(Y)<+YEz(Y)>; dz(Y)+XoEy(Y)<-YEx(Y)>;"
    "alpha+Ez(Yo)-Zom[Ex(X)]+Zom[Ey(Y)]<+m[XEz(X)]-m[YEz(Y)]>; beta1-Ey(Xo)<+m[XEy(X)]>; beta2+Ex(Xo)+Ex(Yo)+Xom[Ey(Y)]<-m[YEx(Y)]>",
    "CY": "dx(X)+ZoEy(X)-YoEz(X); dy(Y)-ZoEx(Y); dy(X)+ZoEx(X)<-XEz(X)>; dz(X)-YoEx(X)<+XEy(X)>; dx(Y)-ZoEy(Y)<+YEz(Y)>; dz(Y)<-YEx(Y)>;"
    "alpha-Ez(Xo)-Zom[Ex(X)]+Zom[Ey(Y)]<+m[XEz(X)]-m[YEz(Y)]>; beta1-Ey(Xo)-Ey(Yo)-Yom[Ex(X)]<+m[XEy(X)]>; beta2+Ex(Yo)<-m[YEx(Y)]>",
}
RULES["FH1"], RULES["FH2"] = RULES["FB2"], RULES["FB1"]
TERM = re.compile(r"([+-])(?:([XYZ])o(?=[Em]))?(m\[)?([XYZ])?E([xyz])\(([XYZ])(o)?\)\]?")
ANGLES = ("alpha", "beta1", "beta2")


def random_tables(rng, sizes=(9, 7, 11)) -> ParameterTables:
    x = [np.cumsum(rng.uniform(0.2, 1.0, n)) for n in sizes]
    x = [(v - v[0]) / (v[-1] - v[0]) * length for v, length in zip(x, (900.0, 575.0, 400.0), strict=True)]
    e = [rng.normal(0.0, 3e-5, (n, 3)) for n in sizes]
    d = []
    for j, n in enumerate(sizes):
        v = rng.normal(0.0, 5e-3, (n, 3))
        for i in range(3):
            slope, start = straight_line(x[j], v[:, i])
            v[:, i] -= v[0, i] if i == j else start + slope * x[j]
        d.append(v)
    return ParameterTables(tuple(x), tuple(d), tuple(e), rng.normal(0.0, 5e-5, 3))


def residual(x, f):
    slope, start = straight_line(x, f)
    return f - start - slope * x


def by_the_rules(name, tables, offset, still, lever, *, own):
    """d (three tables) and squareness that the text adds, with the levers' offsets in ``lever``; ``own``: with the terms in <>."""
    d = [np.zeros_like(v) for v in tables.d_mm]
    square = np.zeros(3)
    for rule in RULES[name].replace(" ", "").split(";"):
        rule = rule.replace("<", "").replace(">", "") if own else re.sub("<.*?>", "", rule)
        head = re.match(r"d([xyz])\(([XYZ])\)|alpha|beta[12]", rule)
        terms = list(TERM.finditer(rule, head.end()))
        assert sum(len(t.group()) for t in terms) == len(rule) - head.end(), f"not understood: {rule}"
        for t in terms:
            sign, at, slope, travel, i, j, here = t.groups()
            i, j = "xyz".index(i), "XYZ".index(j)
            x, f = tables.positions_mm[j], tables.e_rad[j][:, i]
            f = f * x if travel else f
            gain = (1.0 if sign == "+" else -1.0) * (lever["XYZ".index(at)] if at else 1.0)
            if head.group(1) is None:
                square[ANGLES.index(head.group())] += gain * (still[j, i] if here else straight_line(x, f)[0])
                assert here or slope
            else:
                k, axis = "xyz".index(head.group(1)), "XYZ".index(head.group(2))
                assert axis == j
                d[axis][:, k] += gain * (f - f[0] if k == axis else residual(x, f))
    return d, square


def agree(terms, d, square):
    for j in range(3):
        assert terms.d_mm[j] == pytest.approx(d[j], abs=3e-16)
    assert terms.squareness_rad == pytest.approx(square, abs=1e-18)


@pytest.mark.parametrize("name", TYPES)
def test_one_derivation_gives_the_rules_of_every_type(name):
    rng = np.random.default_rng(11)
    tables, offset = random_tables(rng), np.array([300.0, 200.0, 150.0])
    still = rng.normal(0.0, 3e-5, (3, 3))
    terms = offset_terms(TYPES[name], tables, OffsetSetup(offset), still)
    agree(terms, *by_the_rules(name, tables, offset, still, offset, own=True))


@pytest.mark.parametrize("name", TYPES)
def test_a_probe_offset_lengthens_every_lever_listed_or_not(name):
    """Xo -> Xo + Xp in the printed terms is not enough: levers that are zero without a probe (MB1: Ex(Z) on dy(Z)) become Xp too."""
    rng = np.random.default_rng(17)
    kind, tables, offset, probe = TYPES[name], random_tables(rng), np.array([300.0, 200.0, 150.0]), rng.normal(0.0, 40.0, 3)
    still = rng.normal(0.0, 3e-5, (3, 3))
    d, square = by_the_rules(name, tables, offset, still, offset, own=True)
    slope = np.zeros((3, 3))
    for j in range(3):
        work = -1.0 if kind.work_side[j] else 1.0
        moved = np.cross(tables.e_rad[j], probe)  # of the axis' own part, Pahk's sign; what it does to the tool is work * moved
        x = tables.positions_mm[j]
        for i in range(3):
            f = moved[:, i]
            slope[j, i] = work * straight_line(x, f)[0]
            d[j][:, i] -= work * (f - f[0]) if i == j else residual(x, f)
    theta = np.array([slope[a, b] + slope[b, a] for a, b in ((0, 1), (0, 2), (1, 2))])
    square = square + theta * [kind.alpha_sign, 1, 1]
    agree(offset_terms(kind, tables, OffsetSetup(offset, probe), still), d, square)


@pytest.mark.parametrize("name", ["FB1", "FB2"])
def test_a_reflector_on_the_table_drops_the_terms_of_own_travel(name):
    rng = np.random.default_rng(12)
    tables, offset, still = random_tables(rng), np.array([300.0, 200.0, 150.0]), rng.normal(0.0, 3e-5, (3, 3))
    point = np.where(TYPES[name].work_side > 0, 0.0, offset)
    terms = offset_terms(TYPES[name], tables, OffsetSetup(offset, table_point_mm=point), still)
    # The moving table's own coordinate of the reflector is zero, the others are those of the line: the rules without <>.
    agree(terms, *by_the_rules(name, tables, offset, still, offset, own=False))


def test_a_reflector_anywhere_on_a_table_sees_that_tables_rigid_motion():
    rng = np.random.default_rng(13)
    kind, tables, point = TYPES["FB2"], random_tables(rng), np.array([120.0, -35.0, 80.0])
    x, e = tables.positions_mm[0], tables.e_rad[0]
    seen = as_measured(kind, tables, OffsetSetup(np.array([300.0, 200.0, 150.0]), table_point_mm=point))
    own = tables.d_mm[0] + np.cross(e, point)  # the reflector's motion in the bed's frame beside the travel, Pahk's lateral signs
    along = tables.d_mm[0][:, 0] - np.cross(e, point)[:, 0]  # the table's travel is counted backwards
    assert seen.d_mm[0][:, 0] == pytest.approx(along - along[0], abs=1e-15)
    for i in (1, 2):
        assert seen.d_mm[0][:, i] == pytest.approx(residual(x, own[:, i]), abs=1e-15)


@pytest.mark.parametrize("name", TYPES)
def test_there_and_back(name):
    rng = np.random.default_rng(14)
    tables = random_tables(rng)
    setup = OffsetSetup(rng.uniform(100.0, 300.0, (3, 3)), rng.normal(0.0, 30.0, 3))  # every line at an offset of its own
    back = refer_to_origin(TYPES[name], as_measured(TYPES[name], tables, setup), setup)
    for j in range(3):
        assert back.d_mm[j] == pytest.approx(tables.d_mm[j], abs=1e-15)
    assert back.squareness_rad == pytest.approx(tables.squareness_rad, abs=1e-18)


@pytest.mark.parametrize("name", TYPES)
def test_lines_that_share_no_point_have_their_own_slopes(name):
    tables = random_tables(np.random.default_rng(15))
    kind, offsets = TYPES[name], np.array([[0.0, 200.0, 50.0], [400.0, 0.0, 300.0], [100.0, 90.0, 0.0]]) + 60.0
    seen = as_measured(kind, tables, OffsetSetup(offsets))
    slope = np.zeros((3, 3))
    for j in range(3):
        off = line_deviation_mm(kind, tables, OffsetSetup(offsets[j]), j)  # each line measured alone
        slope[j] = [straight_line(tables.positions_mm[j], off[:, i])[0] for i in range(3)]
    theta = -np.array([slope[a, b] + slope[b, a] for a, b in ((0, 1), (0, 2), (1, 2))])
    assert seen.squareness_rad * [kind.alpha_sign, 1, 1] == pytest.approx(theta, abs=1e-18)


@settings(max_examples=30, deadline=None)
@given(st.sampled_from(list(TYPES)), st.floats(-3.0, 3.0), st.integers(0, 2**31))
def test_the_terms_are_linear_in_the_angles(name, factor, seed):
    rng = np.random.default_rng(seed)
    tables, setup = random_tables(rng), OffsetSetup(rng.uniform(150.0, 250.0, 3))
    scaled = ParameterTables(tables.positions_mm, tables.d_mm, tuple(factor * e for e in tables.e_rad), tables.squareness_rad)
    one, many = offset_terms(TYPES[name], tables, setup), offset_terms(TYPES[name], scaled, setup)
    assert many.squareness_rad == pytest.approx(factor * one.squareness_rad, abs=1e-17)
    for j in range(3):
        assert many.d_mm[j] == pytest.approx(factor * one.d_mm[j], abs=1e-14)


def test_no_angular_errors_no_terms_and_no_offset_outside_the_tables():
    tables = random_tables(np.random.default_rng(16))
    straight = ParameterTables(tables.positions_mm, tables.d_mm, tuple(0 * e for e in tables.e_rad), tables.squareness_rad)
    setup = OffsetSetup(np.array([300.0, 200.0, 150.0]))
    seen = as_measured(TYPES["CX"], straight, setup)
    assert seen.squareness_rad == pytest.approx(tables.squareness_rad, abs=1e-18)
    assert seen.d_mm[1] == pytest.approx(tables.d_mm[1], abs=1e-15)
    with pytest.raises(ValueError, match="nothing is extrapolated"):
        as_measured(TYPES["CX"], tables, OffsetSetup(np.array([300.0, 2000.0, 150.0])))
    with pytest.raises(ValueError, match="finite"):
        OffsetSetup(np.array([np.nan, 0.0, 0.0]))
    with pytest.raises(ValueError, match="shape"):
        OffsetSetup(np.zeros(2))
