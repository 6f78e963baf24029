"""From stored runs to arrays: which test they are, what a dropped first record changes, and what one spike does to a block."""

import json
from dataclasses import replace

import numpy as np
import pytest

from abbe.models.geometry.bases import smooth_terms
from abbe.models.geometry.chain import travel_sign
from abbe.models.machine import Machine
from abbe.models.paths import diagonal_ends, helix_points, step_diagonal, straight_line
from abbe.models.solvers.observations import RunData, bar_normals, block_average, nominal_reading, reading_noise_mm
from abbe.models.solvers.observe import predict, setup_unknowns
from abbe.models.solvers.priors import Priors
from abbe.service.errors import MeasurementFault
from abbe.service.runs.observations import BLOCKS, bar_noise_mm, run_data
from tests.run_documents import run_of

CENTRE = np.array([300.0, 250.0, 100.0])
NOISE_MM = 5e-4


def helix(n: int = 4000, seed: int = 0, cup_mm: float = 20e-3) -> RunData:
    """A helix with a cup beside its place and half a micrometre of noise."""
    p = helix_points(CENTRE, 150.0, turns=5, n=n, axis=2)
    reading = np.linalg.norm(p - CENTRE - np.array([cup_mm, 0.0, 0.0]), axis=1) - 150.0
    reading += np.random.default_rng(seed).normal(0, NOISE_MM, n)
    return RunData("h", "h", "bar", p, reading, travel_sign(p), np.arange(n) * 0.03, np.ones(n), CENTRE, 150.0)


def test_one_spike_does_not_move_the_mean_of_its_block():
    clean = helix()
    spiked = clean.deviation_mm.copy()
    at = np.arange(7, 4000, 200)
    spiked[at] += 20e-3 * np.where(np.arange(at.size) % 2, 1.0, -1.0)
    run = block_average(replace(clean, deviation_mm=spiked), 400)
    want = block_average(clean, 400)
    assert run.rejected == at.size
    assert run.weight_n.sum() == 4000 - at.size
    # what is left of a spiked block is the noise of its other nine readings, not 20 um / 10
    left = run.deviation_mm - nominal_reading(run) + 20e-3 * bar_normals(run)[:, 0]
    assert (np.abs(left) < 5 * NOISE_MM / np.sqrt(run.weight_n)).all()
    plain = np.bincount(np.arange(4000) // 10, spiked - nominal_reading(clean) + 20e-3 * bar_normals(clean)[:, 0])[at // 10] / 10
    assert np.abs(plain).min() > 1.4e-3  # a plain mean
    untouched = run.weight_n == want.weight_n
    assert untouched.sum() == run.deviation_mm.size - at.size
    assert np.array_equal(run.deviation_mm[untouched], want.deviation_mm[untouched])


def test_two_spikes_in_one_block_go_too_and_their_positions_with_them():
    clean = helix()
    spiked = clean.deviation_mm.copy()
    spiked[[103, 106]] += 20e-3
    run = block_average(replace(clean, deviation_mm=spiked), 400)
    assert run.rejected == 2
    block = int(np.flatnonzero(run.weight_n == 8)[0])
    kept = np.setdiff1d(np.arange(100, 110), [103, 106])
    assert run.axes_mm[block] == pytest.approx(clean.axes_mm[kept].mean(axis=0))
    assert run.t_s[block] == pytest.approx(clean.t_s[kept].mean())


@pytest.mark.parametrize("seed", range(3))
def test_noise_and_steady_motion_are_no_outliers(seed):
    assert block_average(helix(seed=seed), 400).rejected <= 1  # of 4000 at five standard deviations
    fast = helix(n=600, seed=seed, cup_mm=0.2)  # the bar grows by 3 um from one reading to the next
    assert np.abs(np.diff(fast.deviation_mm)).max() > 5 * NOISE_MM
    assert block_average(fast, 60).rejected <= 1


def test_rounding_is_no_outlier():
    run = helix(cup_mm=0.0)
    coarse = np.zeros(4000)
    coarse[::9] = 1e-4
    assert block_average(replace(run, deviation_mm=coarse), 400).rejected == 0


def test_blocks_of_two_reject_nothing():
    run = helix(n=800)
    spiked = run.deviation_mm.copy()
    spiked[50] += 20e-3
    assert block_average(replace(run, deviation_mm=spiked), 400).rejected == 0


def test_noise_of_a_reading_is_told_by_its_neighbours():
    assert reading_noise_mm(helix().deviation_mm) == pytest.approx(NOISE_MM, rel=0.1)
    assert reading_noise_mm(np.zeros(2)) == 0.0


def stored(test: str, path: np.ndarray, deviation_mm: np.ndarray | None, **setup) -> dict:
    columns = {f"{c}_mm": path[:, k].tolist() for k, c in enumerate("xyz")}
    columns |= {"t_s": (100.0 + np.arange(len(path))).tolist(), "deviation_mm": None if deviation_mm is None else deviation_mm.tolist()}
    return {"run_id": "r1", "test": test, "role": "identify", "setup": {"setup_id": "S", "t_set_s": 0.0} | setup, "columns": columns}


BOX = np.array([[50.0, 550.0], [40.0, 460.0], [30.0, 400.0]])


def test_every_test_of_the_format_becomes_a_run():
    t = np.linspace(0.0, 4.0, 50)
    around = CENTRE + 150.0 * np.column_stack([np.zeros(50), np.cos(t), np.sin(t)])
    start, end = diagonal_ends(BOX, "npp")
    along = (end - start) / np.linalg.norm(end - start)
    line = straight_line(np.array([50.0, 460.0, 30.0]), np.array([50.0, 40.0, 30.0]), 8)
    made = {
        "helix": stored(
            "ballbar_helix", helix_points(CENTRE, 150.0, turns=3, n=50), np.zeros(50), centre_mm=list(CENTRE), radius_mm=150, turns=3
        ),
        "circle": stored("ballbar_circle", around, np.zeros(50), centre_mm=list(CENTRE), radius_mm=150, plane="YZ"),
        "steps": stored(
            "laser_diagonal", p := step_diagonal(start, end, 5), np.zeros(len(p)), diagonal="npp", nominal_beam=list(along), order="XYZ"
        ),
        "plain": stored(
            "laser_diagonal", straight_line(start, end, 8), np.zeros(16), diagonal="npp", start_mm=list(start), end_mm=list(end)
        ),
        "linear": stored("laser_linear", line, np.zeros(16), axis="Y", start_mm=list(line[0]), end_mm=list(line[7])),
    }
    runs = {name: run_data(run_of(run)) for name, run in made.items()}
    assert {name: (r.kind, r.test) for name, r in runs.items()} == {
        "helix": ("bar", "helix"),
        "circle": ("bar", "circle"),
        "steps": ("laser", "diagonal"),
        "plain": ("laser", "diagonal"),
        "linear": ("laser", "linear"),
    }
    assert runs["plain"].beam == pytest.approx(along)  # stated nowhere: along the test
    assert runs["linear"].beam == pytest.approx([0.0, -1.0, 0.0])
    tilted = {name: any(n.startswith("tilt_") for n in setup_unknowns((r,), Priors()).names) for name, r in runs.items()}
    assert [name for name, found in tilted.items() if found] == ["steps"]


def test_a_run_of_the_shared_campaigns(shared):
    run = json.loads((shared / "data" / "axis-tests" / "week42-y" / "r01.json").read_text())
    data = run_data(run_of(run))
    assert (data.kind, data.test, data.setup) == ("laser", "linear", "L")
    assert data.beam.tolist() == [0.0, 1.0, 0.0]
    assert data.deviation_mm.size == 10


def test_a_dropped_first_record_does_not_shift_the_others():
    """The laser counts from a record that is not there; the run counts from its own first one, and so does the model."""
    machine, terms = Machine("w-X-Y-b-Z-t", BOX), smooth_terms(3)
    path = step_diagonal(*diagonal_ends(BOX, "ppp"), 6)
    beam = (BOX[:, 1] - BOX[:, 0]) / np.linalg.norm(BOX[:, 1] - BOX[:, 0])
    whole = RunData(
        "r1", "S", "laser", path, np.zeros(len(path)), travel_sign(path), 100.0 + np.arange(len(path)), np.ones(len(path)), beam=beam
    )
    setup = setup_unknowns((whole,), Priors())
    theta = np.random.default_rng(1).normal(0, 1e-3, len(terms) + 3 + len(setup.names)) * 0.02
    for name in ("zero_r1", "drift_r1"):
        theta[len(terms) + 3 + setup.names.index(name)] = 0.0
    reading = predict(machine, terms, whole, setup, theta)
    run = stored("laser_diagonal", path, reading, diagonal="ppp", nominal_beam=list(beam))
    run["columns"]["valid"] = [0, *[1] * (len(path) - 1)]
    late = run_data(run_of(run))
    assert late.deviation_mm[0] == 0.0
    assert predict(machine, terms, late, setup, theta) == pytest.approx(late.deviation_mm, abs=1e-6)
    assert run_data(run_of(stored("laser_diagonal", path, reading, nominal_beam=list(beam)))).deviation_mm == pytest.approx(reading)


def test_long_runs_are_averaged_and_what_was_left_out_is_counted():
    clean = helix()
    spiked = clean.deviation_mm.copy()
    spiked[1234] += 20e-3
    run = run_data(run_of(stored("ballbar_helix", clean.axes_mm, spiked, centre_mm=list(CENTRE), radius_mm=150, turns=5)))
    assert BLOCKS <= run.deviation_mm.size <= BLOCKS + 40
    assert run.rejected == 1
    assert np.abs(run.deviation_mm - nominal_reading(run)).max() < 25e-3


def test_what_cannot_be_solved_says_so():
    path = straight_line(BOX[:, 0], BOX[:, 1], 8)
    with pytest.raises(MeasurementFault, match="run r1: it is sealed"):
        run_data(run_of(stored("laser_diagonal", path, None, nominal_beam=[1, 0, 0])))
    with pytest.raises(MeasurementFault, match="run r1: the solver does not know the test 'gauge_block'"):
        run_data(run_of(stored("gauge_block", path, np.zeros(16))))
    few = stored("laser_diagonal", path, np.zeros(16), nominal_beam=[1, 0, 0])
    few["columns"]["valid"] = [1] * 9 + [0] * 7
    with pytest.raises(MeasurementFault, match="run r1: only 9 valid readings of 16"):
        run_data(run_of(few))


def test_an_invalid_row_may_hold_nothing_at_all():
    """No position, no reading: the rows beside it keep their direction of travel, the noise is that of the others."""
    path = helix_points(CENTRE, 150.0, turns=3, n=50)
    reading = np.random.default_rng(2).normal(0, 1e-3, 50)
    whole = stored("ballbar_helix", path, reading, centre_mm=list(CENTRE), radius_mm=150, turns=3)
    holed = json.loads(json.dumps(whole))
    holed["columns"]["valid"] = [int(k != 3) for k in range(50)]
    for name in ("x_mm", "y_mm", "z_mm", "deviation_mm"):
        holed["columns"][name][3] = None
    found, left = run_data(run_of(holed)), np.delete(np.arange(50), 3)
    assert np.array_equal(found.sign, run_data(run_of(whole)).sign[left])
    assert bar_noise_mm(run_of(holed)) == reading_noise_mm(reading[left])
    assert bar_noise_mm(run_of(whole)) == reading_noise_mm(reading)


@pytest.mark.parametrize(
    ("test", "setup", "said"),
    [
        ("ballbar_helix", {"centre_mm": list(CENTRE), "radius_mm": 0}, "radius_mm must be above 0"),
        ("laser_diagonal", {"start_mm": [1, 2, 3], "end_mm": [1, 2, 3]}, "a laser run needs nominal_beam"),
        ("laser_diagonal", {"nominal_beam": [0, 0, 0]}, "a laser run needs nominal_beam"),
    ],
)
def test_a_set_up_without_length_or_direction_is_named(test, setup, said):
    path = helix_points(CENTRE, 150.0, turns=3, n=50)
    with pytest.raises(MeasurementFault, match=f"run r1: {said}"):
        run_data(run_of(stored(test, path, np.zeros(50), **setup)))


def test_a_beam_that_is_no_direction_is_refused():
    n = 12
    for beam in (np.array([1.0, 1.0, 1.0]), np.ones(2), None):
        with pytest.raises(ValueError, match="run l: a laser run needs its nominal beam, a unit vector"):
            RunData("l", "l", "laser", np.zeros((n, 3)), np.zeros(n), np.zeros((n, 3)), np.zeros(n), np.ones(n), beam=beam)
