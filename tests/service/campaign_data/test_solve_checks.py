"""Geometry of runs against their set-ups, and what a refusal and a digest say."""

import copy

import numpy as np
import pytest

from abbe.models.machine import Machine
from abbe.models.paths import helix_points, step_diagonal
from abbe.service.campaign_data.campaign_checks import CampaignIssue, check_files, column_issues, refuse, time_issues
from abbe.service.campaign_data.provenance import campaign_digest, machine_digest, revision, run_digest, versions
from abbe.service.campaign_data.run_geometry import geometry_mistake
from abbe.service.errors import CampaignRefused
from abbe.service.identification.solve import _longest_contained
from tests.run_documents import run_of, runs_of

MACHINE = {"chain": "w-X-Y-b-Z-t", "stroke_mm": {"X": [0, 600], "Y": [0, 500], "Z": [0, 450]}}


def run(test, setup, points):
    columns = {f"{c}_mm": points[:, k].tolist() for k, c in enumerate("xyz")}
    columns |= {"t_s": list(range(len(points))), "deviation_mm": [1e-3 * (k % 7) for k in range(len(points))]}
    return {"run_id": "r1", "test": test, "setup": {"setup_id": "A"} | setup, "columns": columns}


def helix():
    centre = np.array([300.0, 250.0, 100.0])
    return run(
        "ballbar_helix",
        {"centre_mm": centre.tolist(), "radius_mm": 150.0, "turns": 5},
        helix_points(centre, 150.0, turns=5, n=300, law="area", axis=2),
    )


def circle(plane="XY"):
    centre, a = np.array([300.0, 250.0, 200.0]), np.linspace(0, 2 * np.pi, 200)
    points = np.tile(centre, (200, 1))
    points[:, 0] += 100 * np.cos(a)
    points[:, 1] += 100 * np.sin(a)
    return run("ballbar_circle", {"centre_mm": centre.tolist(), "radius_mm": 100.0, "plane": plane}, points)


def diagonal(order="XYZ"):
    start, end = np.array([10.0, 10.0, 10.0]), np.array([490.0, 490.0, 430.0])
    setup = {"diagonal": "ppp", "start_mm": start.tolist(), "end_mm": end.tolist(), "steps": 10, "order": order}
    setup |= {"increment_mm": ((end - start) / 10).tolist(), "nominal_beam": ((end - start) / np.linalg.norm(end - start)).tolist()}
    return run("laser_diagonal", setup, step_diagonal(start, end, 10, order))


def put(found, **keys):
    found = copy.deepcopy(found)
    found["setup"] |= keys
    return found


def text(found):
    what = geometry_mistake(MACHINE, run_of(found))
    assert what is not None
    assert what.refuse
    assert what.remedy
    return what.text


@pytest.mark.parametrize("good", [helix(), circle(), diagonal(), diagonal("ZYX")], ids=["helix", "circle", "diagonal", "reversed order"])
def test_runs_as_they_should_be_are_left_alone(good):
    assert geometry_mistake(MACHINE, run_of(good)) is None


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        (put(helix(), radius_mm=150 / 25.4), "radius_mm holds inches"),
        (put(helix(), centre_mm=[300 / 25.4, 250 / 25.4, 100 / 25.4]), "centre_mm holds inches"),
        (put(helix(), centre_mm=[250.0, 300.0, 100.0]), "columns x_mm and y_mm are exchanged"),
        (put(helix(), radius_mm=140.0), "points lie up to 10 mm beside the sphere"),
        (circle("YZ"), "points leave the plane YZ by up to 100 mm"),
        (put(diagonal(), diagonal="npp"), "diagonal is npp"),
        (put(diagonal(), nominal_beam=[1.0, 0.0, 0.0]), "nominal_beam does not point"),
        (put(diagonal(), order="YXZ"), "steps go in the order XYZ, the run says YXZ"),
        (put(diagonal(), steps=9), "9 steps of increment_mm do not lead"),
        (put(diagonal(), end_mm=[500.0, 500.0, 450.0], increment_mm=None, nominal_beam=None), "positions miss the line"),
    ],
)
def test_what_does_not_fit_is_told_with_its_reason(bad, words):
    assert words in text(bad)


def test_exchanged_axes_of_a_cube_show_in_the_order_of_the_steps():
    bad = diagonal()
    bad["columns"]["x_mm"], bad["columns"]["y_mm"] = bad["columns"]["y_mm"], bad["columns"]["x_mm"]
    assert "steps go in the order YXZ" in text(bad)


def test_a_run_beyond_the_stroke_names_axis_and_stroke():
    small = {"stroke_mm": MACHINE["stroke_mm"] | {"Z": [0, 200]}}
    what = geometry_mistake(small, run_of(helix()))
    assert what is not None
    assert what.text == "Z goes 50 mm beyond the stroke 0 to 200 mm"


def test_a_line_along_another_axis_than_it_says():
    points = np.stack([np.linspace(10, 590, 20), np.full(20, 50.0), np.full(20, 50.0)], axis=1)
    line = run("laser_linear", {"axis": "Y", "start_mm": [10, 50, 50], "end_mm": [590, 50, 50]}, points)
    assert "axis is Y, but start_mm and end_mm differ in X" in text(line)


def test_a_refusal_names_the_first_run_and_how_many_more():
    findings = [
        CampaignIssue("a", "odd", "look", False),
        CampaignIssue("b", "bad", "mend", True),
        CampaignIssue("c", "bad too", "mend", True),
    ]
    with pytest.raises(CampaignRefused) as told:
        refuse(findings)
    assert str(told.value) == "run b: bad (and 1 more issue, in run c) - mend; nothing was stored"
    refuse(findings[:1])


def test_a_digest_is_of_the_data_not_of_the_name():
    first, again = helix(), helix() | {"run_id": "other", "campaign": "c2"}
    assert run_digest(run_of(first)) == run_digest(run_of(again))
    again["columns"]["deviation_mm"][3] += 1e-9
    assert run_digest(run_of(first)) != run_digest(run_of(again))
    one, two = {"a": "1", "b": "2"}, {"x": "2", "y": "1"}
    assert campaign_digest(one, "rigid21", "m") == campaign_digest(two, "rigid21", "m") != campaign_digest(one, "rigid6", "m")
    assert campaign_digest(one, "rigid21", "m") != campaign_digest(one, "rigid21", "other machine")


def test_versions_say_which_program():
    found = versions()
    assert {"abbe", "numpy", "scipy"} <= set(found)
    assert revision() is None or len(found["revision"].removesuffix("+changes")) == 40


def test_a_machine_is_known_by_its_geometry():
    stroke = np.array([[0.0, 600], [0, 500], [0, 450]])
    one = Machine("w-X-Y-b-Z-t", stroke)
    moved = Machine("w-X-Y-b-Z-t", stroke, pivots_mm=np.array([[0.0, 0, 0], [0, 0, 0], [0, 0, 700]]))
    assert machine_digest(one) == machine_digest(Machine("w-X-Y-b-Z-t", stroke.copy())) != machine_digest(moved)


def of_lines(runs):
    return [f.line for f in check_files(MACHINE, runs_of(runs))]


def test_one_spike_is_left_to_the_weights_and_many_are_another_unit():
    spike, um, lost, none = helix(), helix(), helix(), helix()
    spike["columns"]["deviation_mm"][50] = 5.0
    um["columns"]["deviation_mm"] = [3.0 + k % 7 for k in range(300)]
    lost["columns"]["deviation_mm"][200:260] = [8.0] * 60
    none["columns"]["deviation_mm"][5] = 1e300
    assert of_lines([spike]) == []
    assert "look like µm" in of_lines([um])[0]
    assert "60 of 300 readings are beyond 2 mm" in of_lines([lost])[0]
    assert "1e+300 mm in row 6 is not a reading" in of_lines([none])[0]


def test_readings_that_are_all_the_same_are_one_line():
    still = [helix() | {"run_id": n} for n in "abc"]
    for r in still:
        r["columns"]["deviation_mm"] = [0.0] * 300
    with pytest.raises(CampaignRefused) as told:
        refuse(check_files(MACHINE, runs_of(still)))
    assert str(told.value).startswith("run a: in this run and all others every reading is the same")


def fed(run, label, start, factor=1.0):
    points = np.stack([run["columns"][f"{c}_mm"] for c in "xyz"], axis=1)
    t = np.concatenate([[0.0], np.linalg.norm(np.diff(points, axis=0), axis=1).cumsum()]) * 60 / 1000
    run["columns"] |= {"t_s": ((start + t) * factor).tolist(), "feed_mm_min": [1000.0] * len(t)}
    return run | {"run_id": label}


def test_times_in_ms_and_runs_at_the_same_time_are_flagged_by_name():
    good = [fed(helix(), "a", 0), fed(helix(), "b", 2000), fed(circle(), "c", 4000)]
    assert time_issues(runs_of(good)) == []
    (flag,) = time_issues(runs_of([*good, fed(helix(), "d", 6000, factor=1e3)]))
    assert (flag.run, flag.refuse) == ("d", False)
    assert "t_s holds ms" in flag.what
    (flag,) = time_issues(runs_of([*good, fed(helix(), "e", 2010)]))
    assert {flag.run} <= {"b", "e"}
    assert "lie within the times of run" in flag.what


def test_columns_that_contradict_the_positions_are_flagged_by_name():
    good = [fed(circle(), label, 1000.0 * k) for k, label in enumerate("abcd")]
    for run in good:
        run["columns"]["direction"] = [1] * 200
    assert column_issues(runs_of(good)) == []
    for run, key, factor in ((good[1], "direction", -1), (good[2], "feed_mm_min", 4.0)):
        run["columns"][key] = [factor * v for v in run["columns"][key]]
    feed, direction = column_issues(runs_of(good))
    driven = good[0]["columns"]["feed_mm_min"][0]
    assert feed.line.startswith(f"run c: feed_mm_min states {4 * driven:.0f}, but its positions and times give {driven:.0f} mm/min")
    assert direction.line.startswith("run b: its column direction contradicts the sense of rotation of its positions")
    assert not feed.refuse
    assert not direction.refuse


def test_a_set_up_is_found_by_its_whole_name():
    assert _longest_contained(["B1", "B12", "B"], "cup_B12_x") == "B12"
    assert _longest_contained(["B1"], "cup_B12_x") is None
    assert _longest_contained(["r1", "far_r1"], "zero_far_r1") == "far_r1"
