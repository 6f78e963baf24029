"""Campaigns solved anew give the same numbers wherever they are computed: the same document, to the last digit."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from service.cli import run
from service.errors import ConfigError
from service.runs.exchange import import_folder
from service.storage.store import Store
from service.workflows.executors import Dask, Executor, Here, Processes
from service.workflows.reanalysis import Answer, solve_all, tasks_of
from tests.conftest import Require
from tests.scenarios.campaign_files import measured, write_folder

SEEDS = (7, 8)


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Two campaigns that can be solved, and one that cannot."""
    place = tmp_path_factory.mktemp("many")
    found = f"sqlite:///{place / 'abbe.sqlite3'}"
    with Store.open(found) as store:
        for seed in SEEDS:
            site, runs = measured(seed, "one_tool")
            name = f"june-{seed}"
            folder = write_folder(place / name, site.doc, [one | {"campaign": name} for one in runs])
            head = json.loads((folder / "campaign.json").read_text()) | {"campaign": name}
            (folder / "campaign.json").write_text(json.dumps(head))
            import_folder(store, folder)
        store.add_campaign(1, "june-empty", {})
    return found


def answers(url: str, executor: Executor) -> list[Answer]:
    with Store.open(url) as store:
        return list(solve_all(tasks_of(store, url, "june-*", "rigid6"), executor))


@pytest.fixture(scope="module")
def here(url: str) -> list[Answer]:
    return answers(url, Here())


def text(found: list[Answer]) -> str:
    return json.dumps([one.doc for one in found])


def test_each_is_solved_as_abbe_solve_does_and_one_that_cannot_be_stops_no_other(
    url: str, here: list[Answer], capsys: pytest.CaptureFixture[str]
) -> None:
    assert [one.campaign for one in here] == ["june-7", "june-8", "june-empty"]
    assert here[2].doc is None
    assert here[2].refused.startswith("SOL-001: no run of this campaign has the role identify")
    assert run(["solve", "june-7", "--model", "rigid6", "--db", url, "--json"]) == 0
    doc = json.loads(capsys.readouterr().out)
    assert here[0].doc is not None
    assert {key: doc[key] for key in here[0].doc} == json.loads(json.dumps(here[0].doc))


def test_processes_give_the_same_numbers(url: str, here: list[Answer]) -> None:
    assert text(answers(url, Processes(2))) == text(here)


def test_dask_gives_the_same_numbers(url: str, here: list[Answer], require: Require) -> None:
    try:
        import distributed
    except ModuleNotFoundError:
        require("dask", False, "distributed is not installed (pip install 'abbe[fleet]')")
        return
    with ExitStack() as stack:
        address = _cluster(stack)
        assert text(answers(url, Dask(address))) == text(here), distributed.__version__


def _cluster(stack: ExitStack) -> str:
    """A scheduler and two workers, each a real process of one thread."""
    quiet: dict[str, Any] = {"stderr": subprocess.PIPE, "text": True, "env": {**os.environ, "PYTHONPATH": str(Path(__file__).parents[3])}}
    quiet["env"]["PYTHONPATH"] += os.pathsep + os.environ.get("PYTHONPATH", "")
    words = ["--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--protocol", "tcp"]
    scheduler = subprocess.Popen([sys.executable, "-m", "distributed.cli.dask_scheduler", *words], **quiet)
    stack.callback(_end, scheduler)
    assert scheduler.stderr is not None
    line = next(one for one in scheduler.stderr if "Scheduler at:" in one)
    address = line.split("Scheduler at:")[1].strip()
    for _ in range(2):
        worker = [sys.executable, "-m", "distributed.cli.dask_worker", address, "--nthreads", "1", "--no-nanny", "--no-dashboard"]
        stack.callback(_end, subprocess.Popen([*worker, "--host", "127.0.0.1"], **quiet))
    return address


def _end(child: subprocess.Popen[str]) -> None:
    child.terminate()
    child.communicate()


def test_the_command(url: str, capsys: pytest.CaptureFixture[str], here: list[Answer]) -> None:
    assert run(["solve-all", "june-*", "--model", "rigid6", "--store", url]) == 1  # one was refused
    out = capsys.readouterr().out
    assert [word in out for word in ("june-7", "june-8", "june-empty", "refused")] == [True] * 4
    with Store.open(url) as store:
        before = len(store.solutions())
    assert run(["solve-all", "june-8", "--model", "rigid6", "--store", url, "--keep", "--json"]) == 0
    (doc,) = json.loads(capsys.readouterr().out)
    with Store.open(url) as store:
        assert len(store.solutions()) == before + 1
        assert store.solution(doc["solution_id"]).doc["parameters"] == doc["parameters"]
        assert store.audit(1)[0].action == "abbe solve-all"


def test_bad_input_is_one_line(url: str, capsys: pytest.CaptureFixture[str]) -> None:
    for words, told in (
        (["solve-all", "july-*", "--store", url], "error STO-001: no campaign matches 'july-*'"),
        (["solve-all", "--workers", "2", "--dask", "tcp://127.0.0.1:1", "--store", url], "error CFG-001: --workers and --dask both say"),
    ):
        assert run(words) == 2
        err = capsys.readouterr().err
        assert err.startswith(told)
        assert err.count("\n") == 1
    with pytest.raises(ConfigError, match=r"Dask is not installed|no Dask scheduler answers"):
        Dask("nonsense://")
