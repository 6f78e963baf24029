"""One helix, one picture: the axis is the set-up's, else the path's own, for reports, comparisons and the live picture alike."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from abbe.models.paths import even_helix_points, helix_points
from abbe.service.campaign_data.campaign_folder import Campaign
from abbe.service.capture.live import angles_along
from abbe.service.domain.machine import Rules
from abbe.service.domain.run import Run, parsed_setup
from abbe.service.errors import MeasurementFault
from abbe.service.rendering.document import Document
from abbe.service.rendering.model import PolarTrace
from abbe.service.report import report_measured
from abbe.service.report.report_measured import Measured, run_report
from abbe.service.runs.coverage import helix_axis
from abbe.service.runs.observations import run_data
from abbe.service.verification.compare_runs import LoadedRun, curve, incomparable_reason
from tests.run_documents import run_of
from tests.scenarios.campaign_files import measured

CENTRE = np.array([300.0, 250.0, 200.0])
RADIUS = 150.0


def helix_about(letter: str, label: str = "h", **setup: Any) -> dict[str, Any]:
    """A helix about an axis, with a deviation of three waves a turn about that axis; the set-up states what is given."""
    k = "XYZ".index(letter)
    at = even_helix_points(CENTRE, RADIUS, turns=5.0, n=500, axis=k)
    angle = np.arctan2(*(at - CENTRE)[:, [(k + 2) % 3, (k + 1) % 3]].T)
    deviation = 2e-3 * np.cos(3 * angle) + np.random.default_rng(7).normal(0.0, 1e-4, len(at))
    site, runs = measured(3)
    known = {"setup_id": "B1", "t_set_s": 0.0, "centre_mm": CENTRE.tolist(), "radius_mm": RADIUS, "turns": 5.0, "length_calibrated": False}
    columns = {f"{c}_mm": at[:, n].tolist() for n, c in enumerate("xyz")} | {"t_s": np.arange(500.0).tolist()}
    columns |= {"deviation_mm": deviation.tolist(), "feed_mm_min": [1000.0] * 500, "direction": [1] * 500}
    return runs[0] | {"run_id": label, "test": "ballbar_helix", "setup": known | setup, "columns": columns, "machine": site.doc}


def drawn(run: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> tuple[Document, list[PolarTrace]]:
    """The report of a run, and what it drew around."""
    seen: list[PolarTrace] = []
    real = report_measured.polar_plot

    def noted(traces: list[PolarTrace], **more: Any) -> str:
        seen.extend(traces)
        return str(real(traces, **more))

    monkeypatch.setattr(report_measured, "polar_plot", noted)
    site, _ = measured(3)
    return run_report(Measured(Campaign("june", site, [run_of(run)], None, {})), run["run_id"], Rules()), seen


def compared(run: dict[str, Any] | Run) -> LoadedRun:
    one = run if isinstance(run, Run) else run_of(run)
    return LoadedRun(f"june/{one.run_id}", "mill-7", one, run_data(one), ())


@pytest.mark.parametrize("axis", ["X", "Y", "Z"])
def test_a_helix_without_a_stated_axis_is_the_same_picture_everywhere(axis: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A helix about X without a stated axis was a butterfly in the report and a closed curve in the comparison."""
    run = helix_about(axis)
    document, (trace,) = drawn(run, monkeypatch)
    other = curve(compared(run))
    assert np.array_equal(np.asarray(trace.angle_deg), other.x)
    assert np.array_equal(np.asarray(trace.deviation_um), other.deviation_um)
    points = np.column_stack([run["columns"][f"{c}_mm"] for c in "xyz"])
    live, _ = angles_along(points.tolist(), parsed_setup("ballbar_helix", run["setup"]))
    assert abs(live[-1] - live[0]) == pytest.approx(5 * 360.0, abs=100.0)  # at the pole there is no angle
    turns = np.abs(np.diff(np.unwrap(np.radians(other.x)))).sum() / (2 * np.pi)
    assert turns == pytest.approx(5.0, abs=0.3)
    assert any(f"around its axis ({axis})" in picture.caption for picture in document.pictures)
    stated, (again,) = drawn(helix_about(axis, axis=axis), monkeypatch)
    assert np.array_equal(again.angle_deg, trace.angle_deg)
    assert [f.value for f in stated.figures] == [f.value for f in document.figures]


def test_what_neither_set_up_nor_path_tells_is_not_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """A quarter of a turn advances along several axes: how much of the path it is cannot be told, and nothing is judged or drawn."""
    run = helix_about("X")
    run["columns"] = {name: values[:25] for name, values in run["columns"].items()}
    document, traces = drawn(run, monkeypatch)
    assert traces == []
    assert document.verdict[2] == "incomplete: its share of the path is unknown; not judged."
    with pytest.raises(MeasurementFault, match="states no axis of the helix"):
        curve(compared(run))


def test_a_stated_and_an_inferred_axis_are_one_axis() -> None:
    first, second = compared(helix_about("X", "a", axis="X")), compared(helix_about("X", "b"))
    assert incomparable_reason(first, second) == ""
    assert "axis of june/b is Y" in incomparable_reason(first, compared(helix_about("Y", "b")))


@pytest.mark.parametrize("law", ["angle", "area"])
@pytest.mark.parametrize("turns", [1.0, 3.0, 7.0])
@pytest.mark.parametrize("forth", [1, -1])
def test_the_axis_is_found_of_every_law_and_either_way(law: Any, turns: float, forth: int) -> None:
    for axis in range(3):
        at = helix_points(CENTRE, RADIUS, turns=turns, n=400, law=law, axis=axis)[::forth]
        assert helix_axis("", at) == axis


def test_every_helix_of_an_imported_campaign_has_its_axis() -> None:
    """Files of another program state no axis."""
    helices = [r for r in measured(3)[1] if r["test"] == "ballbar_helix"]
    assert helices
    for run in helices:
        assert "axis" not in run["setup"]
        assert helix_axis("", run_data(run_of(run)).axes_mm) is not None
