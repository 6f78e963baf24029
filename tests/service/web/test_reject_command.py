"""`abbe comp reject`: for good, with a reason, and told."""

from __future__ import annotations

import pytest

from abbe.service.cli import run
from abbe.service.clock import SystemClock
from tests.service.web.api_bench import Plant


def test_a_rejected_proposal_stays_one(plant: Plant, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(SystemClock, "utc", lambda _: plant.clock.utc())  # its measurement is not too old yet
    row = plant.store.proposals.get(plant.approvable[0])
    number = str(plant.store.proposals.add(row.machine, row.solution_id, row.doc, row.digest))
    at = ["--db", plant.url]
    assert run(["comp", "reject", number, "--reason", " ", *at]) == 1
    assert "without a reason" in capsys.readouterr().out
    assert run(["comp", "reject", number, "--reason", "too warm", "--as", "kim", *at]) == 0
    assert capsys.readouterr().out.strip() == f"proposal {number} is rejected by kim: too warm"
    assert run(["comp", "approve", number, *at]) == 1
    assert "is rejected: by kim: too warm" in capsys.readouterr().out
    assert run(["comp", "reject", number, "--reason", "again", *at]) == 1
    capsys.readouterr()
    assert run(["comp", "show", number, *at]) == 0
    assert f"proposal {number}: rejected: by kim: too warm" in capsys.readouterr().out
