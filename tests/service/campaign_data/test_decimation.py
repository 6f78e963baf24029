"""Long ball-bar runs become means of equal blocks; everything else stays as it is."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from abbe.service.campaign_data import decimation as module
from abbe.service.campaign_data.campaign_folder import from_folder
from abbe.service.campaign_data.decimation import lines_of, picked, thinned, thinning
from abbe.service.discovery.discover import DiscoveryJournal, discover, prepare
from abbe.service.discovery.discovery_answer import answer_doc
from abbe.service.domain.discovery_file import DiscoveryFile
from abbe.service.domain.progress import ignore_progress
from abbe.service.effects.effect_catalogue import catalogue
from abbe.service.rendering.document_page import document_html
from abbe.service.report.report_discovery import found_report
from tests.run_documents import run_of, runs_of
from tests.service.discovery.discovery_bench import Search, circle, write_case


def test_short_campaigns_stay_as_they_are() -> None:
    runs = runs_of([circle(1, "identify"), circle(2, "sealed")])
    assert thinned(runs) is runs


def test_long_ones_become_means(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MOST_READINGS", 100)
    laser = circle(3, "identify") | {"test": "laser_linear"}
    first = circle(1, "identify")
    first["columns"]["valid"] = [0] * 3 + [1] * 2 + [0] + [1] * 114
    runs = runs_of([first, circle(2, "holdout"), circle(4, "sealed"), laser])
    short = thinned(runs)  # 240 measured readings of the ball-bar: blocks of three
    assert [len(r.columns) for r in short] == [40, 40, 120, 120]
    assert short[2:] == runs[2:]
    columns, read = short[0].columns, runs[0].columns
    assert columns.valid.tolist() == [False] + [True] * 39
    assert columns.readings_mm[1] == pytest.approx(read.readings_mm[3:5].mean())  # the flagged one does not count
    assert columns.readings_mm[5] == pytest.approx(read.readings_mm[15:18].mean())
    assert columns.q_mm[5, 0] == read.q_mm[16, 0]  # a point of the path: the mean of three lies inside the circle
    assert columns.direction.tolist() == read.direction[:40].tolist()
    assert np.all(np.diff(columns.t_s) > 0)
    assert len(read) == 120


def test_a_block_over_lost_readings_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MOST_READINGS", 20)
    whole = run_of(circle(1, "identify"))
    run = replace(whole, columns=whole.columns.rows([i for i in range(120) if not 40 <= i < 70]))
    short = thinned([run])[0].columns  # blocks of five, one of them from reading 40 to 74
    assert len(short) == 18
    assert set(short.q_mm[:, 0]) <= set(run.columns.q_mm[:, 0])
    assert len(thinned([whole])[0].columns) == 20


def test_lost_readings_do_not_change_how_many_one_value_stands_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MOST_READINGS", 20)
    run = run_of(circle(1, "identify"))
    late_s = sum(1000.0 * (np.arange(120) >= pause) for pause in (8, 38, 68))  # three of its blocks have a gap
    run = replace(run, columns=replace(run.columns, t_s=run.columns.t_s + late_s).rows(slice(118)))
    short = thinned([run])
    told = thinning([run], short)
    assert told is not None
    assert len(short[0].columns) == 16
    assert told.readings_per_value == 6  # 118 readings over 16 values are 7


def test_a_flagged_reading_that_is_no_number_leaves_its_mean_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MOST_READINGS", 40)
    doc = circle(1, "identify")
    doc["columns"]["valid"] = [1] * 4 + [0] + [1] * 115
    doc["columns"]["deviation_mm"][4] = float("nan")
    run = run_of(doc)
    columns = thinned([run])[0].columns  # blocks of three
    assert columns.readings_mm[1] == pytest.approx(np.mean(run.columns.readings_mm[[3, 5]]))
    assert columns.valid.all()
    told = thinning([run], picked([run], 40))
    assert told is not None
    assert told.how == "picked"  # a reading that is not a number is not another one


def test_a_short_run_beside_long_ones_keeps_its_readings() -> None:
    long, whole = runs_of([circle(1, "identify"), circle(2, "identify")])
    short = replace(whole, columns=whole.columns.rows(slice(4)))
    few = picked([long, short], 10)  # one of 13: the middle one would be the seventh
    assert few[1] is short
    told = thinning([long, short], few)
    assert told is not None
    assert (told.readings_per_value, told.kept) == (13, 13)


def test_what_thinning_hides_is_told_in_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MOST_READINGS", 100)
    runs = runs_of([circle(1, "identify"), circle(2, "holdout"), circle(4, "sealed")])
    assert thinning(runs, runs) is None
    told = thinning(runs, thinned(runs))
    assert told is not None
    assert (told.readings, told.kept, told.readings_per_value, told.how) == (240, 80, 3, "means")
    step = np.diff(runs[0].columns.t_s)[0]
    assert told.interval_s == pytest.approx(3.0 * step)
    assert told.highest_hz == pytest.approx(1.0 / (6.0 * step))
    assert 4 <= told.values_with_reversal <= 8  # X and Y turn round twice a turn each; one of these is where the circle begins
    done, hidden, remedy = lines_of(told)
    assert "every 3 of them were averaged, 80 values in all" in done
    assert "effects hidden by this reduction may still be present" in hidden
    assert f"{told.values_with_reversal} averages span a reversal of an axis" in hidden
    assert f"vibration above {told.highest_hz:.2g} Hz" in hidden
    assert "shrinks to 1/3 of its height" in hidden
    assert f"keeps its height if it lasts {6.0 * step:.2g} s" in hidden  # half as long, it lies in two means
    assert "--without RUN" in remedy


def test_readings_that_were_left_out_are_told_too() -> None:
    runs = runs_of([circle(1, "identify"), circle(2, "holdout")])
    told = thinning(runs, picked(runs, 80))
    assert told is not None
    assert (told.how, told.readings_per_value) == ("picked", 3)
    assert "one of every 3 was used, unaveraged" in lines_of(told)[0]


def test_a_thinned_campaign_says_so_in_command_json_and_report(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = write_case(tmp_path / "c1")
    monkeypatch.setattr(module, "MOST_READINGS", 200)
    job = prepare(from_folder(folder), catalogue())
    journal = DiscoveryJournal()
    finding = discover(job, journal, Search("none"), ignore_progress)
    assert job.thinning is not None
    assert set(lines_of(job.thinning)) <= set(job.flags)  # `abbe discover` prints every flag
    assert journal.steps[0].start is not None
    assert journal.steps[0].start.flags == job.flags
    answer = answer_doc(finding)
    assert DiscoveryFile.model_validate_json(json.dumps(answer)).thinning is not None
    assert (answer["thinning"]["readings"], answer["thinning"]["readings_per_value"]) == (360, 2)
    assert len(answer["thinning"]["not_seen"]) == 3
    page = document_html(found_report(job, journal, finding, "now"))
    assert "every 2 of them were averaged" in page
    assert "effects hidden by this reduction may still be present" in page


def test_a_short_campaign_says_nothing_of_it(tmp_path: Path) -> None:
    job = prepare(from_folder(write_case(tmp_path / "c1")), catalogue())
    finding = discover(job, DiscoveryJournal(), Search("none"), ignore_progress)
    assert job.thinning is None
    assert "thinning" not in answer_doc(finding)
    assert not any("readings are too many to search" in line for line in job.flags)
