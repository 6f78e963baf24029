"""The workflows around a recording: the push before the segments, and one way for every run to be closed."""

from __future__ import annotations

import threading
from pathlib import Path
from types import SimpleNamespace

import pytest

from abbe.service.campaigns import listen as listen_module
from abbe.service.capture import ingest as ingest_module
from abbe.service.capture import recorder as recorder_module
from abbe.service.capture.settings import CaptureSettings, segment_path
from abbe.service.compensation import recover as recover_module
from abbe.service.errors import CaptureFault, StoreError
from abbe.service.storage.store import Store
from tests.patience import within
from tests.service.capture.capture_bench import batch
from tests.service.capture.test_recovery import crashed

SITE = SimpleNamespace(name="VMC-1", doc={"name": "VMC-1"}, capture=CaptureSettings(reserve_bytes=65536), machine=None, max_feed_mm_min=1.0)


@pytest.fixture
def store(tmp_path: Path):
    with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as opened:
        yield opened


async def test_the_push_is_taken_back_before_a_segment_is_looked_at(store: Store, monkeypatch) -> None:
    done: list[str] = []

    async def pushed(*words: object, **more: object) -> str:
        done.append("push")
        return "the old table was made active again"

    def refuse(*words: object) -> None:
        done.append("segments")
        raise CaptureFault("the folder cannot be used")

    monkeypatch.setattr(recover_module, "finish_push", pushed)
    with monkeypatch.context() as patched:
        patched.setattr(recover_module, "recover_segments", refuse)
        with pytest.raises(CaptureFault):
            await recover_module.recover(None, store, SITE)  # type: ignore[arg-type]
    assert done == ["push", "segments"]
    folder = Path(f"{store.url.removeprefix('sqlite:///')}-capture")
    folder.mkdir()  # noqa: ASYNC240 - a test
    crashed(store, folder)
    (folder / "notes.seg").write_bytes(b"of a stranger")
    said = await recover_module.recover(None, store, SITE)  # type: ignore[arg-type]
    assert said is not None
    assert [words in said for words in ("active again", "run c1/r01: interrupted", "notes.seg was not taken over")] == [True] * 3


async def test_a_listened_run_whose_samples_the_database_lacks_stays_open(store: Store, monkeypatch) -> None:
    go = threading.Event()
    monkeypatch.setattr(recorder_module, "CATCH_UP_S", 0.1)
    monkeypatch.setattr(ingest_module, "END_S", 0.1)
    monkeypatch.setattr(ingest_module.Ingest, "_give", lambda self, records: go.wait(within(20)))

    async def begin(*words: object) -> tuple[int, int]:
        return store.campaigns.add(store.machines.add("VMC-1", {}), "c", {}), 0

    async def document(*words: object) -> dict[str, object]:
        return {}

    async def listening(session: object, recorder: recorder_module.CaptureRecorder, *words: object) -> dict[str, object]:
        recorder.tap().take(batch(0, 50))
        return {"mounted_us": 0}

    for name, value in {"start_campaign": begin, "start_document": document, "listen_to": listening}.items():
        monkeypatch.setattr(listen_module, name, value)
    for name in ("dry_run_campaign", "planned_readings"):
        monkeypatch.setattr(listen_module, name, lambda *words: None)
    test = SimpleNamespace(label="r01", test="laser", role="identify", setup={"setup_id": "L1"}, steps=())
    with pytest.raises(StoreError, match="did not take all samples"):
        await listen_module.listen_campaign(None, store, SITE, SimpleNamespace(name="c", tests=(test,)), print)  # type: ignore[arg-type]
    go.set()
    (run,) = store.runs.all()
    assert run.status == "running"
    assert segment_path(Path(f"{store.url.removeprefix('sqlite:///')}-capture"), run.id).exists()
