"""Records on a disk that really runs full: ``python -m tests.service.capture.small_disk FOLDER``. Prints one line of JSON."""

from __future__ import annotations

import asyncio
import json
import sys
from pathlib import Path

from abbe.service.capture.recorder import recording
from abbe.service.capture.recovery import ledger_of, read_segment
from abbe.service.capture.settings import CaptureSettings
from abbe.service.clock import SystemClock
from abbe.service.errors import DiskFull
from abbe.service.runs.chunks import decode_bar
from abbe.service.storage.store import Store
from tests.service.capture.capture_bench import assert_true, batch, new_run


async def main(folder: Path) -> dict[str, object]:
    """Fill the disk with samples until the run is closed for want of space."""
    durable = [-1]
    with Store.open(f"sqlite:///{folder / 'abbe.sqlite3'}") as store:
        run_id, told = new_run(store), ""
        settings = CaptureSettings(reserve_bytes=1 << 20, keep=True)
        try:
            async with recording(store, run_id, settings, SystemClock(), published=lambda *news: durable.append(news[2])) as recorder:
                tap = recorder.tap()
                for first in range(0, 10_000_000, 2000):
                    tap.take(batch(first, 2000))
                    await recorder.flush()
        except DiskFull as error:
            told = str(error)
        store.runs.finish(run_id, "disk_full", told, recorder.doc())
        held = read_segment(recorder.log.segment.path)
        chunks = store.chunks.of_run(run_id)
        found = [sample for chunk in chunks if chunk.channel == "bar" for sample in decode_bar(chunk.payload)]
        assert_true(found)
        return {
            "told": told,
            "durable": durable[-1],
            "stored": [found[0].seq, found[-1].seq, len(found)],
            "unaccounted": ledger_of(chunks).unaccounted(),
            "whole": held.whole,
            "closed": held.closed,
            "status": store.runs.find(str(run_id)).status,
        }


if __name__ == "__main__":
    sys.stdout.write(json.dumps(asyncio.run(main(Path(sys.argv[1])))) + "\n")
