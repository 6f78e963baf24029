"""ISO 230-2, 230-4 and 230-6 against tables computed by hand, plain loops, closed forms, trials, and real tests of three axes."""

import json
import statistics

import numpy as np
import pytest

from abbe.models.evaluation.iso230_2 import Approaches, ScaleBudget, positioning
from abbe.models.evaluation.iso230_4 import CircularTest, both_ways, centred, circular
from abbe.models.evaluation.iso230_6 import FACE, diagonals

ROOT2 = np.sqrt(2.0)


def approaches(forward, backward, position=None) -> Approaches:
    f, b = np.array(forward, dtype=float), np.array(backward, dtype=float)
    return Approaches(np.arange(float(len(f))) * 100.0 if position is None else np.array(position, dtype=float), f, b)


def test_three_positions_and_two_cycles_by_hand():
    """Means +: 2 4 3, s+: √2 0 3√2; means -: 0 2 3, s-: √2 0 0. At the third position 4 s+ decides R, not the sum of both."""
    p = positioning(approaches([[1, 3], [4, 4], [0, 6]], [[-1, 1], [2, 2], [3, 3]]))
    assert p.reversal_mm.tolist() == [2.0, 2.0, 0.0]
    found = {n: getattr(p, n).value_mm for n in ("B", "B_mean", "E", "E_forward", "E_backward", "M", "R_forward", "R_backward", "R")}
    assert found == pytest.approx(
        {
            "B": 2,
            "B_mean": 4 / 3,
            "E": 4,
            "E_forward": 2,
            "E_backward": 3,
            "M": 2,
            "R_forward": 12 * ROOT2,
            "R_backward": 4 * ROOT2,
            "R": 12 * ROOT2,
        }
    )
    assert p.A.value_mm == pytest.approx(12 * ROOT2)
    assert p.A_forward.value_mm == pytest.approx(12 * ROOT2)
    assert p.A_backward.value_mm == pytest.approx(3 + 2 * ROOT2)
    assert (p.lowest, p.most) == (2, 2)


def test_two_positions_and_three_cycles_by_hand():
    """s = 1 everywhere, B = 5 and 1: R = 2 + 2 + 5 at the first position."""
    p = positioning(approaches([[9, 10, 11], [0, 1, 2]], [[4, 5, 6], [-1, 0, 1]]))
    assert {n: getattr(p, n).value_mm for n in ("B", "E", "M", "R", "A")} == pytest.approx({"B": 5, "E": 10, "M": 7, "R": 9, "A": 14})


def test_one_cycle_has_no_repeatability_and_says_so():
    p = positioning(approaches([[1], [2], [4]], [[0], [1], [3]]))
    assert (p.R, p.A, p.s_forward_mm) == (None, None, None)
    assert (p.E.value_mm, p.B.value_mm, p.M.value_mm) == (4.0, 1.0, 3.0)
    assert any("without repeats" in d for d in p.departures())


def by_loops(position, forward, backward) -> dict[str, float]:
    """The same figures once more, one number at a time, with another library's standard deviation."""
    rows = []
    for f, b in zip(forward, backward, strict=True):
        f, b = [v for v in f if v == v], [v for v in b if v == v]
        rows.append((statistics.mean(f), statistics.stdev(f), statistics.mean(b), statistics.stdev(b)))
    means = [m for r in rows for m in (r[0], r[2])]
    ends = [(m + 2 * s, m - 2 * s) for r in rows for m, s in ((r[0], r[1]), (r[2], r[3]))]
    return {
        "E": max(means) - min(means),
        "B": max(abs(r[0] - r[2]) for r in rows),
        "M": max((r[0] + r[2]) / 2 for r in rows) - min((r[0] + r[2]) / 2 for r in rows),
        "R": max(max(2 * r[1] + 2 * r[3] + abs(r[0] - r[2]), 4 * r[1], 4 * r[3]) for r in rows),
        "A": max(e[0] for e in ends) - min(e[1] for e in ends),
    }


@pytest.mark.parametrize(("m", "n", "lost"), [(2, 7, 0), (11, 5, 0), (4, 3, 0), (7, 5, 3), (21, 2, 0)])
def test_any_number_of_positions_and_cycles_against_plain_loops(m, n, lost):
    rng = np.random.default_rng(m * 100 + n)
    f, b = rng.normal(size=(2, m, n)) * rng.uniform(0.5, 3.0, (2, m, 1))
    for k in range(lost):
        f[k, k % n] = np.nan
    p = positioning(approaches(f, b))
    wanted = by_loops(p.position_mm, f.tolist(), b.tolist())
    assert {k: getattr(p, k).value_mm for k in wanted} == pytest.approx(wanted, rel=1e-12)
    assert (p.lowest, p.most) == (n - 1 if lost else n, n)


def test_what_cannot_be_a_test_is_refused():
    with pytest.raises(ValueError, match="two or more"):
        approaches([[1.0]], [[1.0]])
    with pytest.raises(ValueError, match="approached in - direction"):
        approaches([[1.0], [1.0]], [[1.0], [np.nan]])
    with pytest.raises(ValueError, match="growing"):
        approaches([[1.0], [1.0]], [[1.0], [1.0]], [5.0, 5.0])


@pytest.mark.parametrize(("n", "m"), [(5, 6), (1, 25)])
def test_the_stated_uncertainty_is_the_scatter_of_repeated_tests(n, m):
    """Extremes far apart, so that always the same positions decide; 600 tests of one axis, noise 1. One cycle: from the reversals."""
    rng = np.random.default_rng(8)
    true = np.linspace(0.0, 400.0, m)
    back = true - 30.0
    back[m // 2] -= 100.0
    if n == 1:
        back = true - 30.0
    found = [positioning(approaches(true[:, None] + rng.normal(size=(m, n)), back[:, None] + rng.normal(size=(m, n)))) for _ in range(600)]
    for name in ("E", "M", *(("B", "A_forward", "R_forward") if n > 1 else ())):
        values = [getattr(p, name) for p in found]
        if name == "R_forward":  # the largest of six estimates: its scatter is smaller than that of one
            assert np.std([v.value_mm for v in values]) < np.sqrt(np.mean([v.u_mm**2 for v in values]))
        else:
            assert np.sqrt(np.mean([v.u_mm**2 for v in values])) == pytest.approx(np.std([v.value_mm for v in values]), rel=0.2), name


def test_the_scale_counts_by_the_length_between_the_places_that_decide():
    f = np.array([[0.0, 0.0], [0.010, 0.010], [0.002, 0.002]])
    p = positioning(approaches(f, f, [0.0, 400.0, 900.0]), ScaleBudget(slope=1e-6))
    assert p.E.u_mm == pytest.approx(400e-6)
    assert p.B.u_mm == 0.0


@pytest.mark.parametrize("axis", "xyz")
def test_real_axis_tests(shared, axis):
    """Three real tests, against plain loops; in y also against what is known of them: R = 0.0943 mm, 0.0365 without the common drift."""
    at, forward, backward = [], {}, {}
    for k in range(1, 6):
        c = json.loads((shared / "data" / "axis-tests" / f"week42-{axis}" / f"r0{k}.json").read_text())["columns"]
        for t, x, d, v in zip(c["t_s"], c[f"{axis}_mm"], c["direction"], c["deviation_mm"], strict=True):
            at.append((t, x, d, v))
            (forward if d > 0 else backward).setdefault(x, []).append(v)
    places = sorted(forward)
    f, b = [forward[x] for x in places], [backward[x] for x in places]
    p = positioning(approaches(f, b, places))
    wanted = by_loops(places, f, b)
    assert {k: getattr(p, k).value_mm for k in wanted} == pytest.approx(wanted, rel=1e-12)
    if axis == "y":
        assert p.R.value_mm == pytest.approx(0.0943, abs=5e-5)
        t, x, d, v = (np.array(z) for z in zip(*at, strict=True))
        left = without_drift(t, np.stack([(x == q) & (d == s) for q in places for s in (1, -1)], axis=1).astype(float), v)
        clean = positioning(approaches(*([[left[(x == q) & (d == s)].tolist() for q in places] for s in (1, -1)]), places))
        assert clean.R.value_mm == pytest.approx(0.0365, abs=5e-5)


def without_drift(t, place, v):
    """Readings without the one drift, linear and exponential, that is common to all places; least squares over time constants."""

    def fit(tau: float) -> tuple[float, np.ndarray]:
        shape = np.column_stack([t, np.exp(-t / tau)])
        c = np.linalg.lstsq(np.hstack([place, shape]), v, rcond=None)[0]
        return float(np.sum((v - np.hstack([place, shape]) @ c) ** 2)), v - shape @ c[-2:]

    return min((fit(tau) for tau in np.linspace(1.0, 200.0, 200)), key=lambda found: found[0])[1]


ANGLE = np.linspace(0.0, 2.0 * np.pi, 1441)[:-1]


def test_centring_is_no_circular_deviation_and_an_ellipse_is():
    one = circular(CircularTest(ANGLE, 0.003 + 0.02 * np.cos(ANGLE) - 0.01 * np.sin(ANGLE) + 0.005 * np.cos(2 * ANGLE)))
    assert one.G_mm == pytest.approx(0.010, abs=1e-9)
    assert one.G_zone_mm == pytest.approx(0.010, abs=1e-9)
    assert one.centre_mm == pytest.approx((0.02, -0.01), abs=1e-12)
    shifted = circular(CircularTest(ANGLE, 0.003 + 0.02 * np.cos(ANGLE)))
    assert (shifted.F_max_mm, shifted.F_min_mm) == pytest.approx((0.023, -0.017), abs=1e-9)  # about the set-up's centre: with the shift
    assert (one.F_max_centred_mm, one.F_min_centred_mm) == pytest.approx((0.008, -0.002), abs=1e-9)
    assert one.is_whole


def test_the_minimum_zone_is_never_wider_than_the_least_squares_one():
    rng = np.random.default_rng(3)
    for _ in range(5):
        y = sum(a * np.cos(k * ANGLE + b) for k, a, b in zip(range(1, 9), rng.normal(size=8), rng.uniform(0, 6, 8), strict=True))
        spike = np.where(np.abs(ANGLE - 2.0) < 0.05, 3.0, 0.0)
        one = circular(CircularTest(ANGLE, y + spike))
        assert one.G_zone_mm <= one.G_mm * (1.0 + 1e-9)
        tried = min(np.ptp(y + spike - a * np.cos(ANGLE) - b * np.sin(ANGLE)) for a, b in one.centre_mm + rng.normal(size=(400, 2)))
        assert one.G_zone_mm <= tried + 1e-6


def test_both_ways_lost_motion_is_hysteresis():
    """+2 µm on the way out, -2 µm on the way back, 1 µm of two-lobed form in both: H = 4, G(b) = 6, each path alone 2."""
    form = 0.001 * np.cos(2 * ANGLE)
    there, back = (
        CircularTest(ANGLE, 0.002 + form + 0.05 * np.cos(ANGLE)),
        CircularTest(ANGLE[::-1], (-0.002 + form + 0.05 * np.cos(ANGLE))[::-1]),
    )
    both = both_ways(there, back)
    assert both.H_mm == pytest.approx(0.004, abs=2e-6)
    assert both.G_b_mm == pytest.approx(0.006, abs=1e-9)
    assert [circular(c).G_mm for c in (there, back)] == pytest.approx([0.002, 0.002], abs=1e-9)
    assert centred(there).mean() == pytest.approx(0.0, abs=1e-12)


def test_arcs_that_share_nothing_are_refused_and_an_arc_is_no_circle():
    half = ANGLE[:500]
    assert not circular(CircularTest(half, np.cos(3 * half))).is_whole
    with pytest.raises(ValueError, match="share no angle"):
        both_ways(CircularTest(half, np.cos(3 * half)), CircularTest(half + np.pi, np.cos(3 * half)))


def test_the_worst_diagonal_counts_and_a_missing_one_is_named():
    def line(slope: float, gap: float) -> Approaches:
        x = np.linspace(0.0, 800.0, 9)
        return Approaches(x, np.stack([slope * x] * 2, axis=1), np.stack([slope * x - gap] * 2, axis=1))

    found = diagonals({"ppp": line(1e-5, 0.001), "npp": line(-3e-5, 0.002), "pnp": line(0.0, 0.004)})
    assert (found.E_d[0], found.B_d[0], found.M_d[0]) == ("npp", "pnp", "npp")
    assert found.E_d[1].value_mm == pytest.approx(0.026)
    assert found.M_d[1].value_mm == pytest.approx(0.024)
    assert found.missing == ("ppn",)
    with pytest.raises(ValueError, match="'ppp' is not one of"):
        diagonals({"ppp": line(0.0, 0.0)}, FACE)
