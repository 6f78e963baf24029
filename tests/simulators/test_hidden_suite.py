"""Suites of sealed cases: the product reads them, they are judged by their keys, a seed decides everything, visibility is what it says."""

import json
from pathlib import Path

import numpy as np
import pytest

from abbe.service.domain.machine import machine_from_doc
from abbe.service.runs.cases import case_of
from abbe.service.runs.exchange import read_folder
from abbe.simulators.__main__ import main
from abbe.simulators.hidden.cases import Case, make_case
from abbe.simulators.hidden.draws import KINDS
from abbe.simulators.hidden.plans import PLANS, Machinery, runs_of
from abbe.simulators.hidden.suite import campaign, kinds_of, make_suite, run_file, sealed, write_case

TRUTH_KEYS = {"format", "case", "kind", "forms", "plan", "level", "verdict", "effects", "noise", "known_setup", "gap", "sealed_runs"}
EFFECT_KEYS = {
    "predictable", "separated_by", "label", "name", "key", "unit", "in_catalogue", "parameters", "raw_rms_um", "separable_rms_um",
    "snr_local", "snr_total", "share_touched", "where", "aliases", "explained_by_catalogue",
}  # fmt: skip
RUN_KEYS = {"test", "setup_id", "sigma_um", "deviation_mm", "clean_mm", "without_effect_mm", "xyz_mm", "info", "setup_seen"}
SMALL = (31, 3)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small suite as the command writes it."""
    out = tmp_path_factory.mktemp("suite")
    assert main(["hidden-suite", "--first", str(SMALL[0]), "--cases", str(SMALL[1]), "--out", str(out)]) == 0
    return out


def test_the_product_reads_what_is_public(folder: Path) -> None:
    found = sorted((folder / "public").iterdir())
    assert len(found) == SMALL[1]
    for public in found:
        read = read_folder(public)
        case = case_of(read.campaign, machine_from_doc(read.campaign["machine"]), read.runs)
        assert {r.role for r in case.runs} == {"identify", "holdout", "sealed"}
        assert all((r.deviation_mm is None) == (r.role == "sealed") for r in case.runs)
        text = "".join(p.read_text() for p in public.iterdir())
        assert "strength" not in text
        assert "wild" not in text


def test_the_truth_has_what_the_judge_asks_for(folder: Path) -> None:
    for path in sorted((folder / "sealed").iterdir()):
        truth = json.loads(path.read_text())
        assert set(truth) == TRUTH_KEYS
        assert truth["verdict"] == {"null": "none", "unknown": "unknown"}.get(truth["kind"], "named")
        assert len(truth["effects"]) == {"null": 0, "double": 2}.get(truth["kind"], 1)
        for e in truth["effects"]:
            assert set(e) == EFFECT_KEYS
            assert "strength" in e["parameters"]
            assert set(e["separated_by"]) == set(e["aliases"])
        for run in truth["sealed_runs"].values():
            assert set(run) == RUN_KEYS
            noise = 1e3 * (np.array(run["deviation_mm"]) - np.array(run["clean_mm"])) / run["sigma_um"]
            assert 0.6 < np.std(noise) < 1.4 or any(not e["predictable"] for e in truth["effects"])
            assert np.isfinite(run["without_effect_mm"]).all()


def documents(case: Case) -> str:
    readings = {r.run_id: case.setting.noise.put(case.clean_mm[r.run_id], r, case.setting.seed) for r in case.runs}
    return json.dumps([campaign(case), sealed(case, readings), *(run_file(case, r, readings[r.run_id]) for r in case.runs[:3])])


def test_a_seed_decides_everything() -> None:
    one, again, other = (make_case("c", seed, "double") for seed in (5, 5, 7))
    assert documents(one) == documents(again)
    assert documents(one) != documents(other)


def test_a_null_case_hides_nothing() -> None:
    case = make_case("c", 5, "null")
    assert case.effects == ()
    assert case.gap_um == 0.0
    assert all(np.array_equal(case.clean_mm[k], case.without_mm[k]) for k in case.clean_mm)


def test_a_case_without_any_separable_trace_is_all_aliases() -> None:
    """Seen through helices of one radius and feed, contour lag is a constant that the bar's length takes in."""
    for seed in range(400, 480):
        case = make_case("c", seed, "single")
        fact = case.facts[0]
        if float(str(fact["snr_total"])) < 3.0:
            assert len(list(fact["aliases"])) > 20  # type: ignore[call-overload]
            return
    pytest.fail("no such case among these seeds")


def test_plans_are_what_they_are_called() -> None:
    machine = Machinery(np.zeros(3), np.array([600.0, 500.0, 450.0]), 2, np.ones(3))
    plans = {plan: runs_of(plan, machine) for plan in PLANS}
    identify = {plan: [r for r in runs if r.role == "identify"] for plan, runs in plans.items()}
    assert {r.feed for r in identify["one_feed"] if r.track.kind == "bar"} == {2000.0}
    assert {r.track.radius_mm for r in plans["one_radius"] if r.track.kind == "bar"} == {150.0}
    assert {r.track.kind for r in plans["ballbar"]} == {"bar"}
    assert {r.track.kind for r in plans["laser"]} == {"laser"}
    assert all(r.direction[0] == 1.0 for r in plans["one_way"] if r.track.kind == "bar")
    assert {len(p) for p in plans.values()} == {6, 10, 20, 22, 26, 30}
    for runs in plans.values():
        starts = [float(r.track.t_s[0]) for r in runs]
        assert starts == sorted(starts)
        low, high = machine.low_mm, machine.high_mm
        assert all((r.track.q_mm >= low).all() and (r.track.q_mm <= high).all() for r in runs)


def test_proportions_of_kinds() -> None:
    kinds = kinds_of(173, list(KINDS), 1)
    assert {k: kinds.count(k) for k in KINDS} == KINDS
    assert set(kinds_of(40, ["null"], 1)) == {"null"}


def test_textbook_suites(tmp_path: Path) -> None:
    case = next(make_suite(8, 1, ("single",), wild=False))
    write_case(case, tmp_path)
    assert all(e.wild == 0 for e in case.effects)
    assert json.loads((tmp_path / "sealed" / "case0000.json").read_text())["forms"] == "textbook"


def test_wrong_requests_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(["hidden-suite", "--first", "1", "--cases", "2", "--kinds", "single,triple", "--out", str(tmp_path)])
    assert caught.value.code == 2
    assert "unknown kind 'triple'" in capsys.readouterr().err
