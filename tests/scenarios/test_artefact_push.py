"""A plate's campaign through the command line, on the simulated controller: tables pushed and verified by another pose, measured anew.

`abbe measure` probes, `comp propose` makes the tables, `comp push --check` writes them, reads them back, measures the checking pose again
and keeps them; tables whose signs are turned it takes back, with the reason in the journal and exit code 1.
"""

from __future__ import annotations

import asyncio
import json
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
import pytest

from abbe.drivers.registry import open_controller
from abbe.models.arrays import F2
from abbe.service.cli import run
from abbe.service.compensation import proposals
from abbe.service.compensation.proposal_doc import load
from abbe.service.config import load_machine
from abbe.service.domain.artefact import ArtefactObject
from abbe.service.runs.columns import load_run
from abbe.service.sequences.control import Watching
from abbe.service.sequences.recipes.artefact import ArtefactTest
from abbe.service.sequences.recipes.recipe_file import recipe_text
from abbe.service.site import site_of
from abbe.service.storage.store import Store
from abbe.service.tables.nine_tables import tables_from_image
from tests.faults.sequencer_world import PATIENT
from tests.pretended import as_if_commissioned_at
from tests.scenarios.conftest import Sims, simulated

pytestmark = [
    pytest.mark.scenario,
    pytest.mark.timeout(900),
    pytest.mark.skipif(os.environ.get("ABBE_TEST_LONG") != "1", reason="takes minutes: long run"),
]
SCENARIO = """
seed = 1
boot_id = 20260601
"""
LIMITS = """[limits]
table_value_um = 200
table_change_um = 200
table_beyond_percent = 100
"""
QUICK = {"feed_mm_min": 6000.0, "touch_feed_mm_min": 200.0, "requalify_every": 100, "turned_every": 0}
POSES = (((60.0, 60.0), 0.0), ((540.0, 70.0), 90.0), ((148.2, 180.0), 0.0), ((330.0, 200.0), 90.0))
CHECK = (((500.0, 420.0), 180.0),)


@dataclass
class Shop:
    """A machine whose plate was measured in four poses, and once more in another one."""

    sims: Sims
    url: str

    @property
    def file(self) -> str:
        return str(self.sims.machine_file)

    @property
    def check(self) -> str:
        return str(self.sims.machine_file.with_name("check.toml"))

    def propose(self, capsys: pytest.CaptureFixture[str]) -> int:
        """Number of a proposal with no reason against it."""
        capsys.readouterr()
        code = run(["comp", "propose", "-m", self.file, "plate", "--json"])
        said = capsys.readouterr()
        assert code == 0, said.err + said.out
        return int(json.loads(said.out)["number"])

    def in_force(self) -> tuple[int, bytes]:
        """CRC and content of the active bank, read by another connection."""

        async def read() -> tuple[int, bytes]:
            controller = await open_controller(self.sims.ready["cnc"])
            try:
                now = await controller.comp_status()
                return now.bank_crc[now.active_bank], await controller.read_bank(now.active_bank)
            finally:
                await controller.close()

        return asyncio.run(read())


def recipe(name: str, poses, plate: ArtefactObject) -> str:
    tests = [
        ArtefactTest(f"{name}-{k}", f"{name}-{k}", "identify", "plate", (*at, 200.0), rotation_deg=(0.0, 0.0, turn), plate=plate, **QUICK)
        for k, (at, turn) in enumerate(poses, start=1)
    ]
    return recipe_text(name, tuple(tests))


@pytest.fixture(scope="module", autouse=True)
def patient() -> Iterator[None]:
    """A simulated controller that waits for a core is not silent."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("abbe.service.site.Watching", partial(Watching, unknown_s=PATIENT.unknown_s))
        yield


@pytest.fixture(scope="module")
def shop(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Shop]:
    folder = tmp_path_factory.mktemp("artefact")
    (folder / "scenario.toml").write_text(SCENARIO)
    with simulated(folder, str(folder / "scenario.toml"), "--speed", "100", extra=LIMITS) as sims:
        text = sims.machine_file.read_text()
        assert text.count("\nlaser = ") == 2, "the device and its certificate"
        text = re.sub(r"\n(laser|ballbar) = .*", "", text)  # a shop with a probe only
        sims.machine_file.write_text(
            text.replace("[calibration]", "[calibration]\nartefact = 2099-12-31\nroom = 2099-12-31\nroom_temperature_c = [20.5, 21.5]")
        )
        plate = ArtefactObject.read(sims.ready["artefact"])
        (folder / "plate.toml").write_text(recipe("plate", POSES, plate))
        (folder / "check.toml").write_text(recipe("check", CHECK, plate))
        loaded = load_machine(sims.machine_file)
        with Store.open(loaded.database_url) as store:
            asyncio.run(as_if_commissioned_at(sims.ready["cnc"], store, site_of(loaded.machine)))
        assert run(["measure", "--recipe", str(folder / "plate.toml"), "--name", "plate", "-m", str(sims.machine_file)]) == 0
        yield Shop(sims, loaded.database_url)


def turned(deviation_mm: F2, expanded_mm: F2, words: str) -> tuple[F2, F2, str]:
    """A mistake that every check of the proposal shares: only the machine itself can show it."""
    return -deviation_mm, expanded_mm, words


def test_tables_with_turned_signs_are_taken_back_and_the_journal_says_why(shop, capsys, monkeypatch):
    right = proposals.deviation_of_artefacts
    monkeypatch.setattr(proposals, "deviation_of_artefacts", lambda *words: turned(*right(*words)))
    number, before = shop.propose(capsys), shop.in_force()
    code = run(["comp", "push", str(number), "--check", shop.check, "-m", shop.file, "--json"])
    said = capsys.readouterr()
    assert code == 1, said.err
    told = json.loads(said.out)
    assert told["kept"] is False
    assert "worst pose" in told["text"]
    assert "no improvement beyond its uncertainty" in told["text"]
    assert shop.in_force() == before
    with Store.open(shop.url) as store:
        entries = [e for e in store.pushes.entries("sim") if e.push == told["push"]]
        states = [str(e.state) for e in entries]
        assert states[-1] == "ROLLED_BACK"
        assert "PROBED" in states
        assert "VERIFIED" not in states
        assert next(e.doc["why"] for e in entries if e.state == "ROLLBACK") == f"verify: {told['text']}"
        assert [v.verdict for v in store.verifications.latest()] == ["fail"]


def test_tables_of_a_plate_are_pushed_read_back_and_kept_by_a_pose_that_is_measured_anew(shop, capsys):
    number = shop.propose(capsys)
    code = run(["comp", "push", str(number), "--check", shop.check, "-m", shop.file, "--json"])
    said = capsys.readouterr()
    assert code == 0, said.err + said.out
    told = json.loads(said.out)
    assert told["kept"] is True
    crc, image = shop.in_force()
    with Store.open(shop.url) as store:
        wanted = load(store, number).tables
        states = [str(e.state) for e in store.pushes.entries("sim") if e.push == told["push"]]
        records = store.runs.all()[-2:]
        before, after = [load_run(store, r.id) for r in records]
        verdict = store.verifications.latest(limit=1)[0]
    assert states[-2:] == ["VERIFIED", "KEEP"]
    there = tables_from_image(image)
    for a in range(3):
        assert np.abs(there.correction_mm[a] - wanted.correction_mm[a]).max() < 1e-6, "read back by another connection"
    assert [(r.role, r.setup.artefact, r.table.crc == crc) for r in (before, after)] == [("holdout", "plate", n) for n in (False, True)]
    assert str(records[0].ended_utc) < records[1].started_utc
    worst = verdict.doc["figures"]["worst_pose_um"]
    assert (verdict.verdict, 0.0 < worst["u"] < worst["value"] < 3.0) == ("pass", True)
