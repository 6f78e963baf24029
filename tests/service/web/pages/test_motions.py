"""The screen of the error motions: which runs tell one, against readings that are predicted, and what it says of one that is hidden."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

from abbe.models.geometry.bases import term_values
from abbe.models.solvers.observability.rank import run_sensitivity
from abbe.models.solvers.observe import predict, run_design, setup_unknowns
from abbe.models.solvers.priors import Priors
from abbe.service.runs.observations import run_data
from tests.pages_world import Served, as_user, solved_campaign
from tests.run_documents import runs_of


@pytest.fixture(scope="module")
def known(tmp_path_factory: pytest.TempPathFactory) -> Any:
    site, runs, solved, _ = solved_campaign(tmp_path_factory, "m")
    data = {run.run_id: run_data(run) for run in runs_of(runs)}
    return site.machine, solved.joint.terms, tuple(data[label] for label in ("lineX0", "lineY0", "helix0t0"))


def test_the_readings_change_as_much_as_is_said(known: Any) -> None:
    """By predicted readings of small motions, one shape of unit rms after the other, with the best set-up taken out of each."""
    machine, terms, runs = known
    names, told = run_sensitivity(machine, terms, runs)
    setup, size = setup_unknowns(runs, Priors(), machine), 1e-5
    nodes = np.stack([np.linspace(lo, hi, 41) for lo, hi in machine.stroke_mm], axis=1)
    for name in ("EYY", "ECZ"):
        at = [j for j, t in enumerate(terms) if t.motion == name]
        basis = term_values(terms, nodes, machine.stroke_mm)[:, at]
        shapes = np.linalg.inv(np.linalg.cholesky(basis.T @ basis / len(basis)))
        for i, run in enumerate(runs):
            own = run_design(machine, terms, run, setup)[:, len(terms) + 3 :]
            own = own[:, np.linalg.norm(own, axis=0) > 0]
            own /= np.linalg.norm(own, axis=0)
            still, power = predict(machine, terms, run, setup, np.zeros(len(terms) + 3 + len(setup.names))), []
            for shape in shapes:
                theta = np.zeros(len(terms) + 3 + len(setup.names))
                theta[at] = size * shape
                change = predict(machine, terms, run, setup, theta) - still
                power.append(np.mean((change - own @ np.linalg.lstsq(own, change, rcond=None)[0]) ** 2))
            assert told[i, names.index(name)] == pytest.approx(np.sqrt(np.mean(power)) / size, rel=1e-3, abs=1e-6)
    yy = told[:, names.index("EYY")]
    assert yy[0] == pytest.approx(0.0, abs=1e-9), "a laser along X does not see the scale of Y"
    assert yy[1] > yy[2] > 0.1


def test_a_motion_says_which_runs_tell_it_and_what_a_table_would_leave(running: Served) -> None:
    number = running.filled.solution
    with as_user(running, "vera") as client:
        page = client.get(f"/motions?id={number}&motion=EYY").text
        hidden = client.get(f"/motions?id={number}&motion=EXX&lang=ja").text
        everything = client.get("/motions").text
    assert len(re.findall(r'class="motion[" ]', everything)) == 21
    assert everything.count('class="leads"') == 18
    assert re.findall(r'href="/run\?id=\d+">([^<]*)</a></th>', page)[0] == "lineY0"
    shares = [int(n) for n in re.findall(r"</meter> (\d+) %", page)]
    assert sum(shares) == pytest.approx(100, abs=3)
    assert shares == sorted(shares, reverse=True)
    assert re.search(r"for this motion[^<]*</dt><dd class=\"big\">± [\d.]+ µm", page)
    assert "専用の補正表は作れない" in hidden
    assert "/whatif?id" not in hidden.partition("h-all")[0]
