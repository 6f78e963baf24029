"""The ranking of error motions against sums that are made another way: by evaluating the deviation, and by drawing solutions at random."""

from __future__ import annotations

import json

import numpy as np
import pytest

from abbe.models.geometry.chain import design
from abbe.models.geometry.volume import remove_rigid, volume_grid
from abbe.models.machine import Machine
from abbe.service.domain.document import Doc
from abbe.service.domain.machine import machine_from_doc
from abbe.service.domain.solution_file import MotionValue, SolutionFile, StoredPrediction
from abbe.service.web.pages.results import NODES, Ranked, ranking
from tests.pages_world import solved_campaign

POINTS_ALONE = ("EYY", "ECZ", "EXX", "C0Y")


def found_in(doc: Doc) -> tuple[StoredPrediction, dict[str, MotionValue]]:
    """Prediction and motions of a solution's document."""
    solution = SolutionFile.read(doc)
    assert solution.prediction is not None
    return solution.prediction, solution.motions


@pytest.fixture(scope="module")
def known(tmp_path_factory: pytest.TempPathFactory) -> tuple[Machine, dict[str, object], list[Ranked]]:
    site, _, _, doc = solved_campaign(tmp_path_factory, "m")
    machine = machine_from_doc(json.loads(json.dumps(site.doc)))
    return machine, doc, ranking(*found_in(doc), machine)


def test_the_contribution_is_the_rms_of_the_deviation_without_rigid_motion(known) -> None:
    machine, doc, ranked = known
    terms, coefficients, _ = StoredPrediction.read(doc["prediction"]).unpacked()
    points = volume_grid(machine.stroke_mm, NODES)
    reference = volume_grid(machine.stroke_mm, NODES)  # the frame of the product is fitted to another, coarser grid
    found = {r.name: r.value_um for r in ranked}
    for name in POINTS_ALONE:
        alone = np.where([t.motion == name for t in terms], coefficients, 0.0)
        left = remove_rigid(reference, design(machine, terms, points) @ alone)
        rms_um = 1e3 * float(np.sqrt(np.mean(np.sum(left**2, axis=1))))
        assert found[name] == pytest.approx(rms_um, rel=0.02), name


def test_the_uncertainty_is_the_scatter_of_solutions_drawn_at_random(known) -> None:
    machine, doc, ranked = known
    terms, coefficients, covariance = StoredPrediction.read(doc["prediction"]).unpacked()
    points = volume_grid(machine.stroke_mm, NODES)
    full = design(machine, terms, points)
    rng = np.random.default_rng(11)
    asserted = 0
    clearest = sorted((r for r in ranked if r.value_um > 4.0 * r.u_um), key=lambda r: r.u_um / r.value_um)  # U is of first order in u
    for row in clearest[:4]:
        at = [k for k, t in enumerate(terms) if t.motion == row.name]
        drawn = rng.multivariate_normal(coefficients[at], covariance[np.ix_(at, at)], size=300, method="eigh")
        sizes = [np.sqrt(np.mean(np.sum(remove_rigid(points, full[:, :, at] @ c) ** 2, axis=1))) for c in drawn]
        assert 1e3 * float(np.std(sizes)) == pytest.approx(row.u_um, rel=0.3), row.name
        asserted += 1
    assert asserted == 4


def test_all_21_motions_largest_first_and_never_known_better_than_nothing(known) -> None:
    _, doc, ranked = known
    assert {r.name for r in ranked} == set(doc["motions"])
    assert len(ranked) == 21
    assert [r.value_um for r in ranked] == sorted((r.value_um for r in ranked), reverse=True)
    assert all(r.u_um > 0.0 for r in ranked)
    assert {r.name for r in ranked if r.hidden} == {n for n, m in doc["motions"].items() if m["status"] == "not observable"}


def test_a_motion_that_is_not_there_still_has_an_uncertainty(known) -> None:
    machine, doc, _ = known
    prediction = dict(doc["prediction"], coefficients=[0.0] * len(doc["prediction"]["coefficients"]))
    zero = ranking(*found_in(doc | {"prediction": prediction}), machine)
    assert all(r.value_um == 0.0 and r.u_um > 0.0 for r in zero)
