"""The stored solution of a campaign: every figure with its uncertainty, and in words what it is about."""

import json

import numpy as np
import pytest

from abbe.models.paths import DIAGONALS
from abbe.models.solvers.observations import RunData
from abbe.service.cli.results.solve_text import print_solution, summary_lines
from abbe.service.devices.session import DeviceUrls
from abbe.service.domain.machine import machine_doc
from abbe.service.domain.solution_file import SolutionFile
from abbe.service.errors import InstrumentsDisagree
from abbe.service.identification.solve import Solved, solve_runs
from abbe.service.identification.solve_report import assess, solution_doc
from abbe.service.report.solution_sections import parameter_rows
from abbe.service.site import Site
from tests.models.solvers.truth import MACHINE, Truth
from tests.run_documents import runs_of

SITE = Site("sim", MACHINE, machine_doc("sim", MACHINE), DeviceUrls())


def stored(run: RunData, **more) -> dict:
    """The run as `abbe-run/1` has it."""
    setup = {"setup_id": run.setup}
    test = "ballbar_helix"
    if run.centre_mm is not None:
        setup |= {"centre_mm": run.centre_mm.tolist(), "radius_mm": run.radius_mm, "u_length_mm": 2e-3, "length_calibrated": True}
    else:
        test = "laser_diagonal" if run.label[1:4] in DIAGONALS else "laser_linear"
        setup |= {"nominal_beam": run.beam.tolist()}
        if test == "laser_diagonal":
            turn = len(run.axes_mm) // 2 - 1
            setup |= {"diagonal": run.label[1:4], "order": run.label[4:], "steps": 12}
            setup["increment_mm"] = ((run.axes_mm[turn] - run.axes_mm[0]) / 12).tolist()
    columns = {f"{c}_mm": run.axes_mm[:, k].tolist() for k, c in enumerate("xyz")}
    columns |= {"t_s": run.t_s.tolist(), "deviation_mm": run.deviation_mm.tolist()}
    return {"run_id": run.label, "test": test, "role": "identify", "setup": setup | more, "columns": columns}


def raw_campaign(truth: Truth) -> list[dict]:
    lasers = [stored(r) for r in truth.campaign() if r.kind == "laser"]
    return [stored(truth.bar(f"h{k}", np.array(c, float), 165.0)) for k, c in enumerate([(192, 180, 90), (408, 320, 90)])] + lasers


@pytest.fixture(scope="module")
def solved() -> Solved:
    return solve_runs(SITE, runs_of(raw_campaign(Truth(3))))


def test_every_step_diagonal_figure_has_its_uncertainty_and_says_what_is_not_in_it(solved):
    doc = solution_doc(solved)
    assert set(doc["step_diagonals"]) == {"XYZ", "ZYX"}
    for figures in doc["step_diagonals"].values():
        named = [k for k in figures if not k.startswith("u_")]
        assert len(named) == 9 + 1 + 3
        assert all(figures[f"u_{k}"] > 0 for k in named)
        # R / (2 X) sqrt(2 n) sigma with sigma 0.3 um: 580 x 480 x 430 mm in 12 steps
        assert figures["u_EYX_end_um"] == pytest.approx(np.linalg.norm([580, 480, 430]) / (2 * 480) * np.sqrt(24) * 0.3, rel=1e-3)
    assert "mirror tilt" in doc["step_diagonals_note"]
    assert "joint solution" in doc["step_diagonals_note"]
    assert "sphere of their run only" in doc["ten_parameter_helix_note"]
    assert "temperature" in doc["mean_over_volume_note"]
    json.dumps(doc, allow_nan=False)


def test_words_on_the_screen_say_the_same(solved, capsys):
    told = assess(solved)
    solution = SolutionFile.read({"campaign": "c1"} | solution_doc(told))
    assert 5 <= len(summary_lines(told, solution)) <= 10
    print_solution(told, solution, details=True)
    text = " ".join(capsys.readouterr().out.split())
    for words in (
        "on the sphere of their run only",
        "mirror tilt",
        "temperature",
        "step diagonals XYZ",
        "Step diagonals in another step order",
    ):
        assert words in text
    assert "1 combinations" not in text
    assert any("temperature" in row.note for row in parameter_rows(solved.joint))


def test_a_bar_in_other_millimetres_is_refused_only_if_it_claims_to_be_calibrated():
    truth = Truth(3)
    runs = raw_campaign(truth)
    for run in runs:
        if run["test"] == "ballbar_helix":
            run["columns"]["deviation_mm"] = [v + 0.05 for v in run["columns"]["deviation_mm"]]
    with pytest.raises(InstrumentsDisagree, match="bar length 165"):
        solve_runs(SITE, runs_of(runs))
    for run in runs:
        if run["test"] == "ballbar_helix":
            run["setup"] |= {"length_calibrated": False}
    length = solve_runs(SITE, runs_of(runs)).joint.estimate
    assert length.value("bar_length_165") == pytest.approx(0.0515, abs=3 * length.u("bar_length_165"))
    assert length.u("bar_length_165") < 2e-3
