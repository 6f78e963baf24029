"""The covered share of a path, and what follows: one rule for what is judged, for runs of the store and of files."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from abbe.service.campaign_data.campaign_folder import Campaign
from abbe.service.domain.machine import Rules
from abbe.service.domain.measured import RunRecord, this_process
from abbe.service.errors import MeasurementFault
from abbe.service.report.report_measured import Measured, campaign_report
from abbe.service.runs.coverage import COMPLETE, LEAST, covered_share, not_judged, with_state
from abbe.service.verification.compare_runs import incomparable_reason
from abbe.service.verification.iso_report import evaluate
from abbe.service.verification.verify import figures
from tests.run_documents import run_of, runs_of
from tests.scenarios.campaign_files import measured
from tests.service.report.test_helix_axis import compared, helix_about

Doc = dict[str, Any]


def cut(run: Doc, share: float) -> Doc:
    """The first part of a run."""
    keep = round(share * len(run["columns"]["t_s"]))
    return run | {"columns": {name: values[:keep] for name, values in run["columns"].items()}}


def record(run: Doc, status: str, start: Doc) -> RunRecord:
    known = {"campaign": "june", "label": run["run_id"], "test": run["test"], "role": "identify", "status": status, "reason": ""}
    times = {"started_utc": "2026-11-23T00:00:00Z", "ended_utc": None}
    return RunRecord(id=1, campaign_id=1, start_doc=start, end_doc={}, owner=this_process(), **known, **times)


def path_of(run: Doc) -> Doc:
    """The start document of a run that was commanded along the points of another."""
    points = np.column_stack([run["columns"][f"{c}_mm"] for c in "xyz"]).tolist()
    return {"path": {"points_mm": points, "feed_mm_min": 1000.0, "direction": 1}, "rate_hz": 2}


def test_a_stopped_run_says_how_much_of_its_path_it_read() -> None:
    whole = helix_about("Z", axis="Z")
    part = with_state(run_of(cut(whole, 313 / 6970)), record(whole, "stopped", path_of(whole)))
    assert not_judged(part) == "stopped: 3.6 % of the path; not judged"  # its points lie 0.8 of their mean distance apart at its beginning
    assert covered_share(part) == pytest.approx(0.8 * 313 / 6970, abs=0.001)


@pytest.mark.parametrize("status", ["stopped", "aborted", "failed", "interrupted", "disk_full", "running"])
def test_no_run_that_did_not_come_to_its_end_is_judged(status: str) -> None:
    """Also one that had read all but its last sample: what stopped it may have been in it."""
    whole = helix_about("Z", axis="Z")
    part = with_state(run_of(cut(whole, 0.99)), record(whole, status, path_of(whole)))
    assert not_judged(part).startswith(status.replace("_", " "))


def test_a_complete_run_with_a_few_gaps_stays_judged_and_with_a_large_one_not() -> None:
    whole = helix_about("Z", axis="Z")
    few = whole | {"columns": whole["columns"] | {"valid": [0 if k % 100 == 7 else 1 for k in range(500)]}}
    read = run_of(few)
    assert with_state(read, record(few, COMPLETE, path_of(whole))) is read
    large = whole | {"columns": whole["columns"] | {"valid": [0 if 100 <= k < 200 else 1 for k in range(500)]}}
    told = with_state(run_of(large), record(large, COMPLETE, path_of(whole)))
    assert covered_share(told) == pytest.approx(1.0 - 0.92 * 0.2, abs=0.02)
    assert covered_share(told) < LEAST
    assert not_judged(told).startswith("incomplete: ")


def test_standstills_are_counted_of_a_laser_run() -> None:
    run = next(r for r in measured(3)[1] if r["test"] == "laser_diagonal")
    count = len(run["columns"]["t_s"])
    part = with_state(run_of(cut(run, 0.25)), record(run, "stopped", {"standstills": count}))
    assert covered_share(part) == pytest.approx(0.25, abs=0.5 / count + 1e-4)


def test_a_file_whose_helix_ends_early_is_not_judged() -> None:
    """An imported run has no state: its set-up says how many turns there are."""
    runs = [r for r in measured(3)[1] if r["test"] == "ballbar_helix"]
    assert all(not_judged(run_of(run)) == "" for run in measured(3)[1])
    short = run_of(cut(runs[0] | {"setup": runs[0]["setup"] | {"axis": "X"}}, 0.5))
    assert not_judged(short) == "incomplete: 49.8 % of the path; not judged"


@pytest.mark.parametrize("share", [0.02, 0.045, 0.16, 0.4])
def test_a_short_helix_of_a_file_without_an_axis_is_not_judged(share: float) -> None:
    """Its path is too short to tell the axis: then nobody knows how much was read, and nothing is judged."""
    whole = helix_about("Z")
    assert not_judged(run_of(whole)) == ""
    assert "of the path" in not_judged(run_of(cut(whole, share)))


def test_a_hole_in_a_file_was_not_read() -> None:
    helix = helix_about("Z", axis="Z")
    holed = helix | {"columns": helix["columns"] | {"valid": [0 if 200 <= k < 300 else 1 for k in range(500)]}}
    assert covered_share(run_of(holed)) == pytest.approx(0.8, abs=0.02)
    laser = verification()[0]
    ends = [1 if s <= 2 or s >= 10 else 0 for s in [*range(13), *range(12, -1, -1)]]
    holed = laser | {"columns": laser["columns"] | {"valid": ends}}
    assert covered_share(run_of(laser)) == pytest.approx(1.0)
    assert covered_share(run_of(holed)) == pytest.approx(4 / 12)
    assert not_judged(run_of(holed)) == "incomplete: 33.3 % of the path; not judged"


def verification() -> list[Doc]:
    """The four plain body diagonals, out and back, and a helix."""
    runs = measured(3)[1]
    helix = next(r for r in runs if r["test"] == "ballbar_helix")
    axes = runs[0]["machine"]["stroke_mm"]
    ends = np.array([axes[a] for a in "XYZ"], dtype=float)
    out = []
    for letters in ("ppp", "npp", "pnp", "ppn"):
        start = np.array([ends[k, 0 if c == "p" else 1] for k, c in enumerate(letters)])
        end = np.array([ends[k, 1 if c == "p" else 0] for k, c in enumerate(letters)])
        share = np.concatenate([np.linspace(0, 1, 13), np.linspace(1, 0, 13)])
        at = start + share[:, None] * (end - start)
        rng = np.random.default_rng(5)
        columns = {f"{c}_mm": at[:, k].tolist() for k, c in enumerate("xyz")} | {"t_s": np.arange(26.0).tolist()}
        columns |= {"deviation_mm": (0.01 * share + rng.normal(0, 1e-4, 26)).tolist()}
        columns |= {"direction": [1] * 13 + [-1] * 13, "feed_mm_min": [1000.0] * 26}
        setup = {"setup_id": f"L{letters}", "t_set_s": 0.0, "diagonal": letters, "start_mm": start.tolist(), "end_mm": end.tolist()}
        setup |= {"steps": 12, "nominal_beam": ((end - start) / np.linalg.norm(end - start)).tolist()}
        out.append({"run_id": letters, "test": "laser_diagonal", "role": "verify", "setup": setup, "columns": columns})
    return [r | {"machine": helix["machine"]} for r in (*out, helix | {"role": "verify"})]


def test_a_check_with_a_stopped_helix_has_no_verdict() -> None:
    """`figures` is what checks, corrections and reports judge by."""
    runs = verification()
    assert figures(runs_of(runs)).helix is not None
    stopped = with_state(run_of(cut(runs[-1], 0.3)), record(runs[-1], "stopped", path_of(runs[-1])))
    with pytest.raises(MeasurementFault, match=r"stopped: \d+\.\d % of the path; not judged"):
        figures([*runs_of(runs[:-1]), stopped])
    with pytest.raises(MeasurementFault, match=r"stopped: .*not judged"):
        figures(runs_of([runs[0] | {"state": {"status": "stopped", "covered": 0.5}}, *runs[1:]]))


def test_iso_figures_leave_out_what_was_stopped_and_say_so() -> None:
    runs = verification()[:4]
    whole = evaluate(runs_of(runs))
    assert any(f.method == "ISO 230-6" for f in whole.figures)
    part = evaluate(runs_of([runs[0] | {"state": {"status": "aborted", "covered": 0.5}}, *runs[1:]]))
    assert "figures by ISO 230 of run ppp: aborted: 50.0 % of the path; not judged" in part.not_observable
    assert len(part.figures) < len(whole.figures)


def test_the_report_of_a_campaign_leaves_out_a_file_that_ends_early() -> None:
    runs = verification()
    site = measured(3)[0]
    rules = Rules({"body_diagonal_um": 50.0, "helix_rms_um": 50.0})
    symbols = [f.symbol for f in campaign_report(Measured(Campaign("june", site, runs_of(runs), None, {})), rules).figures]
    short = cut(runs[-1] | {"setup": runs[-1]["setup"] | {"axis": "X"}}, 0.4)
    document = campaign_report(Measured(Campaign("june", site, runs_of([*runs[:-1], short]), None, {})), rules)
    assert any(line.startswith(f"run {short['run_id']} is incomplete: ") for line in document.remarks)
    assert "helix" in " ".join(symbols)
    assert "helix" not in " ".join(f.symbol for f in document.figures)


def test_a_part_of_a_path_is_compared_with_nothing() -> None:
    whole = helix_about("Z", axis="Z")
    part = with_state(run_of(cut(whole, 0.5)), record(whole, "stopped", path_of(whole)))
    assert "stopped: 45.1 % of the path" in incomparable_reason(compared(whole), compared(part))
    assert "not judged" in incomparable_reason(compared(part), compared(whole))
