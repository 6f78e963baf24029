"""Rule G against the exact transforms for all 24 chains, those against homogeneous matrices, and the ranks that math.md 4.6 states."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from abbe.models.geometry.bases import smooth_terms
from abbe.models.geometry.chain import all_chains, design, deviation_mm, exact_deviation_mm, travel_sign
from abbe.models.geometry.rotation import matrix_zyx
from abbe.models.geometry.volume import volume_grid
from abbe.models.machine import AXES, Machine, levers_mm, split_chain
from abbe.models.solvers.least_squares import analyse
from tests.experiments.mathematics.presets import PRESETS, preset

STROKE = np.array([[0.0, 600.0], [0.0, 500.0], [0.0, 450.0]])
CHAINS = all_chains()


@pytest.mark.parametrize("chain", CHAINS)
def test_first_order_differs_from_exact_by_second_order(chain):
    rng = np.random.default_rng(CHAINS.index(chain))
    m = Machine(chain, STROKE, rng.uniform(-300, 300, (3, 3)), np.array([10.0, -20.0, -120.0]))
    p = rng.uniform(STROKE[:, 0], STROKE[:, 1], (50, 3))
    errors = np.concatenate([rng.normal(0, 10e-3, (50, 3, 3)), rng.normal(0, 30e-6, (50, 3, 3))], axis=2)

    def gap(scale):
        return np.abs(exact_deviation_mm(m, p, scale * errors) - deviation_mm(m, p, scale * errors)).max()

    assert gap(1.0) < 1e-5
    assert gap(1.0) / gap(0.5) == pytest.approx(4.0, abs=0.4)


def test_work_side_levers_include_own_travel_and_tool_side_levers_do_not():
    p = np.array([[100.0, 50.0, 25.0]])
    errors = np.zeros((1, 3, 6))
    errors[0, 0, 5] = 1e-6  # ECX
    table = deviation_mm(Machine("w-X-b-Y-Z-t", STROKE), p, errors)
    head = deviation_mm(Machine("w-b-X-Y-Z-t", STROKE), p, errors)
    assert table == pytest.approx(1e-6 * np.array([[-50.0, 100.0, 0.0]]))
    assert head == pytest.approx(1e-6 * np.array([[-50.0, 0.0, 0.0]]))


@pytest.mark.parametrize(("degree", "rank"), [(1, 11), (2, 25), (3, 39)])
def test_rank_of_a_full_vector_map_with_one_tool_is_that_of_the_specification(degree, rank):
    m = Machine("w-Z-b-X-Y-t", np.array([[0, 812.8], [0, 495.0], [0, 508.0]]), tool_mm=np.array([0.0, 0.0, 150.0]))
    terms = smooth_terms(degree)
    points = volume_grid(m.stroke_mm, 6)
    full = design(m, terms, points)
    rigid = np.eye(3)[None].repeat(len(points), 0)
    from abbe.models.solvers.least_squares import project_out

    a = project_out(full.reshape(-1, len(terms)), rigid.reshape(-1, 3))
    found = analyse(tuple(t.name for t in terms), a)
    assert (found.n_parameters, found.rank) == (18 * degree - 3, rank)


@pytest.mark.parametrize("bad", ["w-X-Y-b-Z", "X-Y-Z", "w-X-X-b-Z-t", "w-X-Y-Z-t", ""])
def test_a_chain_that_is_no_chain_is_refused(bad):
    with pytest.raises(ValueError, match="chain"):
        split_chain(bad)


def test_travel_sign_holds_while_resting_and_looks_ahead_at_the_start():
    p = np.array([[0, 0, 0], [1, 0, 0], [1, 0, 0], [1, 2, 0], [0, 2, 0]], dtype=float)
    assert travel_sign(p).tolist() == [[1, 1, 0], [1, 1, 0], [1, 1, 0], [1, 1, 0], [-1, 1, 0]]


def own_rotation(form, e):
    """The carriage's own rotation as a matrix, from scipy or written out, not from the model."""
    if form == "vector":
        return Rotation.from_rotvec(e).as_matrix()
    if form == "zyx":
        return (Rotation.from_euler("z", e[2]) * Rotation.from_euler("y", e[1]) * Rotation.from_euler("x", e[0])).as_matrix()
    return np.array([[1, -e[2], e[1]], [e[2], 1, -e[0]], [-e[1], e[0], 1]])


def homogeneous(form, chain, pivots, tool, x, motion):
    """Functional point seen from the workpiece by 4 x 4 transforms: every carriage's own motion, the work side inverted as a whole."""

    def carriage(j, sign):
        """Travel and error of a carriage in machine axes; a table moves the other way (sign -1)."""
        here, there, turn = np.eye(4), np.eye(4), np.eye(4)
        turn[:3, :3] = own_rotation(form, sign * motion[j, 3:])
        here[:3, 3], there[:3, 3] = pivots[j], -pivots[j]
        shift = np.eye(4)
        shift[:3, 3] = sign * (x[j] * np.eye(3)[j] + motion[j, :3])
        return shift @ here @ turn @ there

    before, after = chain.split("-b")
    tool_side, work_side = np.eye(4), np.eye(4)
    for letter in after.strip("-").split("-")[:-1]:
        tool_side = tool_side @ carriage(AXES.index(letter), 1.0)
    for letter in reversed(before.split("-")[1:]):
        work_side = work_side @ carriage(AXES.index(letter), -1.0)
    return (np.linalg.inv(work_side) @ tool_side @ np.append(tool, 1.0))[:3]


@pytest.mark.parametrize("form", ["vector", "zyx", "small"])
@pytest.mark.parametrize("chain", CHAINS)
def test_exact_forms_are_the_homogeneous_transforms(chain, form):
    rng = np.random.default_rng(100 + CHAINS.index(chain))
    m = Machine(chain, STROKE, rng.uniform(-300, 300, (3, 3)))
    p, tools = rng.uniform(STROKE[:, 0], STROKE[:, 1], (5, 3)), rng.uniform(-200, 200, (5, 3))
    errors = np.concatenate([rng.normal(0, 1, (5, 3, 3)), rng.normal(0, 0.02, (5, 3, 3))], axis=2)  # large, so that forms part by 0.1 mm
    got = exact_deviation_mm(m, p, errors, tools, rotation=form)
    want = [homogeneous(form, chain, m.pivots_mm, tools[i], p[i], errors[i]) - p[i] - tools[i] for i in range(5)]
    assert got == pytest.approx(np.array(want), abs=2e-12, rel=0)


def test_an_unknown_form_of_rotation_is_refused():
    with pytest.raises(ValueError, match="rotation 'xyz'"):
        exact_deviation_mm(Machine("w-b-X-Y-Z-t", STROKE), np.zeros((1, 3)), np.zeros((1, 3, 6)), rotation="xyz")


def test_there_are_24_different_chains_and_each_is_one():
    assert len(CHAINS) == len(set(CHAINS)) == 24
    assert all(sorted((*split_chain(c)[0], *split_chain(c)[1])) == [0, 1, 2] for c in CHAINS)


@pytest.mark.parametrize("chain", CHAINS)
def test_a_tool_per_point_is_each_point_with_its_own_machine(chain):
    rng = np.random.default_rng(7)
    m = Machine(chain, STROKE, rng.uniform(-300, 300, (3, 3)))
    p, tools = rng.uniform(0, 400, (6, 3)), rng.uniform(-200, 200, (6, 3))
    errors = rng.normal(0, 1e-4, (6, 3, 6))
    for i in range(6):
        own, one = Machine(chain, STROKE, m.pivots_mm, tools[i]), slice(i, i + 1)
        for f in (deviation_mm, exact_deviation_mm):
            assert f(m, p, errors, tools)[one] == pytest.approx(f(own, p[one], errors[one]), abs=1e-15)
            assert f(m, p, errors, tools[i])[one] == pytest.approx(f(own, p[one], errors[one]), abs=1e-15)


@pytest.mark.parametrize("shape", [(2,), (5, 3), (6, 2), (1, 3)])
def test_a_tool_of_another_shape_is_refused(shape):
    with pytest.raises(ValueError, match="tool_mm"):
        levers_mm(Machine("w-b-X-Y-Z-t", STROKE), np.zeros((6, 3)), np.zeros(shape))


@pytest.mark.parametrize("f", [deviation_mm, exact_deviation_mm])
def test_motions_of_another_shape_are_refused(f):
    m = Machine("w-b-X-Y-Z-t", STROKE)
    for axes, motions in (((4, 3), (5, 3, 6)), ((3,), (3, 6)), ((4, 2), (4, 3, 6))):
        ((np.zeros((4, 3)), np.zeros((5, 3, 6))),)
        with pytest.raises(ValueError, match="chain: axes_mm"):
            f(m, np.zeros(axes), np.zeros(motions))


def test_presets_are_chains_found_by_name_and_say_what_carries_what():
    assert {"MB1", "MB2", "FB1", "FB2", "MH1", "MH2", "FH1", "FH2", "CX", "CY", "T-10", "FXYZ"} <= set(PRESETS)
    for name, found in PRESETS.items():
        split_chain(found.chain)
        assert preset(name) is preset(name.swapcase()) is found
        assert found.name == name
        assert len(found.text) > 40
    # math.md 2 and 4.1, written in our form by hand
    assert [preset(n).chain for n in ("MB1", "MH1", "FB1", "CX", "T-10", "FXYZ")] == [
        "w-b-Y-X-Z-t", "w-b-Y-Z-X-t", "w-Y-b-X-Z-t", "w-Y-X-b-Z-t", "w-Z-b-X-Y-t", "w-b-X-Y-Z-t",
    ]  # fmt: skip
    with pytest.raises(ValueError, match="expected one of MB1"):
        preset("MB3")


def test_turns_about_x_then_y_then_z_are_those_of_a_text_book_and_quarter_turns_are_exact():
    for turns in np.random.default_rng(1).uniform(-360.0, 360.0, (20, 3)):
        assert matrix_zyx(turns) == pytest.approx(Rotation.from_euler("xyz", turns, degrees=True).as_matrix(), abs=1e-12)
    assert matrix_zyx((0.0, 0.0, 90.0)).tolist() == [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
