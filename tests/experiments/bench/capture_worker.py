"""One contestant in a process of its own: ``python -m tests.experiments.bench.capture_worker NAME FOLDER [SAMPLES]``. Prints one line of
JSON."""

from __future__ import annotations

import asyncio
import json
import struct
import subprocess
import sys
import time
from binascii import crc_hqx
from pathlib import Path

import serial
from sqlalchemy import BigInteger, Column, Integer, MetaData, Table, create_engine, insert, select

from abbe.drivers.ballbar import driver
from abbe.drivers.ballbar.driver import SerialBallBar
from abbe.drivers.ballbar.frames import start_command
from abbe.drivers.links.serial_link import ByteLink
from abbe.drivers.links.urls import parse_url
from abbe.service.capture.recorder import recording
from abbe.service.capture.settings import CaptureSettings
from abbe.service.clock import SystemClock
from abbe.service.runs.chunks import decode_bar
from abbe.service.storage.store import Store
from tests.experiments.bench.capture_case import SAMPLES, device_us, reading_nm

COMMIT_S = 0.05
_SAMPLE = struct.Struct("<IQiH")


def main() -> int:
    """Run a contestant against a feeder."""
    name, folder = sys.argv[1], Path(sys.argv[2])
    count = int(sys.argv[3]) if len(sys.argv) > 3 else SAMPLES[name]
    feeder = subprocess.Popen(
        [sys.executable, "-m", "tests.experiments.bench.capture_feeder", str(count)], stdout=subprocess.PIPE, text=True
    )
    try:
        path = feeder.stdout.readline().strip()
        if name == "ours":
            times, found = asyncio.run(_ours(path, folder, count))
        else:
            times, found = _plain(path, folder, count, 0.0 if name == "plain" else COMMIT_S)
    finally:
        feeder.kill()
        feeder.communicate()
    expected = [(k, device_us(k), reading_nm(k), 8) for k in range(count)]
    print(json.dumps({"samples": count, "cpu_s": times[0], "wall_s": times[1], "right": found == expected}))  # noqa: T201
    return 0


async def _ours(path: str, folder: Path, count: int) -> tuple[tuple[float, float], list[tuple[int, ...]]]:
    driver._BUFFER_S = 3600.0  # the box sends faster than any consumer takes: that is what is measured, not a reason to stop
    bar = SerialBallBar(ByteLink(parse_url(f"serial://{path}?baud=460800")), ring_s=3600.0)
    with Store.open(f"sqlite:///{folder / 'ours.sqlite3'}") as store:
        campaign = store.campaigns.add(store.machines.add("M", {}), "c", {})
        run_id = store.runs.start(campaign, "r", "ballbar_helix", "identify", {})
        await bar.identify()
        cpu_s, wall_s = time.process_time(), time.perf_counter()
        async with (
            recording(store, run_id, CaptureSettings(reserve_bytes=65536), SystemClock()) as recorder,
            bar.stream(1000, recorder.tap()) as batches,
        ):
            async for batch in batches:  # as the sequencer does: every batch through the event loop as well
                await recorder.add_bar(batch)
                if batch.samples[-1].seq >= count - 1:
                    break
        times = time.process_time() - cpu_s, time.perf_counter() - wall_s
        await bar.close()
        chunks = store.chunks.of_run(run_id, "bar")
    return times, [(s.seq, s.device_us, s.reading_nm, s.status) for chunk in chunks for s in decode_bar(chunk.payload)]


def _plain(path: str, folder: Path, count: int, commit_s: float) -> tuple[tuple[float, float], list[tuple[int, ...]]]:
    """As it is written when only fair weather is thought of: read a frame, check it, insert a row."""
    columns = (Column("seq", Integer, primary_key=True), Column("us", BigInteger), Column("nm", Integer), Column("status", Integer))
    table = Table("samples", MetaData(), *columns)
    engine = create_engine(f"sqlite:///{folder / f'plain-{commit_s}.sqlite3'}")
    table.metadata.create_all(engine)
    port = serial.Serial(path, 460800, timeout=5.0)
    cpu_s, wall_s = time.process_time(), time.perf_counter()
    port.write(start_command(1, 1000))
    with engine.connect() as connection:
        committed_s, done = time.monotonic(), 0
        while done < count:
            head = port.read(4)
            payload = port.read(head[3] + 2)
            assert head[:2] == b"\xa5\x5a"
            assert crc_hqx(head[2:] + payload[:-2], 0xFFFF) == int.from_bytes(payload[-2:], "little")
            if head[2] != 1:
                continue
            seq, us, nm, status = _SAMPLE.unpack(payload[:-2])
            connection.execute(insert(table).values(seq=seq, us=us, nm=nm, status=status))
            done += 1
            if time.monotonic() - committed_s >= commit_s or done == count:
                connection.commit()
                committed_s = time.monotonic()
        times = time.process_time() - cpu_s, time.perf_counter() - wall_s
        rows = [tuple(row) for row in connection.execute(select(table).order_by(table.c.seq))]
    port.close()
    return times, rows


if __name__ == "__main__":
    sys.exit(main())
