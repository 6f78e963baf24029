"""Machines, campaigns and runs as the read model answers them; page, HTTP and command line show these records."""

from __future__ import annotations

import json
from dataclasses import fields

import pytest

from abbe.service.domain.measured import RunFacts
from abbe.service.errors import NotStored
from abbe.service.queries.measured import RunDetail, RunSummary, all_runs, campaign, campaigns, machines, run, runs, runs_by_state
from abbe.service.queries.reader import Reader, json_value
from abbe.service.storage.tables import runs as run_table
from tests.service.web.api_bench import Plant


def test_every_page_of_runs_follows_the_one_before(reader: Reader) -> None:
    seen: list[int] = []
    cursor: int | None = None
    while True:
        part, cursor = runs(reader, {}, cursor, 3)
        seen += [one.number for one in part]
        if cursor is None:
            break
        assert len(part) == 3
    assert seen == [one.number for one in reversed(all_runs(reader.store))]


def test_filters_are_exact_and_together(reader: Reader) -> None:
    assert [one.run_id for one in runs(reader, {"campaign": "c2", "role": "identify"}, None, 9)[0]] == ["r03", "r02", "r01"]
    assert [one.reason for one in runs(reader, {"status": "failed", "test": "laser_linear"}, None, 9)[0]] == ["SEQ-003 beam"]
    for name in ("C2", "c2' OR '1'='1", "%", "c\0", ""):
        assert runs(reader, {"campaign": name}, None, 9) == ([], None)


def test_a_list_of_a_state_says_whether_there_are_more(reader: Reader) -> None:
    assert [one.run_id for one in runs_by_state(reader, "c2", "", "aborted", 5)[0]] == ["r02"]
    assert runs_by_state(reader, "c2", "", "", 2)[1]
    assert runs_by_state(reader, "", "", "running", 5) == ([], False)


def test_a_run_has_its_channels_and_says_what_it_lacks(reader: Reader, plant: Plant) -> None:
    found = run(reader, plant.store.runs.find("c2/r01").id)
    assert isinstance(found, RunDetail)
    assert [(one.channel, one.codec, one.chunks) for one in found.channels] == [("bar", "bar/1", 11)]
    assert (found.gaps, found.reason) == (1, "1 gaps, 2 samples missing")
    assert [one.reason for one in all_runs(reader.store, "c2") if one.run_id == "r01"] == [found.reason]
    with pytest.raises(NotStored, match="there is no run 999"):
        run(reader, 999)


def test_a_column_of_a_run_is_in_every_list_without_another_word() -> None:
    """It stands in the table and in `RunFacts`; the records of the read model take it from there by its name."""
    own = {one.name for one in fields(RunFacts)} - {"campaign"}
    assert own <= {column.name for column in run_table.c}
    assert own < {one.name for one in fields(RunSummary)} < {one.name for one in fields(RunDetail)}


def test_campaigns_and_machines(reader: Reader) -> None:
    assert [one.name for one in campaigns(reader, "VMC-1", None, 9)[0]] == ["c2", "c1"]
    found = campaign(reader, 1)
    assert ([one.run_id for one in found.runs], found.discoveries) == (["r01", "r02", "r03", "r04"], [1])
    odd, ours = machines(reader, None, None, 9)[0]
    assert (odd.name, odd.description) == ("other mill", None)
    assert ours.description is not None


def test_a_record_is_json_as_it_is(reader: Reader) -> None:
    found = runs(reader, {}, None, 1)[0][0]
    assert json.loads(json.dumps(json_value(found)))["run_id"] == found.run_id
