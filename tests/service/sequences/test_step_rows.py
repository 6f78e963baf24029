"""Step diagonals are told from whole ways out only; overruns are not part of a step."""

import numpy as np
import pytest

from abbe.models.machine import Machine
from abbe.models.paths import DIAGONALS
from abbe.service.campaign_data.run_geometry import geometry_mistake
from abbe.service.identification.solve import step_diagonals
from abbe.service.sequences.recipes.recipe import Diagonal
from abbe.service.sequences.steps import MoveTo, ReadLaser
from tests.run_documents import run_of, runs_of

MACHINE = Machine("w-X-Y-b-Z-t", np.array([[0.0, 600.0], [0.0, 500.0], [0.0, 450.0]]))


def run(recipe):
    """A run of a plan, on a machine whose X scale and XY squareness are off."""
    plan, here, points = recipe.plan(MACHINE), None, []
    for step in plan.steps:
        if isinstance(step, MoveTo):
            here = step.target_mm
        elif isinstance(step, ReadLaser):
            points.append(here)
    at = np.array(points)
    off = np.stack([2e-5 * at[:, 0] - 2e-5 * at[:, 1], 1e-5 * at[:, 1], 0.0 * at[:, 0]], axis=1) @ plan.setup.nominal_beam
    columns = {"deviation_mm": (off - off[0]).tolist(), **{f"{a}_mm": at[:, i].tolist() for i, a in enumerate("xyz")}}
    columns["valid"] = [1] * len(at)
    return {"run_id": plan.label, "test": "laser_diagonal", "setup": plan.setup.document, "columns": columns}


@pytest.mark.parametrize("how", ["row missing", "row invalid", "row elsewhere"])
def test_a_row_less_shifts_no_figures_but_takes_them_away(how):
    runs = [run(Diagonal(k, k, "identify", k, 6, "XYZ")) for k in DIAGONALS]
    assert step_diagonals(runs_of(runs))["XYZ"]["EXX_end_um"] == pytest.approx(0.02 * 580.0, rel=0.2)
    columns = runs[1]["columns"]
    if how == "row missing":
        runs[1]["columns"] = {k: v[:3] + v[4:] for k, v in columns.items()}
    elif how == "row invalid":
        columns["valid"][3] = 0
    else:
        columns["x_mm"][3] += 5.0
    assert step_diagonals(runs_of(runs)) == {}


def test_an_increment_is_that_of_the_targets_where_the_machine_overruns_them():
    plain, over = (run(Diagonal("d", "S", "identify", "npp", 8, "", overrun_mm=mm)) for mm in (0.0, 8.0))
    assert over["setup"]["increment_mm"] == pytest.approx(plain["setup"]["increment_mm"])
    assert geometry_mistake({}, run_of(over)) is None
