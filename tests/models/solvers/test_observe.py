"""Readings of every test: the exact reading, its derivative and its linear form agree; the independent simulator reads the same.

``ABBE_TEST_LONG=1`` takes more chains, and every chain with both sizes of error.
"""

import os
import time
from dataclasses import replace

import numpy as np
import pytest

from abbe.models.geometry.bases import smooth_terms, term_values
from abbe.models.geometry.chain import all_chains, travel_sign
from abbe.models.machine import Machine
from abbe.models.paths import DIAGONALS, diagonal_ends, helix_points, step_diagonal, straight_line
from abbe.models.solvers.observations import RunData, nominal_reading
from abbe.models.solvers.observe import linearise, perpendicular, predict, run_design, run_jacobian, setup_unknowns
from abbe.models.solvers.priors import Priors, term_prior_sd
from abbe.simulators.scenario import MachineConfig
from abbe.simulators.truth.machine import Geometry, Play, rotate
from abbe.simulators.truth.machine import Machine as TrueMachine

STROKE = np.array([[0.0, 600.0], [-50.0, 450.0], [20.0, 470.0]])
TERMS = smooth_terms(4)
BOX = STROKE + np.array([10.0, -10.0])
CENTRE = np.array([300.0, 200.0, 180.0])
LONG = os.environ.get("ABBE_TEST_LONG") == "1"


def machine_of(chain: str, seed: int) -> Machine:
    rng = np.random.default_rng(seed)
    return Machine(chain, STROKE, rng.uniform(-200, 300, (3, 3)), rng.uniform(-150, 150, 3))


def bar(label: str, path: np.ndarray, *, setup: str = "", start_s: float = 0.0, tool_mm=None, radius: float = 150.0) -> RunData:
    n = len(path)
    time_s = start_s + 0.1 * np.arange(n)
    return RunData(
        label, setup or label, "bar", path, np.zeros(n), travel_sign(path), time_s, np.ones(n), CENTRE, radius, None, 1e-3, True, tool_mm
    )


def laser(label: str, path: np.ndarray, tool_mm=None) -> RunData:
    n, middle = len(path), path[len(path) // 2]
    beam = (middle - path[0]) / np.linalg.norm(middle - path[0])
    return RunData(label, label, "laser", path, np.zeros(n), travel_sign(path), 7.0 + np.arange(n), np.ones(n), beam=beam, tool_mm=tool_mm)


def arc(plane: str, first: float, last: float, n: int = 40) -> np.ndarray:
    a, b = ("XYZ".index(letter) for letter in plane)
    t, path = np.linspace(first, last, n), np.tile(CENTRE, (n, 1))
    path[:, a] += 150.0 * np.cos(t)
    path[:, b] += 150.0 * np.sin(t)
    return path


def every_test(rng: np.random.Generator) -> tuple[RunData, ...]:
    """One run of each test of run-format.md 3, some with a tool of their own, two on one cup."""
    tool = rng.uniform(-200, 200, 3)
    line = BOX[:, 0].copy()
    line[1] = BOX[1, 1]
    return (
        bar("helix", helix_points(CENTRE, 150.0, turns=3, n=60, axis=2)),
        bar("again", helix_points(CENTRE, 150.0, turns=3, n=50, axis=2), setup="helix", start_s=300.0),
        bar("short", CENTRE + 2 / 3 * (helix_points(CENTRE, 150.0, turns=3, n=50, axis=2) - CENTRE), tool_mm=tool, radius=100.0),
        bar("circle", arc("XY", 0.0, 2 * np.pi), setup="circle"),
        bar("arc", arc("YZ", -1.9, 1.9), tool_mm=tool),
        laser("steps", step_diagonal(*diagonal_ends(BOX, "npp"), 6, "ZXY")),
        laser("plain", straight_line(*diagonal_ends(BOX, "ppn"), 9), tool),
        laser("line", straight_line(BOX[:, 0], line, 9)),
    )


def draw(rng: np.random.Generator, machine: Machine, setup, size: float) -> np.ndarray:
    p = Priors()
    sd = np.concatenate([term_prior_sd(machine, TERMS, p), np.full(3, p.backlash_mm), setup.prior_sd])
    return size * sd * rng.normal(size=sd.size)


@pytest.mark.parametrize(
    ("chain", "size"), [(c, s) for k, c in enumerate(all_chains()) for s in ([1.0, 10.0] if LONG else [10.0 ** (k % 2)])]
)
def test_the_jacobian_is_the_derivative_of_the_exact_reading(chain, size):
    rng = np.random.default_rng(sum(map(ord, chain)) + int(size))
    machine, runs = machine_of(chain, 3), every_test(rng)
    setup = setup_unknowns(runs, Priors())
    theta = draw(rng, machine, setup, size)
    step = draw(rng, machine, setup, 1.0)  # a direction in which every unknown moves by its own size
    for run in runs:
        value, jacobian = linearise(machine, TERMS, run, setup, theta)
        assert np.array_equal(value, predict(machine, TERMS, run, setup, theta))
        assert np.array_equal(jacobian, run_jacobian(machine, TERMS, run, setup, theta))
        # Richardson's central difference: what is left is of fourth order in the size of the errors
        near, far = (
            (predict(machine, TERMS, run, setup, theta + h * step) - predict(machine, TERMS, run, setup, theta - h * step)) / (2 * h)
            for h in (0.5, 1.0)
        )
        want = (4 * near - far) / 3
        assert np.abs(jacobian @ step - want).max() < 1e-7 * np.abs(want).max()


@pytest.mark.parametrize("chain", ["w-X-Y-b-Z-t", "w-Z-b-X-Y-t", *(["w-b-X-Y-Z-t", "w-Y-X-Z-b-t"] if LONG else [])])
def test_every_single_column_is_the_derivative_by_its_own_unknown(chain):
    rng = np.random.default_rng(11)
    machine, runs = machine_of(chain, 5), every_test(rng)
    setup = setup_unknowns(runs, Priors())
    theta, sizes = draw(rng, machine, setup, 3.0), np.abs(draw(rng, machine, setup, 1.0)) + 1e-12
    names = [t.name for t in TERMS] + ["lost"] * 3 + list(setup.names)
    for run in runs:
        jacobian = run_jacobian(machine, TERMS, run, setup, theta)
        for k, h in enumerate(sizes):
            step = np.zeros(theta.size)
            step[k] = h
            want = (predict(machine, TERMS, run, setup, theta + step) - predict(machine, TERMS, run, setup, theta - step)) / 2
            assert np.abs(jacobian[:, k] * h - want).max() < 1e-7 * np.abs(want).max() + 2e-13, (run.label, names[k])


@pytest.mark.parametrize("chain", all_chains())
def test_the_linear_form_is_the_derivative_at_a_perfect_machine(chain):
    rng = np.random.default_rng(2)
    machine, runs = machine_of(chain, 1), every_test(rng)
    setup = setup_unknowns(runs, Priors())
    zero = np.zeros(len(TERMS) + 3 + len(setup.names))
    for run in runs:
        design = run_design(machine, TERMS, run, setup)
        assert np.array_equal(design, run_jacobian(machine, TERMS, run, setup, zero))
        assert predict(machine, TERMS, run, setup, zero) == pytest.approx(nominal_reading(run), abs=1e-12)
        small = draw(rng, machine, setup, 1e-3)
        exact = predict(machine, TERMS, run, setup, small) - predict(machine, TERMS, run, setup, zero)
        assert np.abs(exact - design @ small).max() < 1e-3 * np.abs(exact).max()  # second order


class Motions:
    """The smooth terms as the independent simulator wants them: per axis a function of its position, and squareness apart."""

    def __init__(self, machine: Machine, theta: np.ndarray) -> None:
        self.machine, self.theta = machine, theta
        self.squareness = (0.0, 0.0, 0.0)
        self.motions = [lambda p, a=a: self.of(a, p) for a in range(3)]

    def of(self, axis: int, position_mm: np.ndarray) -> np.ndarray:
        at = np.tile(STROKE[:, :1].T, (len(position_mm), 1))
        at[:, axis] = position_mm
        values = term_values(TERMS, at, STROKE)
        out = np.zeros((len(position_mm), 6))
        for k, t in enumerate(TERMS):
            if t.axis == axis:
                out[:, t.component] += values[:, k] * self.theta[k]
        return out


def truth_of(machine: Machine, theta: np.ndarray, tool_mm: np.ndarray | None) -> TrueMachine:
    tool = machine.tool_mm if tool_mm is None else tool_mm
    strokes = dict(zip("XYZ", map(tuple, STROKE), strict=True))
    pivots = dict(zip("XYZ", map(tuple, machine.pivots_mm), strict=True))
    base = MachineConfig()
    config = replace(
        base,
        chain=machine.chain,
        stroke_mm=replace(base.stroke_mm, **strokes),
        pivots_mm=replace(base.pivots_mm, **pivots),
        tool_mm=tuple(tool),
    )
    return TrueMachine(Geometry(config), Motions(machine, theta))


@pytest.mark.parametrize("chain", ["w-b-X-Y-Z-t", "w-X-Y-b-Z-t", "w-Z-b-X-Y-t", "w-Y-X-Z-b-t", "w-X-b-Y-Z-t"])
@pytest.mark.parametrize("lost_motion", [False, True])
def test_the_independent_simulator_reads_the_same(chain, lost_motion):
    """Positions from `abbe.simulators.truth` (its own transforms and play), instruments written out here from math.md 4.2 and 5.4.

    With lost motion the simulator's errors are those of the place where the axis stands, the model's of the commanded one: 1e-3 of 25 um.
    Where a drive has not yet taken up its play after a turn, the model has the axis at its end: such readings are left out here.
    """
    rng = np.random.default_rng(8)
    machine, runs = machine_of(chain, 4), every_test(rng)
    setup = setup_unknowns(runs, Priors())
    theta = draw(rng, machine, setup, 2.0)
    n = len(TERMS)
    lost = np.array([12e-3, 25e-3, 8e-3]) if lost_motion else np.zeros(3)
    theta[n : n + 3] = lost
    settled = []
    by_name = dict(zip(setup.names, theta[n + 3 :], strict=True))
    for run in runs:
        truth, values = truth_of(machine, theta, run.tool_mm), predict(machine, TERMS, run, setup, theta)
        approach = run.axes_mm[:1] - 5.0 * run.sign[:1]
        play = np.where(run.sign.any(axis=0), lost, 0.0)  # an axis that rests has no side
        stands = Play(play, approach[0]).run(np.concatenate([approach, run.axes_mm]))[1:]
        clear = (np.abs(stands - (run.axes_mm - 0.5 * run.sign * play)) < 1e-12).all(axis=1)
        settled.append(clear)
        at = truth.tool_position(stands)
        if run.kind == "bar":
            offset, drift = (np.array([by_name.get(f"{kind}_{run.setup}_{a}", 0.0) for a in "xyz"]) for kind in ("cup", "bar_drift"))
            cup = truth.tool_position(run.centre_mm[None])[0] + offset
            since = run.t_s - (0.0 if run.setup == "helix" else run.t_s[0])
            want = np.linalg.norm(at + np.outer(since, drift) - cup, axis=1) - run.radius_mm + by_name[f"bar_length_{run.radius_mm:g}"]
        else:
            e1, e2 = perpendicular(run.beam)
            t1, t2 = (by_name.get(f"tilt_{run.setup}_{k}", 0.0) for k in "12")
            mirror = run.beam + t1 * e1 + t2 * e2
            turned = rotate(truth.turned(stands), np.tile(mirror, (len(at), 1)))
            factor = (1 + by_name[f"cosine_{run.setup}"]) * (1 + by_name["laser_scale"])
            seen = np.einsum("ij,ij->i", at - at[0], turned) / (turned @ run.beam) * factor
            want = seen - (run.axes_mm - run.axes_mm[0]) @ run.beam
            want += by_name[f"zero_{run.label}"] + by_name[f"drift_{run.label}"] * (run.t_s - run.t_s[0])
        assert values[clear] == pytest.approx(want[clear], abs=2e-5 if lost_motion else 1e-11)
    kinds = {run.kind for run, clear in zip(runs, settled, strict=True) if clear.mean() > 0.8}
    assert kinds == {"bar", "laser"}  # both instruments are really compared


def test_a_misaligned_beam_is_one_number():
    """math.md 5.4: a beam l = n + u shows m.(P - O) / (m.l); the reading with 1 / (m.l) - 1 as the unknown is the same, for any u."""
    run = laser("d", step_diagonal(*diagonal_ends(BOX, "ppp"), 5))
    setup = setup_unknowns((run,), Priors())
    machine = machine_of("w-X-Y-b-Z-t", 1)
    theta = np.zeros(len(TERMS) + 3 + len(setup.names))
    e1, e2 = perpendicular(run.beam)
    beam = run.beam + 1e-3 * e1 - 0.4e-3 * e2
    beam /= np.linalg.norm(beam)
    mirror = run.beam + 0.5e-3 * e1 + 0.2e-3 * e2
    for name, value in (("tilt_d_1", 0.5e-3), ("tilt_d_2", 0.2e-3), ("cosine_d", 1.0 / (mirror @ beam) - 1.0)):
        theta[len(TERMS) + 3 + setup.names.index(name)] = value
    moved = run.axes_mm - run.axes_mm[0]
    want = moved @ mirror / (mirror @ beam) - moved @ run.beam
    assert predict(machine, TERMS, run, setup, theta) == pytest.approx(want, abs=1e-12)
    assert abs(1.0 / (mirror @ beam) - 1.0) < 1e-6  # 1 mrad: half a part in a million, more or less by the tilt


def test_lost_motion_stands_where_the_axis_lags():
    run = laser("l", straight_line(np.array([50.0, 0.0, 100.0]), np.array([450.0, 0.0, 100.0]), 5))
    setup, machine = setup_unknowns((run,), Priors()), Machine("w-b-X-Y-Z-t", STROKE)
    theta = np.zeros(len(TERMS) + 3 + len(setup.names))
    theta[len(TERMS)] = 4e-3
    assert predict(machine, TERMS, run, setup, theta) == pytest.approx([0.0] * 6 + [4e-3] * 4, abs=1e-12)  # sixth record: still at the turn


def test_the_cup_carries_the_machine_so_its_unknown_is_the_mounting():
    machine = machine_of("w-X-Y-b-Z-t", 2)
    run = bar("h", helix_points(CENTRE, 150.0, turns=3, n=80, axis=2))
    setup = setup_unknowns((run,), Priors())
    theta = np.zeros(len(TERMS) + 3 + len(setup.names))
    for name in ("EXX.1", "EYY.1", "EZZ.1"):  # one scale for all: the ball stays a ball about a cup that went along
        k = [t.name for t in TERMS].index(name)
        theta[k] = 50e-6 * machine.length_mm["XYZ".index(name[1])] / 2
    assert predict(machine, TERMS, run, setup, theta) == pytest.approx(50e-6 * 150.0, rel=1e-9)


def test_unknowns_of_one_mounting_are_shared_and_the_rest_is_not():
    runs = every_test(np.random.default_rng(1))
    names = setup_unknowns(runs, Priors()).names
    assert len(set(names)) == len(names)
    assert sum(n.startswith("cup_") for n in names) == 3 * 4  # helix and again are one mounting
    assert sum(n.startswith("bar_length_") for n in names) == 2
    assert sum(n.startswith("tilt_") for n in names) == 2  # a straight path shows no tilt
    assert sum(n.startswith("cosine_") for n in names) == 3
    assert names.count("laser_scale") == 1
    bars_only = setup_unknowns(runs[:5], Priors()).names
    assert not any(n.startswith(("laser", "zero", "cosine", "drift")) for n in bars_only)


def test_a_drift_that_cannot_matter_is_no_unknown():
    run = bar("h", helix_points(CENTRE, 150.0, turns=3, n=50, axis=2))  # 4.9 s
    assert not any(n.startswith("bar_drift") for n in setup_unknowns((run,), Priors()).names)
    later = replace(run, label="h2", t_s=run.t_s + 600.0)
    assert sum(n.startswith("bar_drift") for n in setup_unknowns((run, later), Priors()).names) == 3


@pytest.mark.parametrize("what", ["cup", "beam", "tool", "instrument"])
def test_what_was_re_mounted_is_not_one_set_up(what):
    first, second = bar("a", arc("XY", 0.0, 6.0), setup="S"), bar("b", arc("XY", 0.0, 6.0), setup="S")
    if what == "cup":
        second = replace(second, centre_mm=CENTRE + 1.0)
    elif what == "tool":
        second = replace(second, tool_mm=np.array([0.0, 0.0, -200.0]))
    else:
        line = replace(laser("b", straight_line(BOX[:, 0], BOX[:, 1], 5)), setup="S")
        if what == "beam":
            first = replace(line, label="a", beam=-line.beam)
        second = line
    with pytest.raises(ValueError, match=f"run b: set-up S has another {what} than in run a"):
        setup_unknowns((first, second), Priors(), Machine("w-b-X-Y-Z-t", STROKE))


def test_a_tool_that_is_not_stated_is_the_machine_s():
    """Said or left unsaid, one tool is one set-up; two stated ones are not, whatever stands between them."""
    machine = machine_of("w-X-Y-b-Z-t", 1)
    unsaid = bar("a", arc("XY", 0.0, 6.0), setup="S")
    said = replace(unsaid, label="b", tool_mm=machine.tool_mm)
    other = replace(unsaid, label="c", tool_mm=machine.tool_mm + 5.0)
    both = setup_unknowns((unsaid, said), Priors(), machine)
    assert both.names == setup_unknowns((said, unsaid), Priors()).names == setup_unknowns((unsaid,), Priors()).names
    for runs in ((unsaid, said, other), (said, unsaid, other)):
        with pytest.raises(ValueError, match="run c: set-up S has another tool"):
            setup_unknowns(runs, Priors())
    with pytest.raises(ValueError, match="run c: set-up S has another tool"):
        setup_unknowns((unsaid, other), Priors(), machine)


def test_a_bar_is_one_whatever_the_last_digits_of_its_stored_length():
    """A calibrated length rounded up or down, and 150.0004 beside 150.0006, are one bar; 0.3 mm more is another."""
    radii = (150.00049, 150.00051, 150.0, 149.9999)
    runs = tuple(replace(bar(f"r{k}", arc("XY", 0.0, 6.0)), radius_mm=r) for k, r in enumerate(radii))
    assert [n for n in setup_unknowns(runs, Priors()).names if n.startswith("bar_length")] == ["bar_length_150"]
    longer = replace(runs[0], label="l", radius_mm=150.3)
    names = setup_unknowns((*runs, longer), Priors()).names
    assert [n for n in names if n.startswith("bar_length")] == ["bar_length_150", "bar_length_150.3"]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"radius_mm": 0.0}, "radius_mm must be above 0"),
        ({"radius_mm": -5.0}, "radius_mm must be above 0"),
        ({"radius_mm": np.nan}, "radius_mm must be above 0"),
        ({"centre_mm": np.full(3, np.nan)}, "centre_mm must be three finite numbers"),
        ({"deviation_mm": (3, np.nan)}, "deviation_mm is not a finite number in 1 of 8 readings, first in reading 4"),
        ({"t_s": (0, np.nan)}, "t_s is not a finite number in 1 of 8 readings, first in reading 1"),
        ({"sign": (7, np.nan)}, "sign is not a finite number in 1 of 8 readings, first in reading 8"),
        ({"axes_mm": (2, np.inf)}, "axes_mm is not a finite number in 1 of 8"),
        ({"weight_n": (1, 0.0)}, "every weight_n must be above 0"),
        ({"weight_n": (1, np.nan)}, "weight_n is not a finite number"),
        ({"axes_mm": (5, CENTRE)}, "reading 6 is on the cup's centre"),
    ],
)
def test_what_is_no_measurement_is_refused_by_the_name_of_its_run(change, said):
    run = bar("h7", arc("XY", 0.0, 6.0, 8))
    for name, value in change.items():
        if isinstance(value, tuple):
            column = getattr(run, name).copy()
            column[value[0]] = value[1]
            change = {name: column}
    with pytest.raises(ValueError, match=f"run h7: {said}"):
        replace(run, **change)


def test_unknowns_of_another_campaign_are_refused():
    run = bar("h", arc("XY", 0.0, 6.0))
    setup = setup_unknowns((run,), Priors())
    with pytest.raises(ValueError, match="run h: 5 unknowns given"):
        predict(machine_of("w-b-X-Y-Z-t", 0), TERMS, run, setup, np.zeros(5))


def test_a_large_campaign_is_linearised_in_a_quarter_of_a_second():
    """10 helices x 500 points and 8 step diagonals at Legendre order 9; the best of five, because the computer has other work too."""
    machine, terms = machine_of("w-X-Y-b-Z-t", 1), smooth_terms(9)
    runs = [bar(f"h{k}", helix_points(CENTRE, 150.0, turns=5, n=500, axis=2)) for k in range(10)]
    runs += [laser(f"{d}{o}", step_diagonal(*diagonal_ends(BOX, d), 12, o)) for o in ("XYZ", "ZYX") for d in DIAGONALS]
    setup = setup_unknowns(tuple(runs), Priors())
    theta = np.full(len(terms) + 3 + len(setup.names), 1e-7)

    def seconds() -> float:
        start = time.process_time()
        for run in runs:
            linearise(machine, terms, run, setup, theta)
        return time.process_time() - start

    assert min(seconds() for _ in range(5)) < 0.25
