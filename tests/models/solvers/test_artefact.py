"""Points of an artefact as readings of the joint solution."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from abbe.models.geometry.bases import smooth_terms
from abbe.models.machine import Machine
from abbe.models.solvers.artefact import ArtefactPoints
from abbe.models.solvers.artefact_faults import relabelled, turned_run
from abbe.models.solvers.observations import RunData
from abbe.models.solvers.observe import predict, run_jacobian, setup_unknowns
from abbe.models.solvers.priors import Priors

MACHINE = Machine("w-X-Y-b-Z-t", np.array([[0.0, 800.0], [0.0, 500.0], [0.0, 450.0]]), tool_mm=np.array([1.0, -2.0, -60.0]))
TURNED = np.array([[0.0, -1.0, 0.0], [0.8, 0.0, -0.6], [0.6, 0.0, 0.8]])
TERMS = smooth_terms(3)
PLACES = {"A": [0.0, 0.0, 0.0], "B": [60.0, 0.0, 0.0], "C": [60.0, 60.0, 10.0], "D": [0.0, 60.0, 0.0]}


def points(source: str, *, wall: bool = False) -> RunData:
    """Every feature in all three directions, in a turned pose."""
    feature = tuple(f for f in PLACES for _ in range(3))
    nominal = np.array([PLACES[f] for f in feature])
    n = len(feature)
    far = tuple(f for f in "BCDA" for _ in range(3))
    lengths: dict[str, Any] = {"far": far, "far_mm": np.array([PLACES[f] for f in far]), "u_mm": np.full(n, 1e-3)}
    p = ArtefactPoints(
        "P", source, TURNED, feature, np.tile(np.arange(3), 4), nominal, np.tile([0.0, float(wall), 0.0], (n, 1)), np.full(n, 1.7), 2e-5,
        1e-6, np.where(np.arange(n) < 6, 0.0, 45.0), 50.0, np.array([30.0, 30.0, 0.0]), calibrated=False, u_cmm_scale=2e-6,
        **(lengths if source == "length" else {}),
    )  # type: ignore[arg-type] # fmt: skip
    at = np.array([300.0, 150.0, 100.0]) + nominal @ TURNED.T
    sign = np.sign(np.sin(np.arange(n * 3)).reshape(n, 3))
    return RunData("r1", "s1", "artefact", at, np.zeros(n), sign, 10.0 * np.repeat(np.arange(4), 3), np.ones(n), points=p)


@pytest.mark.parametrize(("source", "wall"), [("probe", False), ("probe", True), ("cmm", False), ("cmm", True), ("length", False)])
def test_the_derivative_is_that_of_the_exact_reading(source: str, wall: bool) -> None:
    """With errors of typical size in machine, pose, form, scale, lobing, radius and temperature, against differences."""
    run = points(source, wall=wall)
    setup = setup_unknowns((run,), Priors(), MACHINE)
    size = np.concatenate([[1e-5 if t.component >= 3 else 5e-3 for t in TERMS], np.full(3, 5e-3), setup.prior_sd])
    theta = size * np.random.default_rng(3).standard_normal(size.size)
    found = run_jacobian(MACHINE, TERMS, run, setup, theta)
    for i, step in enumerate(0.01 * size):
        move = step * (np.arange(size.size) == i)
        ahead, back = (predict(MACHINE, TERMS, run, setup, theta + way * move) for way in (1.0, -1.0))
        assert found[:, i] * step == pytest.approx((ahead - back) / 2.0, abs=1e-10)


def test_a_probed_point_reads_against_the_machine_and_a_made_one_with_it() -> None:
    """A machine that is 10 um too far in X reads an artefact 10 um too near, and makes a workpiece 10 um too far."""
    moved = {}
    for source in ("probe", "cmm"):
        run = points(source)
        setup = setup_unknowns((run,), Priors(), MACHINE)
        theta = np.zeros(len(TERMS) + 3 + len(setup.names))
        theta[next(i for i, t in enumerate(TERMS) if t.motion == "EXX" and t.order == 2)] = 0.01
        moved[source] = predict(MACHINE, TERMS, run, setup, theta) - predict(MACHINE, TERMS, run, setup, 0.0 * theta)
    assert moved["probe"] == pytest.approx(-moved["cmm"], rel=1e-3, abs=1e-9)
    assert np.abs(moved["cmm"]).max() > 1e-3


def test_points_at_the_place_of_another_feature_get_its_name() -> None:
    """A and B carry each other's label: they were found 60 mm from their nominal places."""
    run = points("probe")
    assert run.points is not None
    at = {f: np.array(n) for f, n in PLACES.items()}
    swapped = tuple({"A": "B", "B": "A"}.get(f, f) for f in run.points.feature)
    nominal = np.array([at[f] for f in swapped])
    found = (run.points.nominal_mm - nominal)[np.arange(12), run.points.component] + 0.02
    wrong = replace(run, deviation_mm=found, points=replace(run.points, feature=swapped, nominal_mm=nominal))
    (mended,), faults = relabelled((wrong,))
    assert mended.points is not None
    assert mended.points.feature == run.points.feature
    assert mended.deviation_mm == pytest.approx(0.02)
    assert [f.what for f in faults] == ["the labels of features A and B are exchanged"]


def test_a_quarter_turn_keeps_what_was_read_and_tells_it_of_another_feature() -> None:
    """The machine read the same shift in its own axes; the artefact's axes and features turn under it."""
    run = points("probe")
    assert run.points is not None
    flat = {"A": [0.0, 0.0, 0.0], "B": [60.0, 0.0, 0.0], "C": [60.0, 60.0, 0.0], "D": [0.0, 60.0, 0.0]}
    p = replace(run.points, nominal_mm=np.array([flat[f] for f in run.points.feature]))
    plain = replace(run, points=p, deviation_mm=np.arange(12.0))
    turned = turned_run(plain, 1)
    assert turned is not None
    assert turned.points is not None
    assert turned.points.feature[:3] != p.feature[:3]
    before = plain.deviation_mm[:, None] * p.matrix.T[p.component]
    after = turned.deviation_mm[:, None] * turned.points.matrix.T[turned.points.component]
    assert after == pytest.approx(before)
    back = turned_run(turned, 3)
    assert back is not None
    assert back.points is not None
    assert back.points.feature == p.feature
    assert back.deviation_mm == pytest.approx(plain.deviation_mm)
