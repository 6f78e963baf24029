"""Which readings of a run are approaches of ISO 230: turning points, reversed axes, several runs of one test, and what is refused."""

from typing import Any

import numpy as np
import pytest

from abbe.models.machine import Machine
from abbe.models.verification import diagonal_figure
from abbe.service.runs.observations import run_data
from abbe.service.sequences.recipes.recipe import Linear
from abbe.service.sequences.steps import MoveTo, ReadLaser
from abbe.service.verification.iso_readings import circle_tests, diagonal_tests, linear_tests
from abbe.service.verification.iso_report import evaluate
from tests.run_documents import run_of, runs_of

MACHINE = {"name": "m", "chain": "w-X-Y-b-Z-t", "stroke_mm": {"X": [0, 600], "Y": [0, 500], "Z": [0, 450]}}


def line(recipe: Linear, deviation, **setup: Any) -> dict[str, Any]:
    """The run of a recipe on a machine with a given deviation: a function of position along the axis and direction."""
    plan = recipe.plan(Machine("w-X-Y-b-Z-t", np.array([[0.0, 600.0], [0.0, 500.0], [0.0, 450.0]])))
    at, rows = None, []
    for step in plan.steps:
        if isinstance(step, MoveTo):
            at = step.target_mm
        elif isinstance(step, ReadLaser):
            rows.append((*at, step.direction))
    x, y, z, d = (np.array(v, dtype=float) for v in zip(*rows, strict=True))
    values = deviation(np.stack([x, y, z])[recipe.axis], d)
    n = len(rows)
    columns = {"t_s": np.arange(n).tolist(), "x_mm": x.tolist(), "y_mm": y.tolist(), "z_mm": z.tolist(), "feed_mm_min": [1000.0] * n}
    columns |= {"direction": d.tolist(), "deviation_mm": (values - values[0]).tolist()}
    head = {"format": "abbe-run/1", "campaign": "c", "run_id": recipe.label, "test": plan.test, "role": "identify", "machine": MACHINE}
    return head | {"setup": plan.setup.document | {"t_set_s": 0.0} | setup, "columns": columns}


def lost(position, direction):
    """1 µm per 100 mm and 4 µm of lost motion."""
    return 1e-5 * position - 0.002 * (direction < 0) * 2.0


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_turning_points_of_an_overrun_are_no_positions(axis):
    run = line(Linear("l", "L", "identify", axis, positions=5, cycles=3, overrun_mm=2.0, at_share=(0.15, 0.15)), lost)
    (test,) = linear_tests([run_of(run)], [])
    assert test.name == "XYZ"[axis]
    assert test.readings.position_mm.size == 5
    assert test.readings.forward_mm.shape == (5, 3)
    assert test.readings.position_mm[0] == 10.0
    assert np.allclose(test.readings.forward_mm - test.readings.backward_mm, 0.004)
    assert test.notes == ()
    by = {f.symbol: f for f in evaluate([run_of(run)]).figures}
    assert by["B"].value == pytest.approx(4.0)
    assert by["E"].value == pytest.approx(4.0 + 1e-2 * np.ptp(test.readings.position_mm))
    assert by["R"].value == pytest.approx(4.0)


def test_without_overrun_the_end_is_said_to_be_read_twice():
    (test,) = linear_tests([run_of(line(Linear("l", "L", "identify", 0, positions=5, at_share=(0.15, 0.15)), lost))], [])
    assert test.readings.position_mm.size == 5
    assert "no overrun is recorded" in test.notes[0]


def test_runs_of_one_set_up_are_one_test_and_other_set_ups_are_others():
    first, second = (line(Linear(n, "L", "identify", 0, positions=5, at_share=(0.15, 0.15)), lost) for n in "ab")
    other = line(Linear("c", "M", "identify", 0, positions=5, at_share=(0.15, 0.15)), lost)
    found = linear_tests(runs_of([first, other, second]), [])
    assert [(t.setup, t.runs) for t in found] == [("L", ("a", "b")), ("M", ("c",))]
    assert found[0].readings.forward_mm.shape == (5, 2)


def test_a_test_against_the_axis_reads_the_same(monkeypatch):
    """Start and end exchanged: displacement along the beam is the other way, and so are both directions."""
    run = line(Linear("l", "L", "identify", 0, positions=5, cycles=2, overrun_mm=2.0, at_share=(0.15, 0.15)), lost)
    there = linear_tests([run_of(run)], [])[0].readings
    setup, columns = run["setup"], run["columns"]
    turned = run | {"setup": setup | {"start_mm": setup["end_mm"], "end_mm": setup["start_mm"]}}
    turned["columns"] = columns | {k: (-np.array(columns[k])).tolist() for k in ("direction", "deviation_mm")}
    back = linear_tests([run_of(turned)], [])[0].readings
    assert np.allclose(back.forward_mm, there.forward_mm)
    assert np.allclose(back.backward_mm, there.backward_mm)


def test_what_cannot_be_evaluated_is_told_and_stops_nothing():
    good, bad = (line(Linear(n, n, "identify", 0, positions=5, at_share=(0.15, 0.15)), lost) for n in "ab")
    bad["columns"]["direction"] = [1] * len(bad["columns"]["direction"])
    columns = {k: v[:4] for k, v in good["columns"].items()}
    setup = {"setup_id": "B", "plane": "XY", "centre_mm": [300, 250, 100], "radius_mm": 100.0}
    circle = good | {"run_id": "c", "test": "ballbar_circle", "setup": setup, "columns": columns}
    told = evaluate(runs_of([good, bad, circle]))
    assert any(f.symbol == "E" for f in told.figures)
    assert len([line for line in told.not_observable if line.startswith("figures by ISO 230 of")]) == 2
    refused: list[str] = []
    assert circle_tests([run_of(circle)], refused) == []
    assert "valid readings" in refused[0]


@pytest.mark.parametrize("overrun_mm", [0.0, 2.0])
def test_the_verifications_range_is_the_standards_m(overrun_mm: float):
    """Two ways through the code, one figure: `abbe.models.verification` and ISO 230-6. Turning points are no positions."""
    run = line(
        Linear("l", "L", "identify", 0, positions=9, at_share=(0.15, 0.15), overrun_mm=overrun_mm),
        lambda x, d: 1e-8 * (x - 200.0) ** 2 + 0.003 * (d < 0) + 1e-4 * np.sin(x * d),
    )
    run |= {"test": "laser_diagonal", "setup": run["setup"] | {"diagonal": "ppp"}}
    (test,) = diagonal_tests([run_of(run)], [])["body"]
    by = {f.symbol: f for f in evaluate([run_of(run)]).figures}
    ends = run_of(run).laser.ends_mm if overrun_mm else ()
    old = diagonal_figure(run_data(run_of(run)), ends)
    assert old.position_mm[[0, -1]] == pytest.approx([overrun_mm, 580.0 + overrun_mm])
    assert len(old.position_mm) == 9
    assert by["M_d"].value == pytest.approx(old.value_mm * 1e3, rel=1e-9)
    assert by["M_d"].u > old.u_mm * 1e3  # the temperature of the scales on top
    assert any("npp, pnp, ppn not measured" in line for line in evaluate([run_of(run)]).not_observable)
    assert test.name == "ppp"
