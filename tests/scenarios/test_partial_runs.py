"""A run that was stopped is not judged: no rms, no verdict, in reports, on the screens, in comparisons, in `abbe show`.

Before, 313 of 6970 samples of a helix, a quarter of a turn, gave "helix rms 0.60 ± 0.21 µm", and "nothing was found that this measurement
should have shown and could not".
"""

from __future__ import annotations

import json
import re
import signal

import pytest

from abbe.service.cli import run as cli
from abbe.service.domain.machine import Rules
from abbe.service.report.report import stored_report
from abbe.service.runs.columns import load_run
from abbe.service.runs.coverage import covered_share, not_judged
from abbe.service.storage.store import Store
from abbe.service.web.pages.runs import run_screen
from tests.scenarios.world import bar_chunks, interrupt, wait_for

pytestmark = [pytest.mark.scenario, pytest.mark.timeout(240)]
WHY = r"stopped: \d+\.\d % of the path; not judged"


def test_a_stopped_helix_gives_no_figure_until_the_rest_of_it_is_measured(abbe, start_sims, capsys):
    sims = start_sims("--speed", "10")
    words = ("measure", "-m", str(sims.machine_file), "--helix", "300,250,100,60", "--name", "june")
    process = abbe(*words)
    wait_for(lambda: bar_chunks(sims.machine_file.parent) > 3, 60, "samples of the helix")
    _, err = interrupt(process, signal.SIGINT)
    assert process.returncode == 130, err
    with Store.open(f"sqlite:///{sims.machine_file.parent / 'abbe.sqlite3'}") as store:
        (record,) = store.runs.all()
        run = load_run(store, record.id)
        assert re.fullmatch(WHY, not_judged(run))
        assert 0.0 < covered_share(run) < 0.9
        document = stored_report(store, record, Rules())
        assert document.verdict[:2] == ("open", "Not judged")
        assert re.match(WHY, document.verdict[2])
        assert [f.symbol for f in document.figures] == ["n"]
        assert any(re.search(WHY, line) for line in document.not_observable)
        screen = run_screen(store, record, Rules())
        assert [f.symbol for f in screen.document.figures] == ["n"]
        assert any(re.search(WHY, line) for line in screen.document.not_observable)
        campaign = stored_report(store, store.campaigns.find("june"), Rules())
        assert any(re.match("run helix is stopped; the figures do not use it", line) for line in campaign.remarks)
    cli(["show", "helix", "--machine", str(sims.machine_file)])
    assert re.search(WHY, " ".join(capsys.readouterr().out.split()))

    assert cli(["measure", "-m", str(sims.machine_file), "--resume", "june", "--untouched"]) == 0
    with Store.open(f"sqlite:///{sims.machine_file.parent / 'abbe.sqlite3'}") as store:
        whole = next(r for r in store.runs.all() if r.status == "complete")
        run = load_run(store, whole.id)
        assert not_judged(run) == ""
        assert run.state is None
        assert "helix rms" in [f.symbol for f in stored_report(store, whole, Rules()).figures]
        campaign = stored_report(store, store.campaigns.find("june"), Rules())
        pieces = run.timing.pieces
        said = "continued it and contains its readings" if pieces else "the figures do not use it"
        assert any(said in line for line in campaign.remarks)
    capsys.readouterr()
    cli(["show", "june/helix", "--machine", str(sims.machine_file), "--json"])
    assert json.loads(capsys.readouterr().out)["state"]["status"] == "stopped"
