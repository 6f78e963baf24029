"""A machine with a history: checks, a campaign that was solved, records of the audit, a run whose process was killed."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from abbe.service.audit.book import AuditBook
from abbe.service.capture.ingest import chunk_of
from abbe.service.capture.segment import CHUNK, scan
from abbe.service.capture.settings import segment_path
from abbe.service.domain.schedule import Schedule
from abbe.service.domain.service_records import AuditEvent
from abbe.service.storage.store import Store
from abbe.service.verification import verify
from tests.service.capture.capture_bench import abandon, batch, new_run, segment_bytes
from tests.service.core.fakes import Result

FILE = """
name = "VMC-1"
chain = "w-X-Y-b-Z-t"
[stroke_mm]
X = [0.0, 600.0]
Y = [0.0, 500.0]
Z = [0.0, 450.0]
[store]
url = "sqlite:///abbe.sqlite3"
"""
START = datetime(2026, 9, 1, 5, tzinfo=UTC)
SAMPLES = 300


@dataclass(frozen=True)
class Shop:
    """A folder with machine file and database."""

    folder: Path
    run_id: int

    @property
    def machine(self) -> Path:
        return self.folder / "machine.toml"

    @property
    def database(self) -> Path:
        return self.folder / "abbe.sqlite3"

    @property
    def url(self) -> str:
        return f"sqlite:///{self.database}"


def new_machine_file(folder: Path) -> Path:
    folder.mkdir(exist_ok=True)
    (folder / "machine.toml").write_text(FILE)
    return folder / "machine.toml"


@pytest.fixture
def shop(master: Shop, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Shop:
    """A copy of the shop for each test: nobody has it open, so that its files may be copied."""
    monkeypatch.delenv("ABBE_AUDIT_FOLDER", raising=False)
    return Shop(shutil.copytree(master.folder, tmp_path / "shop"), master.run_id)


@pytest.fixture(scope="session")
def master(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Shop]:
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("ABBE_AUDIT_FOLDER", raising=False)
        yield _shop(tmp_path_factory.mktemp("master") / "shop")


def _shop(folder: Path) -> Shop:
    new_machine_file(folder)
    url = f"sqlite:///{folder / 'abbe.sqlite3'}"
    rng = np.random.default_rng(7)
    with Store.open(url) as store:
        machine_id = store.machines.add("VMC-1", {})
        schedule = Schedule("daily", "0 5 * * *", "UTC", "quick-check")
        for day in range(40):
            at = START + timedelta(days=day)
            values = {"body_diagonal_um": 9.0 + 0.3 * max(day - 20, 0) + 0.5 * rng.normal()}
            result = Result(values=values, uncertainties={"body_diagonal_um": 1.0}, limits={"body_diagonal_um": 20.0}, started_utc=at)
            store.verifications.add_with_messages(machine_id, verify.check_doc(verify.Occasion("VMC-1", schedule, at), result), [])
        book = AuditBook(store, url)
        for k in range(5):
            book.write(AuditEvent(who="user:ana", action=f"POST /thing/{k}", target="x", outcome="done 200", doc={"n": k, "why": "µm"}))
        run_id = new_run(store)
        whole = segment_bytes(run_id, [[batch(first, 25)] for first in range(0, SAMPLES, 25)])
        store.chunks.ingest([chunk_of(one) for one in scan(whole).records if one.kind == CHUNK][:4])
        abandon(store, run_id)
    capture = folder / "abbe.sqlite3-capture"
    capture.mkdir()
    segment_path(capture, run_id).write_bytes(whole)
    return Shop(folder, run_id)
