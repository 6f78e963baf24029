"""What the report claims, judged by a simulated machine that knows nothing of the solver (finite rotations, readings recomputed).

One machine per kind of campaign; two with ``ABBE_TEST_LONG=1``.
"""

import os

import numpy as np
import pytest

from abbe.models.solvers.assessment import observability
from tests.experiments.campaigns.population import CAMPAIGNS, draw_case
from tests.experiments.campaigns.traces import traces

SECOND_ORDER = 1e-3
"""Errors of 1e-4 rad act on each other: a hidden combination of a finite machine leaves less than this of what its parts would show."""


@pytest.mark.parametrize("kind", CAMPAIGNS)
@pytest.mark.parametrize("seed", [1, 3] if os.environ.get("ABBE_TEST_LONG") == "1" else [1])
def test_hidden_combinations_leave_no_trace_and_observed_parameters_leave_one(kind, seed):
    case = draw_case(seed, kind)
    report = observability(case.machine, tuple(case.runs), terms=4)
    names = tuple(t.name for t in report.terms) + tuple(f"backlash_{a}" for a in "XYZ")
    seen = traces(case, names)
    assert report.hidden or kind != "laser_only"
    n = len(report.terms)
    for group in report.hidden:
        told = np.array([dict(group.weights).get(name, 0.0) for name in names[:n]])
        for v in (told, *group.vectors.T):
            in_sizes = v / seen.typical[:n]
            shown = np.linalg.norm(np.linalg.norm(seen.raw[:, :n], axis=0) * in_sizes)
            assert np.linalg.norm(seen.seen[:, :n] @ in_sizes) < SECOND_ORDER * shown, group.text
    share = dict(zip(seen.names, seen.share(), strict=True))
    status = {p.name: p.status for p in report.parameters}
    observed = [n for n in names if status[n] == "observed"]
    assert len(observed) > 10
    assert min(share[n] for n in observed) > 0.5


def test_a_picture_plane_is_the_volume_at_its_points():
    case = draw_case(2, "joint")
    report = observability(case.machine, tuple(case.runs), terms=2)
    plane = report.plane(1, 7)
    assert (plane.first, plane.second, plane.fixed) == (0, 2, 1)
    k = 3 * 7 + 5
    point = plane.volume.axes_mm[k]
    assert point == pytest.approx([plane.first_mm[5], case.machine.centre_mm[1], plane.second_mm[3]])
    again = report.at(point[None])
    assert again.u_mm[0] == pytest.approx(plane.volume.u_mm[k])
    assert again.gain[0] == pytest.approx(plane.volume.gain[k])
    assert np.isfinite(plane.volume.u_mm).all()
