"""Pahk's names, the map over the volume and the space diagonals, against the equations that math.md 2 writes out."""

import numpy as np
import pytest

from abbe.models.functions.polynomial import straight_line
from abbe.models.notation.pahk import (
    TYPES,
    iso_squareness,
    motions_from_pahk,
    pahk_from_motions,
    pahk_machine,
    pahk_squareness,
    pahk_type,
)
from abbe.models.papers.pahk.diagonals import length_deviation, space_diagonals
from abbe.models.papers.pahk.volume_map import ParameterTables, chain_deviation_mm, volumetric_map


def first_order(name, p, d, e, square):
    """First-order equations of math.md 2 at Xp = 0, typed from the text; d[i][j] = d_i(j)."""
    x, y, z = p
    a, b1, b2 = square
    dx, dy, dz = ({j: d["XYZ".index(j), i] for j in "XYZ"} for i in range(3))
    ex, ey, ez = ({j: e["XYZ".index(j), i] for j in "XYZ"} for i in range(3))
    sx, sy, sz = (sum(v.values()) for v in (dx, dy, dz))
    fx, fy, fz = (dx["X"] - dx["Y"] + dx["Z"], -dy["X"] + dy["Y"] + dy["Z"], -dz["X"] - dz["Y"] + dz["Z"])
    rule = {
        "MB1": lambda: (sx + z * (ey["X"] + ey["Y"] - b1), sy + x * (ez["Y"] - a) - z * (ex["X"] + ex["Y"] + b2), sz - x * ey["Y"]),
        "MB2": lambda: (
            sx - y * ez["X"] + z * (ey["X"] + ey["Y"] - b1),
            sy - a * x - z * (ex["X"] + ex["Y"] + b2),
            sz + y * ex["X"],
        ),
        "MH1": lambda: (
            sx + z * (ey["Y"] - b1),
            sy + x * (ez["Y"] + ez["Z"] - a) - z * (ex["Y"] + b2),
            sz - x * (ey["Y"] + ey["Z"]),
        ),
        "MH2": lambda: (
            sx - y * (ez["X"] + ez["Z"]) + z * (ey["X"] - b1),
            sy - a * x - z * (ex["X"] + b2),
            sz + y * (ex["X"] + ex["Z"]),
        ),
        "FB1": lambda: (
            fx + y * ez["Y"] + z * (ey["X"] - ey["Y"] - b1),
            sy - x * (ez["Y"] + a) + z * (ex["Y"] - ex["X"] - b2),
            dz["X"] - dz["Y"] + dz["Z"] + x * ey["Y"] - y * ex["Y"],
        ),
        "FB2": lambda: (
            sx + y * ez["X"] + z * (ey["Y"] - ey["X"] - b1),
            fy + x * (a - ez["X"]) + z * (ex["X"] - ex["Y"] - b2),
            -dz["X"] + dz["Y"] + dz["Z"] + x * ey["X"] - y * ex["X"],
        ),
        "CX": lambda: (
            fx + y * ez["Y"] - z * (ey["X"] + ey["Y"] + b1),
            fy + x * (a - ez["X"] - ez["Y"]) + z * (ex["X"] + ex["Y"] - b2),
            fz + x * (ey["X"] + ey["Y"]) - y * ex["Y"],
        ),
        "CY": lambda: (
            fx + y * (ez["X"] + ez["Y"]) - z * (ey["X"] + ey["Y"] + b1),
            fy + x * (a - ez["X"]) + z * (ex["X"] + ex["Y"] - b2),
            fz + x * ey["X"] - y * (ex["X"] + ex["Y"]),
        ),
    }
    return rule[{"FH1": "FB2", "FH2": "FB1"}.get(name, name)]()


def tables_of(rng, scale=1.0) -> ParameterTables:
    x = tuple(np.linspace(0.0, length, 5) for length in (900.0, 575.0, 400.0))
    d = tuple(scale * rng.normal(0.0, 0.01, (5, 3)) for _ in range(3))
    return ParameterTables(x, d, tuple(scale * rng.normal(0.0, 3e-5, (5, 3)) for _ in range(3)), scale * rng.normal(0.0, 5e-5, 3))


@pytest.mark.parametrize("name", TYPES)
def test_the_map_is_the_equation_of_the_type_at_every_node(name):
    tables = tables_of(np.random.default_rng(21))
    found = volumetric_map(TYPES[name], tables, 5)
    for index in np.ndindex(5, 5, 5):
        d, e = (np.stack([v[j][index[j]] for j in range(3)]) for v in (tables.d_mm, tables.e_rad))
        expected = first_order(name, found.axes_mm[index], d, e, tables.squareness_rad)
        assert found.deviation_mm[index] == pytest.approx(expected, abs=2e-16)


@pytest.mark.parametrize("name", TYPES)
def test_every_type_adds_the_same_probe_part(name):
    rng = np.random.default_rng(22)
    kind, tables, probe = TYPES[name], tables_of(rng), np.array([20.0, -15.0, 60.0])
    plain, tipped = volumetric_map(kind, tables, 3), volumetric_map(kind, tables, 3, probe)
    work = 1.0 - 2.0 * kind.work_side
    _, e = tables.at(plain.axes_mm.reshape(-1, 3))
    added = np.cross((e * work[:, None]).sum(axis=1), probe)  # (sum of tool E - sum of workpiece E) x Xp
    assert (tipped.deviation_mm - plain.deviation_mm).reshape(-1, 3) == pytest.approx(added, abs=2e-16)
    assert (tipped.deformed_mm - tipped.deviation_mm) == pytest.approx(tipped.axes_mm + probe, abs=1e-12)
    assert tipped.exaggerated_mm(1000.0) - tipped.nominal_mm == pytest.approx(1000.0 * tipped.deviation_mm, abs=1e-11)


@pytest.mark.parametrize("name", TYPES)
def test_what_first_order_neglects_is_of_second_order(name):
    gap = []
    for scale in (1.0, 0.5):
        tables = tables_of(np.random.default_rng(23), scale)
        one, exact = (volumetric_map(TYPES[name], tables, 3, form=form).deviation_mm for form in ("first", "zyx"))
        gap.append(np.abs(one - exact).max())
    assert gap[0] / gap[1] == pytest.approx(4.0, rel=0.01)
    assert gap[0] < 5e-5


@pytest.mark.parametrize("name", TYPES)
def test_squareness_is_the_angle_between_lines_of_the_tool(name):
    kind, square = TYPES[name], np.array([3e-5, -2e-5, 5e-5])
    u = np.linspace(0.0, 300.0, 4)
    slope = np.zeros((3, 3))
    for j in range(3):
        axes = np.zeros((4, 3))
        axes[:, j] = u
        motions = motions_from_pahk(kind, axes, np.zeros((4, 3, 3)), np.zeros((4, 3, 3)), square)
        off = chain_deviation_mm(pahk_machine(kind, np.array([[0.0, 900.0]] * 3)), axes, motions)
        slope[j] = [straight_line(u, off[:, i])[0] for i in range(3)]
    xy, xz, yz = (-(slope[a, b] + slope[b, a]) for a, b in ((0, 1), (0, 2), (1, 2)))
    assert iso_squareness(kind, square) == pytest.approx([xy, -xz, yz], abs=1e-18)  # C0Y, B0Z, A0Z
    assert pahk_squareness(kind, iso_squareness(kind, square)) == pytest.approx(square)


@pytest.mark.parametrize("name", TYPES)
def test_iso_motions_and_back(name):
    rng = np.random.default_rng(24)
    axes, d, e, square = rng.uniform(0, 500, (6, 3)), rng.normal(0, 0.01, (6, 3, 3)), rng.normal(0, 3e-5, (6, 3, 3)), rng.normal(0, 5e-5, 3)
    d2, e2 = pahk_from_motions(TYPES[name], axes, motions_from_pahk(TYPES[name], axes, d, e, square), square)
    assert d2 == pytest.approx(d, abs=1e-17)
    assert e2 == pytest.approx(e, abs=1e-20)


@pytest.mark.parametrize(
    ("volume", "square_urad", "printed_um"),
    [
        ((900.0, 575.0, 400.0), (14.1, 56.4, -32.0), (-17.75, 30.7, -17.9, 5.0)),  # the text has -17.8; it is -17.748
        ((1100.0, 1100.0, 1100.0), (43.2, 108.9, -48.9), (-65.5, 127.7, -72.8, 10.7)),
    ],
)
def test_diagonals_of_pahks_two_machines_from_squareness_alone(volume, square_urad, printed_um):
    x = tuple(np.array([0.0, v]) for v in volume)
    none = (np.zeros((2, 3)),) * 3
    found = space_diagonals(TYPES["MB1"], ParameterTables(x, none, none, np.array(square_urad) * 1e-6))
    assert [found[k].first_order_mm * 1e3 for k in ("ppp", "npp", "pnp", "ppn")] == pytest.approx(printed_um, abs=0.051)


def test_a_length_is_the_distance_of_its_ends():
    rng = np.random.default_rng(25)
    ends, off = np.array([[0.0, 0.0, 0.0], [300.0, 400.0, 1200.0]]), rng.normal(0.0, 0.5, (2, 3))
    found = length_deviation(ends, off)
    assert found.full_mm == pytest.approx(np.linalg.norm(ends[1] + off[1] - ends[0] - off[0]) - 1300.0, abs=1e-11)
    assert abs(found.full_mm - found.first_order_mm) < np.linalg.norm(off[1] - off[0]) ** 2 / 1300.0
    with pytest.raises(ValueError, match="different ends"):
        length_deviation(ends[[0, 0]], off)


def test_refusals():
    tables = tables_of(np.random.default_rng(26))
    with pytest.raises(ValueError, match="at least 2"):
        volumetric_map(TYPES["MB1"], tables, 1)
    with pytest.raises(ValueError, match="nothing is extrapolated"):
        volumetric_map(TYPES["MB1"], tables, 2, box_mm=np.array([[0.0, 901.0], [0.0, 1.0], [0.0, 1.0]]))
    with pytest.raises(ValueError, match="expected one of MB1"):
        pahk_type("MB3")
    x, d = tables.positions_mm, tables.d_mm
    for positions, values in (((x[0][::-1], x[1], x[2]), d), (x, (d[0][:3], d[1], d[2])), (x, (d[0] * np.nan, d[1], d[2]))):
        with pytest.raises(ValueError, match="parameter tables of X"):
            ParameterTables(positions, values, tables.e_rad)
    with pytest.raises(ValueError, match="3 angles"):
        motions_from_pahk(TYPES["MB1"], np.zeros((2, 3)), np.zeros((2, 3, 3)), np.zeros((1, 3, 3)), np.zeros(3))
