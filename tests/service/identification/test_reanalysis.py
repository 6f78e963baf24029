"""Campaigns solved anew give the same numbers wherever they are computed: the same document, to the last digit."""

from __future__ import annotations

import json
import os

import pytest

from abbe.service.cli import run
from abbe.service.errors import ConfigError
from abbe.service.identification.reanalysis import (
    DaskExecutor,
    Executor,
    ProcessExecutor,
    ReanalysisResult,
    SerialExecutor,
    solve_all,
    tasks_of,
)
from abbe.service.storage.store import Store
from tests.conftest import Require
from tests.many_campaigns import dask_cluster, fill

SEEDS = (7, 8)
LONG = os.environ.get("ABBE_TEST_LONG") == "1"


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Two campaigns that can be solved, and one that cannot."""
    place = tmp_path_factory.mktemp("many")
    found = f"sqlite:///{place / 'abbe.sqlite3'}"
    with Store.open(found) as store:
        fill(store, place, SEEDS, every=1 if LONG else 8)
        store.campaigns.add(1, "june-empty", {})
    return found


def answers(url: str, executor: Executor) -> list[ReanalysisResult]:
    with Store.open(url) as store:
        return list(solve_all(tasks_of(store, url, "june-*", "rigid6"), executor))


@pytest.fixture(scope="module")
def here(url: str) -> list[ReanalysisResult]:
    return answers(url, SerialExecutor())


def text(found: list[ReanalysisResult]) -> str:
    return json.dumps([one.doc for one in found])


def test_each_is_solved_as_abbe_solve_does_and_one_that_cannot_be_stops_no_other(
    url: str, here: list[ReanalysisResult], capsys: pytest.CaptureFixture[str]
) -> None:
    assert [one.campaign for one in here] == ["june-7", "june-8", "june-empty"]
    assert here[2].doc is None
    assert here[2].refused.startswith("SOL-001: no run of this campaign has the role identify")
    assert run(["solve", "june-7", "--model", "rigid6", "--db", url, "--json"]) == 0
    doc = json.loads(capsys.readouterr().out)
    assert here[0].doc is not None
    assert {key: doc[key] for key in here[0].doc} == json.loads(json.dumps(here[0].doc))


@pytest.mark.skipif(not LONG, reason="beside Dask, which starts processes too: ABBE_TEST_LONG=1 runs it")
def test_processes_give_the_same_numbers(url: str, here: list[ReanalysisResult]) -> None:
    assert text(answers(url, ProcessExecutor(2))) == text(here)


def test_dask_gives_the_same_numbers(url: str, here: list[ReanalysisResult], require: Require) -> None:
    try:
        import distributed
    except ModuleNotFoundError:
        require("dask", False, "distributed is not installed (pip install 'abbe[fleet]')")
        return
    with dask_cluster(2 if LONG else 1) as address:  # each worker is a process that imports all of Abbe
        assert text(answers(url, DaskExecutor(address))) == text(here), distributed.__version__


def test_the_command(url: str, capsys: pytest.CaptureFixture[str], here: list[ReanalysisResult]) -> None:
    assert run(["solve-all", "june-*", "--model", "rigid6", "--db", url]) == 1  # one was refused
    out = capsys.readouterr().out
    assert [word in out for word in ("june-7", "june-8", "june-empty", "refused")] == [True] * 4
    with Store.open(url) as store:
        before = len(store.solutions.all())
    assert run(["solve-all", "june-8", "--model", "rigid6", "--db", url, "--keep", "--json"]) == 0
    (doc,) = json.loads(capsys.readouterr().out)
    with Store.open(url) as store:
        assert len(store.solutions.all()) == before + 1
        assert store.solutions.get(doc["solution_id"]).doc["parameters"] == doc["parameters"]
        assert store.audit.events(1)[0].action == "abbe solve-all"


def test_bad_input_is_one_line(url: str, capsys: pytest.CaptureFixture[str]) -> None:
    for words, told in (
        (["solve-all", "july-*", "--db", url], "error STO-002: no campaign matches 'july-*'"),
        (
            ["solve-all", "--workers", "2", "--dask", "tcp://127.0.0.1:1", "--db", url],
            "error CFG-001: --workers and --dask exclude",
        ),
    ):
        assert run(words) == 2
        err = capsys.readouterr().err
        assert err.startswith(told)
        assert err.count("\n") == 1
    with pytest.raises(ConfigError, match=r"Dask is not installed|no Dask scheduler answers"):
        DaskExecutor("nonsense://")
