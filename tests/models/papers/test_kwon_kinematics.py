"""Kinematics of the 3-PUU machine against the paper's own constraint, finite differences and its singular poses."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from abbe.models.papers.kwon.errors import (
    CollinearSphereCentres,
    LinksHorizontal,
    NoForwardSolution,
    ParallelSingularity,
    PlatformBelow,
    PoseError,
    SerialSingularity,
    UnreachableLeg,
)
from abbe.models.papers.kwon.kinematics import (
    PER_LEG,
    Geometry,
    forward,
    forward_as_printed,
    inverse,
    inverse_jacobian,
    jacobian,
    link_determinant,
    links,
    parameter_design,
    parameter_jacobian,
    parameter_names,
    square_commands,
)

NOMINAL = Geometry(100.0, 30.0, 101.26, 8.0, 8.0, np.radians(35.0), 20.0)  # type: ignore[arg-type]


def crooked(seed: int = 1) -> Geometry:
    rng = np.random.default_rng(seed)
    size = {"thb": 2e-3, "thp": 2e-3}
    return NOMINAL.with_errors({name: size.get(name, 0.2) * rng.standard_normal(3) for name in PER_LEG})


def commands(n: int = 20, seed: int = 2) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-10.0, 10.0, (n, 3))


def joints(g: Geometry, lam: np.ndarray, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(2) and (3) written out for one pose: rows are legs."""
    s1, s2 = np.empty((3, 3)), np.empty((3, 3))
    for i in range(3):
        base = g.R_mm[i] - lam[i] - g.l_dw_mm * np.cos(g.theta_rad)
        top = g.r_mm[i] + g.l_up_mm * np.cos(g.theta_rad)
        s1[i] = base * np.cos(g.theta_b_rad[i]), base * np.sin(g.theta_b_rad[i]), g.l_dw_mm * np.sin(g.theta_rad) + g.dz_mm[i]
        s2[i] = p + np.array([top * np.cos(g.theta_p_rad[i]), top * np.sin(g.theta_p_rad[i]), -g.le_mm - g.l_up_mm * np.sin(g.theta_rad)])
    return s1, s2


@pytest.mark.parametrize("g", [NOMINAL, crooked(1), crooked(2)])
def test_forward_solution_keeps_the_link_lengths(g: Geometry) -> None:
    lam = commands()
    for row, p in zip(lam, forward(g, lam), strict=True):
        s1, s2 = joints(g, row, p)
        np.testing.assert_allclose(np.linalg.norm(s2 - s1, axis=1), g.l_mm, rtol=0, atol=1e-12)
        assert p[2] > s1[:, 2].max()


def test_forward_solution_is_equation_4_with_the_half() -> None:
    lam = commands()
    r_hat = 30 + 8 * np.cos(np.radians(35))
    lam_hat = 100 - lam - 8 * np.cos(np.radians(35))
    angle = 2 * np.pi / 3 * np.arange(3)
    a, b = r_hat * np.cos(angle) - lam_hat * np.cos(angle), r_hat * np.sin(angle) - lam_hat * np.sin(angle)
    for k, p in enumerate(forward(NOMINAL, lam)):
        (a1, a2, a3), (b1, b2, b3) = a[k], b[k]
        rhs = np.array([a2**2 + b2**2 - a1**2 - b1**2, a3**2 + b3**2 - a1**2 - b1**2])
        matrix = np.array([[a1 - a2, b1 - b2], [a1 - a3, b1 - b3]])
        x, y = np.linalg.solve(matrix, rhs / 2)
        z = np.sqrt(101.26**2 - (x + a1) ** 2 - (y + b1) ** 2) + 16 * np.sin(np.radians(35)) + 20
        np.testing.assert_allclose(p, [x, y, z], rtol=0, atol=1e-12)
        np.testing.assert_allclose(forward_as_printed(NOMINAL, lam[k : k + 1])[0, :2], np.linalg.solve(matrix, rhs), rtol=0, atol=1e-12)


def test_figures_of_the_specification() -> None:
    p = forward(NOMINAL, np.array([[1.0, 1.0, 1.0], [0.4, 1.1, 1.7]]))
    np.testing.assert_allclose(p[0], [0, 0, 113.61357], rtol=0, atol=5e-6)
    np.testing.assert_allclose(p[1, :2], [0.66522879, 0.34848646], rtol=0, atol=5e-9)
    assert p[1, 2] == pytest.approx(113.655994154, abs=1e-8)  # math.md slips by 8.4e-9 mm; the vector below has every digit
    wrong = forward_as_printed(NOMINAL, np.array([[0.4, 1.1, 1.7]]))
    np.testing.assert_allclose(wrong[0], [1.330, 0.697, 114.090], rtol=0, atol=5e-4)
    lengths = np.linalg.norm(links(NOMINAL, np.array([[0.4, 1.1, 1.7]]), wrong)[0], axis=1)
    np.testing.assert_allclose(lengths, [101.26, 101.65, 101.97], rtol=0, atol=5e-3)
    np.testing.assert_allclose(square_commands(NOMINAL, 1.0, p[0, 2]), [-0.37, 2.37], rtol=0, atol=6e-3)


def test_the_example_has_the_digits_of_the_vector(shared: Path) -> None:
    example = json.loads((shared / "vectors" / "kwon_kinematics.json").read_text())["example"]
    assert example["lambda"] == [0.4, 1.1, 1.7]
    np.testing.assert_allclose(forward(NOMINAL, np.array([example["lambda"]]))[0], example["P"], rtol=0, atol=2e-13)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.floats(-15.0, 15.0), min_size=3, max_size=3), st.integers(0, 5))
def test_inverse_undoes_forward(lam: list[float], seed: int) -> None:
    for g in (NOMINAL, crooked(seed)):
        p = forward(g, np.array([lam]))
        np.testing.assert_allclose(inverse(g, p)[0], lam, rtol=0, atol=1e-11)


def test_folded_branch_is_another_assembly_of_the_same_links() -> None:
    g = crooked()
    p = forward(g, commands())
    folded = inverse(g, p, "folded")
    assert (np.abs(folded - inverse(g, p)) > 50.0).all()
    np.testing.assert_allclose(np.linalg.norm(links(g, folded, p), axis=2), np.broadcast_to(g.l_mm, folded.shape), rtol=0, atol=1e-11)


def test_base_joints_inside_need_the_folded_branch() -> None:
    lam = np.array([[120.0, 121.0, 122.0]])  # lambda_hat below r_hat
    p = forward(NOMINAL, lam)
    np.testing.assert_allclose(inverse(NOMINAL, p, "folded"), lam, rtol=0, atol=1e-11)
    assert (inverse(NOMINAL, p) < lam - 50.0).all()


@pytest.mark.parametrize("g", [NOMINAL, crooked()])
def test_jacobian_against_differences(g: Geometry) -> None:
    lam, h = commands(), 1e-4
    j = jacobian(g, lam)
    for leg in range(3):
        step = h * np.eye(3)[leg]
        np.testing.assert_allclose(j[:, :, leg], (forward(g, lam + step) - forward(g, lam - step)) / (2 * h), atol=1e-8)
    np.testing.assert_allclose(inverse_jacobian(g, lam) @ j, np.broadcast_to(np.eye(3), j.shape), atol=1e-12)


@pytest.mark.parametrize("g", [NOMINAL, crooked()])
@pytest.mark.parametrize("name", PER_LEG)
def test_sensitivity_against_differences(g: Geometry, name: str) -> None:
    lam, h = commands(), 1e-4 if not name.startswith("th") else 1e-6
    exact = parameter_jacobian(g, lam)[name]
    for leg in range(3):
        step = {name: h * np.eye(3)[leg]}
        back = {name: -h * np.eye(3)[leg]}
        slope = (forward(g.with_errors(step), lam) - forward(g.with_errors(back), lam)) / (2 * h)
        np.testing.assert_allclose(exact[:, :, leg], slope, atol=1e-6)


def test_names_go_with_columns() -> None:
    lam = commands(3)
    design = parameter_design(NOMINAL, lam)
    assert parameter_names()[9:12] == ("thb1", "thb2", "thb3")
    np.testing.assert_array_equal(design[:, :, 9:12], parameter_jacobian(NOMINAL, lam)["thb"])
    np.testing.assert_allclose(design[:, :, :3], -jacobian(NOMINAL, lam), atol=1e-14)  # R acts like a command withdrawn
    np.testing.assert_allclose(design[:, :, :3], -design[:, :, 3:6], atol=1e-12)  # and r against it, for equal angles


def at_lambda_hat(*values: float) -> np.ndarray:
    """Commands for given lambda_hat - r_hat."""
    return (NOMINAL.reach_mm - NOMINAL.r_hat_mm - np.array(values))[None]


def test_unreachable_leg_names_row_and_leg() -> None:
    good = forward(NOMINAL, np.ones((1, 3)))
    with pytest.raises(UnreachableLeg, match=r"pose row 1, leg 1.*pose row 1, leg 2.*C\^2 < D") as caught:
        inverse(NOMINAL, np.concatenate([good, [[0.0, 0.0, 300.0]]]))
    assert caught.value.rows == (1, 1, 1)
    assert caught.value.legs == (1, 2, 3)


def test_one_leg_too_short() -> None:
    g = NOMINAL.with_errors({"l": np.array([0.0, -25.0, 0.0])})
    with pytest.raises(UnreachableLeg) as caught:
        inverse(g, np.array([[0.0, 0.0, 113.6]]))
    assert caught.value.legs == (2,)


def test_link_perpendicular_to_rail_is_a_serial_singularity() -> None:
    top = float(NOMINAL.lift_mm[0] + NOMINAL.l_mm[0])
    with pytest.raises(SerialSingularity, match="perpendicular"):
        inverse(NOMINAL, np.array([[0.0, 0.0, top]]))
    shy = inverse(NOMINAL, np.array([[0.0, 0.0, top - 1e-3]]))  # 1 um below it still works
    assert np.isfinite(shy).all()
    # Leg 1 alone: sideways by y, lower by as much as keeps l^2 = h^2 + y^2.
    y = 20.0
    with pytest.raises(SerialSingularity) as caught:
        inverse(NOMINAL, np.array([[0.0, y, float(NOMINAL.lift_mm[0]) + np.sqrt(NOMINAL.l_mm[0] ** 2 - y**2)]]))
    assert caught.value.legs == (1,)
    lam = at_lambda_hat(0.0, 40.0, 40.0)
    p = np.array([[0.0, 0.0, 113.0]])  # any position: leg 1 runs straight up from its joint
    with pytest.raises(SerialSingularity, match="leg 1"):
        inverse_jacobian(NOMINAL, lam, p)


def test_links_that_do_not_meet() -> None:
    with pytest.raises(NoForwardSolution, match="pose row 1"):
        forward(NOMINAL, np.concatenate([np.ones((1, 3)), at_lambda_hat(120.0, 120.0, 120.0)]))
    with pytest.raises(NoForwardSolution):
        forward_as_printed(NOMINAL, at_lambda_hat(120.0, 120.0, 120.0))


def test_horizontal_links() -> None:
    length = float(NOMINAL.l_mm[0])
    with pytest.raises(LinksHorizontal, match="h = 0"):
        forward(NOMINAL, at_lambda_hat(length, length, length))
    assert forward(NOMINAL, at_lambda_hat(*[length - 1e-3] * 3))[0, 2] > NOMINAL.lift_mm[0]


def test_parallel_singularity_with_legs_that_differ() -> None:
    g = NOMINAL.with_errors({"dz": np.array([0.0, 5.0, -3.0])})
    centre = g.centres_mm(np.ones((1, 3)))[0]
    inside = centre.mean(axis=0)
    lengths = np.linalg.norm(inside - centre, axis=1)
    flat = g.with_errors({"l": lengths - g.l_mm})
    with pytest.raises(ParallelSingularity, match="plane of the sphere centres") as caught:
        forward(flat, np.ones((1, 3)))
    assert not isinstance(caught.value, LinksHorizontal)
    with pytest.raises(ParallelSingularity, match="pose row 0"):
        jacobian(flat, np.ones((1, 3)), inside[None])


@pytest.mark.parametrize("g", [NOMINAL, crooked()])
def test_inverse_refuses_the_assembly_below_the_links(g: Geometry) -> None:
    """What forward would not find again has no command."""
    with pytest.raises(PlatformBelow, match=r"pose row 1: .*below the links"):
        inverse(g, np.array([[0.2, 0.1, 113.0], [0.2, 0.1, -50.0]]))
    with pytest.raises(PlatformBelow):
        inverse(g, np.array([[0.2, 0.1, float(g.lift_mm.min()) - 5.0]]))
    low = np.array([[0.2, 0.1, float(g.lift_mm.max()) + 5.0]])
    np.testing.assert_allclose(forward(g, inverse(g, low)), low, rtol=0, atol=1e-11)


@pytest.mark.parametrize("h", [0.0, 1e-5, -1e-5])
def test_inverse_refuses_horizontal_links(h: float) -> None:
    at = np.array([[0.2, 0.1, float(NOMINAL.lift_mm[0]) + h]])
    with pytest.raises(LinksHorizontal, match=r"pose row 0: .*h = 0"):
        inverse(NOMINAL, at)


def test_crooked_legs_are_judged_by_the_plane_of_their_centres() -> None:
    """With a dz of its own one link may point down while the platform is above the plane of the centres: such a pose has commands."""
    g = NOMINAL.with_errors({"dz": np.array([0.0, 0.0, 60.0])})
    low = float(NOMINAL.lift_mm[0])
    p = np.array([[0.0, 0.0, low + 35.0]])
    lam = inverse(g, p)
    assert links(g, lam, p)[0, 2, 2] < 0.0
    np.testing.assert_allclose(forward(g, lam), p, rtol=0, atol=1e-10)
    with pytest.raises(PlatformBelow):  # above the centres of legs 1 and 2, below the plane of all three
        inverse(g, np.array([[0.0, 0.0, low + 5.0]]))


def test_poses_that_fail_for_other_reasons_are_counted() -> None:
    lift = float(NOMINAL.lift_mm[0])
    poses = np.array([[0.0, 0.0, 300.0], [0.0, 0.0, lift], [0.2, 0.1, -50.0], [0.0, 0.0, 113.0]])
    with pytest.raises(UnreachableLeg, match="and 2 more poses for other reasons") as caught:
        inverse(NOMINAL, poses)
    assert set(caught.value.rows) == {0}
    length = float(NOMINAL.l_mm[0])
    lam = np.concatenate([at_lambda_hat(0.0, 0.0, 0.0), at_lambda_hat(120.0, 120.0, 120.0), at_lambda_hat(length, length, length)])
    with pytest.raises(CollinearSphereCentres, match=r"pose row 0: .*and 2 more poses for other reasons"):
        forward(NOMINAL, lam)
    with pytest.raises(NoForwardSolution, match=r"pose row 0: .*and 1 more pose for"):
        forward(NOMINAL, lam[1:])


@pytest.mark.parametrize("offset", [(0.0, 0.0, 0.0), (2.0, 2.0, -1.0), (4.0, 4.0, -2.0)])
def test_sphere_centres_on_a_line(offset: tuple[float, float, float]) -> None:
    with pytest.raises(CollinearSphereCentres, match="pose row 0"):
        forward(NOMINAL, at_lambda_hat(*offset))
    with pytest.raises(CollinearSphereCentres):
        forward_as_printed(NOMINAL, at_lambda_hat(*offset))


def test_refusals_are_value_errors() -> None:
    assert issubclass(PoseError, ValueError)
    assert issubclass(LinksHorizontal, ParallelSingularity)


def test_determinant_shrinks_towards_horizontal_links() -> None:
    size = []
    for low in (30.0, 3.0, 0.3):
        reach = np.sqrt(NOMINAL.l_mm[0] ** 2 - low**2)
        lam = at_lambda_hat(reach, reach, reach)
        size.append(abs(link_determinant(links(NOMINAL, lam, forward(NOMINAL, lam)))[0]))
    assert size[0] > 5 * size[1] > 25 * size[2] > 0


@pytest.mark.parametrize(
    ("field", "value", "text"),
    [
        ("R_mm", -1.0, "positive"),
        ("r_mm", [1.0, 2.0], "3 legs"),
        ("l_mm", np.nan, "finite"),
        ("le_mm", np.inf, "finite"),
        ("theta_rad", np.ones(3), "theta_rad must be one"),
    ],
)
def test_bad_geometry(field: str, value: object, text: str) -> None:
    good = {"R_mm": 100.0, "r_mm": 30.0, "l_mm": 101.26, "l_up_mm": 8.0, "l_dw_mm": 8.0, "theta_rad": 0.6, "le_mm": 20.0}
    with pytest.raises(ValueError, match=text):
        Geometry(**{**good, field: value})  # type: ignore[arg-type]


def test_bad_poses() -> None:
    with pytest.raises(ValueError, match=r"lambda_mm.*\(n, 3\)"):
        forward(NOMINAL, np.ones(3))
    with pytest.raises(ValueError, match=r"^p_mm: row 1: every number must be finite$"):
        inverse(NOMINAL, np.array([[0.0, 0.0, 113.0], [0.0, np.nan, 1.0]]))
    with pytest.raises(ValueError, match="no branch"):
        inverse(NOMINAL, np.ones((1, 3)), "inside")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="do not fit"):
        links(NOMINAL, np.ones((2, 3)), np.ones((1, 3)))
    with pytest.raises(ValueError, match="'Q'"):
        NOMINAL.with_errors({"Q": np.ones(3)})
