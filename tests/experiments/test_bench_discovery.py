"""The bookkeeping of the bench's discovery: columns to groups to labels to marks. What is planted is known; `discover` is not called."""

from importlib.util import find_spec

import numpy as np
import pytest

from abbe.models.effects.catalogue import CATALOGUE
from abbe.service.campaign_data.decimation import MOST_READINGS
from abbe.simulators.hidden import plans
from tests.experiments.bench import discovery_report as report
from tests.experiments.bench.discovery_case import CASES, kinds_of, measured_bar_readings, read_case, write_long
from tests.experiments.bench.discovery_contestants import (
    CONTESTANTS,
    Candidates,
    answer,
    bic,
    bic_forward,
    forward_evidence,
    grouped,
    lasso_evidence,
)
from tests.experiments.bench.discovery_judge import ROWS, SCATTER, WITH_COLUMNS, costs, counted

N = 400
LABELS = ("backlash:X", "backlash:X", "ram_sag", "servo_mismatch:XY", "unnamed_step:Z")
SIZES = (1, 1, 2, 0, 1)


def candidates(*, play: float = 0.0, sag: float = 0.0, step: float = 0.0) -> Candidates:
    """Noise of 1 with what is asked for in it; it takes both starts of backlash to make that."""
    rng = np.random.default_rng(5)
    columns = rng.normal(size=(N, sum(SIZES)))
    columns /= np.linalg.norm(columns, axis=0)
    noise = rng.normal(size=N)
    noise -= columns @ np.linalg.lstsq(columns, noise, rcond=None)[0]  # plain BIC finds names in noise that looks like columns
    y = noise + play * (columns[:, 0] + columns[:, 1]) + sag * columns[:, 3] + step * columns[:, 4]
    return grouped(y, columns, LABELS, SIZES)


@pytest.fixture
def peers(require):
    for name, package in (("sklearn", "scikit-learn"), ("statsmodels", "statsmodels")):
        require(name, find_spec(name) is not None, f"{package} is installed by the bench extra only")


def test_groups_keep_their_columns_and_empty_ones_go():
    c = candidates()
    assert c.labels == ("backlash:X", "backlash:X", "ram_sag", "unnamed_step:Z")
    assert c.groups == (slice(0, 1), slice(1, 2), slice(2, 4), slice(4, 5))


def test_bic_of_nothing_is_on_the_librarys_scale(peers):
    """A column that takes nothing away costs the logarithm of the number of readings, also from no column to one."""
    c = candidates()
    assert bic(c, [0]) - bic(c, []) == pytest.approx(np.log(N), abs=1e-6)


@pytest.mark.parametrize(
    ("planted", "names"),
    [({}, []), ({"play": 20.0}, ["backlash:X"]), ({"sag": 40.0, "play": 12.0}, ["ram_sag", "backlash:X"])],
)
def test_both_peers_name_what_was_planted_and_two_starts_are_one_name(peers, planted, names):
    c = candidates(**planted)
    for evidence in (forward_evidence(c, bic_forward(c)), lasso_evidence(c)):
        said = answer(evidence)
        assert [e["name"] for e in said["effects"]] == names
        assert said["verdict"] == ("named" if names else "none")


def test_evidence_of_a_name_is_what_all_its_starts_carry(peers):
    c = candidates(play=20.0)
    without = Candidates(c.y, c.columns[:, 2:], ("ram_sag",), (slice(0, 2),))
    found = forward_evidence(c, [0, 1])["backlash:X"]
    assert found == pytest.approx(0.5 * (bic(without, []) - bic(c, [0, 1])))
    assert found > 100.0


def test_a_structure_without_a_name_is_no_name(peers):
    c = candidates(step=30.0)
    for evidence in (forward_evidence(c, bic_forward(c)), lasso_evidence(c)):
        assert answer(evidence) == {"verdict": "unknown", "effects": []}


def test_the_verdict_goes_by_what_carries_more():
    assert answer({})["verdict"] == "none"
    assert answer({"ram_sag": 3.0, "unnamed_step:Z": 4.0})["verdict"] == "unknown"
    said = answer({"ram_sag": 3.0, "backlash:X": 9.0, "unnamed_step:Z": 4.0})
    assert said == {"verdict": "named", "effects": [{"name": "backlash:X", "evidence": 9.0}, {"name": "ram_sag", "evidence": 3.0}]}


def truth(kind: str, *labels: str, snr: float = 90.0) -> dict:
    """A truth with no sealed runs."""
    effects = [
        {
            "label": label, "name": label.split(":")[0], "in_catalogue": kind != "unknown", "aliases": [], "explained_by_catalogue": [],
            "separated_by": {}, "snr_local": 3.0, "snr_total": snr, "parameters": {"strength": 1.0}, "where": {},
        }
        for label in labels
    ]  # fmt: skip
    return {"kind": kind, "plan": "full", "effects": effects, "sealed_runs": {}}


def said(**evidence: float) -> dict:
    return answer({name.replace("__", ":"): e for name, e in evidence.items()})


def test_marks_of_peers_are_those_of_the_campaigns():
    truths = [
        truth("single", "backlash:X"), truth("single", "vibration:X"), truth("single", "ram_sag", snr=4.0),
        truth("double", "backlash:X", "ram_sag"), truth("double", "backlash:X", "ram_sag"),
        truth("null"), truth("null"), truth("unknown", "creep:Z"),
    ]  # fmt: skip
    answers = [
        said(backlash__X=9.0), said(ram_sag=5.0), said(), said(ram_sag=9.0, backlash__X=3.0),
        said(backlash__X=9.0, backlash__Y=3.0), said(), said(ram_sag=2.0), said(unnamed_wave=5.0),
    ]  # fmt: skip
    assert counted(truths, answers) == {
        "one effect, snr_total >= 10": [1, 2],
        WITH_COLUMNS: [1, 1],
        "two effects: both, nothing else": [1, 2],
        "recall of visible effects": [4, 6],
        "null: false alarms": [1, 2],
        "outside of the catalogue: unknown": [1, 1],
        "false names": [3, 7],
    }


def test_effects_without_columns_are_those_of_the_scatter():
    assert "vibration" in SCATTER
    assert "backlash" not in SCATTER
    assert len(SCATTER) < len(CATALOGUE)


def test_the_bench_has_every_kind_from_four_campaigns_on():
    assert set(kinds_of(4)) == {"single", "double", "null", "unknown"}
    kinds = kinds_of(CASES)
    assert [kinds.count(k) for k in ("single", "double", "null", "unknown")] == [6, 4, 4, 2]


def test_the_long_campaign_is_as_long_as_one_that_is_searched_reading_by_reading(tmp_path):
    """And the others have as many readings as before once it is written."""
    usual = [plans.HELIX_N, plans.CIRCLE_N]
    case = read_case(tmp_path, write_long(tmp_path))
    assert usual == [plans.HELIX_N, plans.CIRCLE_N]
    assert 0.99 * MOST_READINGS <= measured_bar_readings(case) <= MOST_READINGS


def test_the_report_prints_marks_costs_and_goals():
    run = {"cpu_s": 2.0, "clock_s": 3.0, "columns_s": None, "beyond_mb": 100.0, "process_peak_mb": 400.0}
    runs = [run, {**run, "cpu_s": 12.0}, {**run, "cpu_s": 40.0, "process_peak_mb": 501.0}]
    cost = costs(runs)
    assert (cost["median_s"], cost["longest_s"], cost["process_peak_mb"], cost["columns_s"]) == (12.0, 40.0, 501.0, None)
    assert costs([{**run, "columns_s": 1.0, "beyond_mb": None}])["beyond_mb"] is None
    counts = {row: [1, 2] for row in ROWS}
    found = {
        "first_seed": 7,
        "kinds": kinds_of(3),
        "long": {**run, "cpu_s": 31.0, "readings": 19998},
        "contestants": {k: {"counts": counts, "costs": cost} for k in CONTESTANTS}
        | {"discover": {"counts": counts, "costs": costs([run])}},
    }
    text = "\n".join(report.lines(found))
    assert text.count("1 of 2") == len(ROWS) * len(CONTESTANTS)
    assert "seeds 7 to 9" in text
    assert "goals of discover: median 10 s: met, longest 30 s: met, process 500 MB: met" in text
    assert "discover with 19998 ball-bar readings: 31.0 s: NOT MET, process 400 MB: met" in text
    found["contestants"]["discover"]["costs"] = cost
    assert "median 10 s: NOT MET, longest 30 s: NOT MET, process 500 MB: NOT MET" in "\n".join(report.lines(found))
    assert tuple(report.WORDS) == CONTESTANTS
