"""A rollback at a real (simulated) control from the command line: it asks, says what to do next, and what it says ends the state."""

from __future__ import annotations

import asyncio
import json
import re

import pytest

from abbe.service.cli import run
from abbe.service.core.table_watch import look_at_table
from abbe.service.storage.store import Store
from tests.scenarios.test_push import bench, push, steep

pytestmark = [pytest.mark.scenario, pytest.mark.timeout(300)]
QUICK = ("--recipe", "quick-check", "--rate-hz", "20")


def fleet(url, capsys):
    assert run(["fleet", "--db", url, "--json"]) == 0
    (line,) = json.loads(capsys.readouterr().out)["machines"]
    return line


def test_a_rollback_asks_and_the_machine_is_unverified_until_it_is_measured(start_sims, tmp_path, capsys):
    sims = start_sims("--speed", "80")
    url, file = f"sqlite:///{sims.machine_file.parent / 'abbe.sqlite3'}", str(sims.machine_file)

    async def kept():
        async with bench(sims, sims.machine_file.parent) as (site, store, session):
            assert (await push(session.controller, store, site, steep(site))).kept

    asyncio.run(kept())
    assert fleet(url, capsys)["verdict"] == "verified"
    assert run(["measure", "-m", file, *QUICK, "--name", "first"]) == 0
    said = capsys.readouterr()
    assert re.search(r"^check 1: (pass|fail|cannot tell): ", said.out, re.MULTILINE)
    assert said.err.splitlines()[-1] == f"next: abbe report first -m {file}"
    first = fleet(url, capsys)
    assert first["verified"]["why"] == "check"
    assert first["figures"]

    with Store.open(url) as store:
        before = len(store.pushes.entries("sim"))
    assert run(["comp", "rollback", "-m", file]) == 2  # nobody is at the console
    assert "add --yes" in capsys.readouterr().err
    with Store.open(url) as store:
        assert len(store.pushes.entries("sim")) == before
    assert run(["comp", "rollback", "-m", file, "--yes"]) == 0
    said = capsys.readouterr()
    assert said.out.splitlines()[-1] == f"the machine is unverified now: abbe measure -m {file} --recipe quick-check"
    assert said.err.splitlines()[-1] == f"next: abbe measure -m {file} --recipe quick-check"
    line = fleet(url, capsys)
    assert (line["verdict"], line["verified"]["why"], line["figures"]) == ("unverified", "rollback", [])
    target = tmp_path / "first.json"
    assert run(["report", "first", "--machine", file, "--out", str(target)]) == 0
    assert "Unverified now. Unverified since the rollback of" in capsys.readouterr().out

    assert run(["measure", "-m", file, *QUICK, "--name", "second"]) == 0
    capsys.readouterr()
    assert fleet(url, capsys)["verified"]["why"] == "check"
    assert run(["report", "second", "--machine", file, "--out", str(target)]) == 0
    assert "nverified" not in capsys.readouterr().out


def test_the_check_of_an_accepted_table_is_its_check_and_an_ended_certificate_marks_it(start_sims, tmp_path, capsys):
    sims = start_sims("--speed", "100")
    folder = sims.machine_file.parent
    url, file = f"sqlite:///{folder / 'abbe.sqlite3'}", str(sims.machine_file)
    (tmp_path / "another").mkdir()

    async def kept():
        async with bench(sims, tmp_path / "another") as (site, store, session):  # pushed from another database
            assert (await push(session.controller, store, site, steep(site))).kept
            with Store.open(url) as ours:
                assert (await look_at_table(site, ours)()).strange

    asyncio.run(kept())
    good = sims.machine_file.read_text()
    sims.machine_file.write_text(good.replace("ballbar = 2099-12-31", "ballbar = 2020-03-31"))
    assert run(["measure", "-m", file, *QUICK]) == 2
    assert "a table that this database did not push" in capsys.readouterr().err
    assert run(["measure", "-m", file, *QUICK, "--accept-table"]) == 0
    out = capsys.readouterr().out
    assert "check 1: cannot tell: the certificate of the ball-bar ended on 2020-03-31, so the figures cannot be judged; " in out
    line = fleet(url, capsys)
    assert (line["verified"]["why"], line["verified"]["number"], line["verdict"]) == ("check", 1, "cannot tell")
    with Store.open(url) as store:
        (check,) = store.verifications.of_machine("sim", 5)
        assert check.doc["comparable"] is False
