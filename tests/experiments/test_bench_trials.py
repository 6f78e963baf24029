"""Every contestant of the bench's uncertainty part computes the same thing, in small; and the judge sees it when one does not."""

from importlib.util import find_spec

import numpy as np
import pytest

from abbe.models.solvers.joint import solve_joint
from tests.experiments.bench import trials_case as cases
from tests.experiments.bench import trials_contestants as contestants
from tests.experiments.bench import trials_report as report
from tests.experiments.bench.trials_judge import JOINT_MM, SAME_DRAWS_U, judged, sampled

OURS = {"linear": contestants.linear_ours, "helix": contestants.helix_ours}


def small(name, **sizes):
    return getattr(contestants, name)(getattr(cases, f"{name.split('_')[0]}_case")(), **sizes)


@pytest.fixture(scope="module")
def ours():
    return {name: small(f"{name}_ours", trials=20_000).result() for name in OURS}


def test_the_linear_campaign_has_60_unknowns():
    case = cases.linear_case()
    assert case.a.shape == (544, 60)
    assert np.linalg.cond(case.rows) < 1e5


@pytest.mark.parametrize(
    ("name", "sizes", "needs"),
    [
        ("linear_lstsq", {"timed": 3, "counted": 1000}, None),
        ("linear_lstsq_many", {"trials": 3000}, None),
        ("helix_scipy", {"timed": 3, "counted": 150}, None),
        ("helix_scipy", {"timed": 3, "counted": 500, "jacobian": True}, None),
        ("helix_lmfit", {"timed": 3, "counted": 100}, "lmfit"),
    ],
)
def test_trials_of_every_contestant_agree_with_ours(name, sizes, needs, ours, require):
    if needs:
        require(needs, find_spec(needs) is not None, f"{needs} is installed by the bench extra only")
    case = name.split("_")[0]
    contestant = small(name, **sizes)
    contestant.run()
    found = judge(case, contestant.result(), ours[case])
    assert found["ok"], found


def judge(case, result, ours):
    return sampled(result, ours, cases.linear_case() if case == "linear" else cases.helix_case(), SAME_DRAWS_U[case])


@pytest.mark.parametrize("name", ["uncertainties", "gtc"])
def test_propagation_of_every_contestant_agrees_with_ours(name, require):
    module = {"gtc": "GTC"}.get(name, name)
    require(module, find_spec(module) is not None, f"{module} is installed by the bench extra only")
    case = cases.propagation_case(points=3)
    results = {
        "propagation-ours": contestants.propagation_ours(case).result(),
        name: getattr(contestants, f"propagation_{name}")(case).result(),
    }
    assert judged("propagation", results)[name]["ok"]


def test_our_propagation_is_the_law_written_out():
    case = cases.propagation_case(points=4)
    expected = [[np.sqrt(row @ case.covariance @ row) for row in point] for point in case.design]
    result = contestants.propagation_ours(case).result()
    np.testing.assert_allclose(result["u"], expected, rtol=1e-9)
    results = {"propagation-ours": result, "gtc": {**result, "u": result["u"] * (1 + 1e-5)}}
    assert not judged("propagation", results)["gtc"]["ok"]


@pytest.mark.parametrize("case", ["linear", "helix"])
def test_the_judge_sees_another_estimate_another_mean_another_covariance(case, ours):
    good = ours[case]
    u = (cases.linear_case() if case == "linear" else cases.helix_case()).u
    same = {**good, "trials": np.array(20_000)}
    assert judge(case, same, good)["ok"]
    assert not judge(case, {**good, "common": good["common"] + 0.02 * u}, good)["ok"]
    assert not judge(case, {**good, "mean": good["mean"] + 0.06 * u}, good)["ok"]
    assert not judge(case, {**good, "covariance": 1.1 * good["covariance"]}, good)["ok"]


@pytest.mark.parametrize("case", ["linear", "helix"])
def test_ours_is_held_against_the_law_of_propagation(case, ours):
    """A tenth more or less variance, or a mean off by 0.06 u, in our own figures: nobody to compare with would see it in 400 trials."""
    good = ours[case]
    verdict = judge(case, good, good)
    assert verdict["ok"]
    assert verdict["covariance_sigmas"] > 0.0
    u = (cases.linear_case() if case == "linear" else cases.helix_case()).u
    for wrong in ({"covariance": 1.1 * good["covariance"]}, {"covariance": 0.9 * good["covariance"]}, {"mean": good["mean"] + 0.06 * u}):
        falsified = {**good, **wrong}
        assert not judge(case, falsified, falsified)["ok"]


def test_a_joint_solution_of_a_smaller_campaign_finds_the_waves_and_a_wrong_one_is_seen():
    runs = cases.joint_case(helices=4, points=150, steps=12)
    points = np.random.default_rng(1).uniform(cases.MACHINE.stroke_mm[:, 0] + 60, cases.MACHINE.stroke_mm[:, 1] - 60, (50, 3))
    found = solve_joint(cases.MACHINE, runs, order=5)
    result = {"points": points, "deviation": found.deviation_mm(points), "unknowns": np.array(len(found.estimate.names))}
    wrong = {**result, "deviation": np.zeros_like(points)}
    verdict = judged("joint", {"joint-order-5": result, "joint-ours": wrong})
    assert verdict["joint-order-5"]["ok"]
    assert verdict["joint-order-5"]["prediction_rms_mm"] < 0.7 * JOINT_MM
    assert not verdict["joint-ours"]["ok"]


def test_the_campaign_of_the_speed_goal_is_the_one_of_the_goal():
    runs = cases.joint_case()
    assert [r.deviation_mm.size for r in runs if r.kind == "bar"] == [500] * 10
    assert sum(r.kind == "laser" for r in runs) == 8


def test_the_report_prints_ratios_goals_and_marks_what_differs():
    timing = {"min_s": 0.5, "median_s": 0.6, "items": 100, "per_item_s": 5e-3, "beyond_mb": None}
    fast = {**timing, "items": 100_000, "per_item_s": 5e-6, "beyond_mb": 4.0}
    row = {"same_draws_u": 1e-9, "mean_sigmas": 1.0, "covariance_sigmas": 1.0, "trials": 10, "ok": True}
    case = {"contestants": {"linear-ours": fast, "lstsq": timing}, "agreement": {"linear-ours": row, "lstsq": {**row, "ok": False}}}
    joint = {
        "contestants": {"joint-ours": {**timing, "min_s": 1.5, "items": 1}},
        "agreement": {"joint-ours": {"prediction_rms_mm": 1e-4, "unknowns": 9, "ok": True}},
    }
    text = "\n".join(report.lines({"linear": case, "joint": joint}))
    assert "1000 (goal 100: met)" in text
    assert "500.00" in text
    assert "DIFFERS" in text
    assert "1.50 s (goal 1 s: NOT MET)" in text
    assert set(report.WORDS) == {k for names in contestants.TRIAL_CASES.values() for k in names}
