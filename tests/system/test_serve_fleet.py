"""Two real services, each with a simulated machine of its own, check at the same moment into one database."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable
from contextlib import ExitStack, closing
from pathlib import Path

import pytest

from abbe.service.cli import run
from abbe.service.storage.store import Store
from tests.system.serve_bench import Machine, Process

pytestmark = [
    pytest.mark.scenario,
    pytest.mark.timeout(240),
    pytest.mark.skipif(not os.environ.get("ABBE_TEST_LONG"), reason="two services and two machines: ABBE_TEST_LONG=1 runs it"),
]
NAMES = ("mill-7", "mill-8")
BOTH = ["postgresql", "sqlite"] if os.environ.get("ABBE_TEST_LONG") else ["postgresql"]


@pytest.fixture(params=BOTH)
def url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    if request.param == "sqlite":
        return f"sqlite:///{tmp_path / 'fleet.sqlite3'}"
    make: Callable[[], str] = request.getfixturevalue("postgres")
    return make()


def test_two_services_check_at_once_into_one_database(
    url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("ABBE_AUDIT_FOLDER", str(tmp_path / "audit"))
    (tmp_path / "audit").mkdir()
    with ExitStack() as stack:
        files = [_machine(tmp_path, name, url, stack) for name in NAMES]
        Store.open(url).close()
        services = [
            stack.enter_context(
                closing(
                    Process(sys.executable, "-c", "from abbe.service.cli import main; main()", "serve", "-m", f, "--once", "--port", "0")
                )
            )
            for f in files
        ]
        assert [service.wait() for service in services] == [1, 1]  # the simulated machines are out of limits
    with Store.open(url) as store:
        for name in NAMES:
            (check,) = store.verifications.of_machine(name)
            assert (check.verdict, check.doc["machine"], check.doc["cause"]) == ("fail", name, None)
            campaign = store.campaigns.find(check.doc["campaign"])
            assert (campaign.id, store.machines.get(campaign.machine_id).name) == (check.campaign_id, name)
            assert [r.label for r in store.runs.all(campaign.id)] == check.doc["runs"]
            assert {r.visible_status for r in store.runs.all(campaign.id)} == {"complete"}
        assert [one.outcome for one in store.audit.events()].count("begun") == 2
    assert run(["audit", "verify", "--db", url]) == 0
    capsys.readouterr()
    assert run(["fleet", "--db", url, "--json"]) == 0
    lines = json.loads(capsys.readouterr().out)["machines"]
    assert [(one["machine"], one["state"], one["verdict"]) for one in lines] == [(name, "not running", "fail") for name in NAMES]
    assert {f["name"] for one in lines for f in one["figures"]} == {"body_diagonal_um", "helix_rms_um"}
    assert all(f["expanded_uncertainty"] > 0 for one in lines for f in one["figures"])


def _machine(folder: Path, name: str, url: str, stack: ExitStack) -> Path:
    place = folder / name
    place.mkdir()
    store = ["[store]", f"url = {json.dumps(url)}", f"capture = {json.dumps(str(place / 'capture'))}"]
    machine = Machine(place, 60.0, *store, "[[schedule]]", 'name = "often"', 'cron = "0 6 * * 1"', 'recipe = "quick-check"')
    stack.callback(machine.process.close)
    machine.file.write_text(machine.file.read_text().replace('name = "mill-7"', f'name = "{name}"'))
    return machine.file
