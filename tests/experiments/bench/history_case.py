"""A month of ten machines as the service would have left it, built by bulk insert: sizes and shapes are those of a real quick check.

Measured on one real check (simulated machine, real wires): the helix' start document has 92 kB (its path is in it), its end document 5 kB
and its 82 chunks 63 kB; a laser line has 0.7 kB, 3 kB and 22 chunks of together 3.7 kB; the check's own document has 1.1 kB.
"""

from __future__ import annotations

import math
import random
import zlib
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

from sqlalchemy import Connection, insert

from abbe.service.storage.store import Store
from abbe.service.storage.tables import campaigns, chunks, machines, runs, slots, verifications

START = datetime(2026, 10, 1, tzinfo=UTC)
FIGURES = ("diagonal_ppp_um", "diagonal_npp_um", "diagonal_pnp_um", "diagonal_ppn_um", "body_diagonal_um", "helix_rms_um")
LIMITS = {"body_diagonal_um": 20.0, "helix_rms_um": 5.0}
HELIX_POINTS, HELIX_CHUNKS, HELIX_BYTES = 3300, 82, 767
LASER_CHUNKS, LASER_BYTES = 22, 168


@dataclass(frozen=True)
class History:
    """How much there is. ``runs`` in all, spread over the checks: each has one helix, the others are laser lines."""

    machines: int = 10
    days: int = 30
    checks_a_day: int = 4
    runs: int = 20_000
    chunks: bool = True

    @property
    def checks(self) -> int:
        return self.machines * self.days * self.checks_a_day

    def name(self, machine: int) -> str:
        return f"mill-{machine + 1}"


MONTH = History()


def build(url: str, history: History, seed: int = 7) -> None:
    """Write a history into an empty database, a day a transaction."""
    rng = random.Random(seed)
    payloads = (rng.randbytes(HELIX_BYTES), rng.randbytes(LASER_BYTES))
    with Store.open(url) as store:
        names = [history.name(k) for k in range(history.machines)]
        store.commit(
            lambda c: c.execute(
                insert(machines),
                [{"name": n, "doc": {"name": n}, "doc_hash": n, "created_utc": _utc(START)} for n in names],
            )
        )
        state = _Numbers()
        for day in range(history.days):
            store.commit(lambda c, day=day: _a_day(c, history, day, rng, state, payloads))


@dataclass
class _Numbers:
    checks: int = 0
    runs: int = 0


def _a_day(c: Connection, history: History, day: int, rng: random.Random, state: _Numbers, payloads: tuple[bytes, bytes]) -> None:
    rows: dict[str, list[dict]] = {"campaigns": [], "runs": [], "chunks": [], "verifications": [], "slots": []}
    for k in range(history.checks_a_day):
        for machine in range(history.machines):
            at = START + timedelta(days=day, hours=6 * k, minutes=machine)
            _a_check(rows, history, machine, at, rng, state, payloads)
    for table in (campaigns, runs, chunks, verifications, slots):
        if rows[table.name]:
            c.execute(insert(table), rows[table.name])


def _a_check(
    rows: dict[str, list[dict]],
    history: History,
    machine: int,
    at: datetime,
    rng: random.Random,
    state: _Numbers,
    payloads: tuple[bytes, bytes],
) -> None:
    state.checks += 1
    name, check = history.name(machine), state.checks
    campaign = f"quick-check {name} {at:%Y-%m-%d %H:%M:%S}"
    rows["campaigns"].append(
        {"id": check, "machine_id": machine + 1, "name": campaign, "doc": {"text": "x" * 270}, "created_utc": _utc(at)}
    )
    upto = round(history.runs * check / history.checks)
    labels = []
    for position in range(upto - state.runs):
        state.runs += 1
        labels.append("check-helix" if position == 0 else f"check-{position}")
        rows["runs"].append(_run(state.runs, check, labels[-1], at, helix=position == 0))
        if history.chunks:
            rows["chunks"] += _chunks(state.runs, payloads, helix=position == 0)
    rows["verifications"].append(_verification(check, machine, name, campaign, labels, at, rng, history))
    slot = {"schedule": f"{name}/quick", "slot_utc": _utc(at), "state": "done: pass", "claimed_utc": _utc(at)}
    rows["slots"].append(slot | {"finished_utc": _utc(at + timedelta(minutes=8))})


def _run(number: int, campaign: int, label: str, at: datetime, *, helix: bool) -> dict:
    path = {"points_mm": _points(), "feed_mm_min": 2000.0} if helix else None
    start = {"setup": {"setup_id": "VB", "note": "x" * 400}, "path": path} if helix else {"setup": {"note": "x" * 680}}
    owner = {"owner_host": "pc", "owner_pid": 1, "owner_start": "boot/1"}
    run = {"id": number, "campaign_id": campaign, "label": label, "test": "ballbar_helix" if helix else "laser_diagonal", "role": "holdout"}
    run |= {"status": "complete", "reason": "", "start_doc": start, "end_doc": {"clock_pairs": "x" * (5100 if helix else 2900)}}
    return run | {"started_utc": _utc(at), "ended_utc": _utc(at + timedelta(minutes=1))} | owner


_POINTS: list[list[float]] = []


def _points() -> list[list[float]]:
    if not _POINTS:
        for k in range(HELIX_POINTS):
            angle = 6 * math.pi * k / HELIX_POINTS
            _POINTS.append([round(270 + 154 * math.cos(angle), 5), round(275 + 154 * math.sin(angle), 5), round(208 - 0.047 * k, 5)])
    return _POINTS


def _chunks(run: int, payloads: tuple[bytes, bytes], *, helix: bool) -> list[dict]:
    payload, count = (payloads[0], HELIX_CHUNKS) if helix else (payloads[1], LASER_CHUNKS)
    channel, codec, n = ("bar", "bar/1", 87) if helix else ("laser", "json/1", 1)
    fixed = {"run_id": run, "channel": channel, "n": n, "codec": codec, "crc32": zlib.crc32(payload), "payload": payload}
    times = {"last_host_s": 1.0, "first_device_us": 1, "last_device_us": 2}
    return [fixed | {"seq": k, "first_host_s": k * 0.1} | times for k in range(count)]


def _verification(
    number: int, machine: int, name: str, campaign: str, labels: list[str], at: datetime, rng: random.Random, history: History
) -> dict:
    """Machine 3 drifts: its diagonal reaches the limit some days after the month."""
    grown = 0.25 * (at - START).days if machine == 2 else 0.0
    values = {key: 9.0 + rng.gauss(0, 0.5) for key in FIGURES[:4]} | {"body_diagonal_um": 10.0 + grown + rng.gauss(0, 0.5)}
    values |= {"helix_rms_um": 1.4 + rng.gauss(0, 0.1)}
    doc = {"schema": 1, "machine": name, "schedule": "quick", "recipe": "quick-check", "slot_utc": at.isoformat()}
    doc |= {"started_utc": at.isoformat(), "duration_s": 480.0, "verdict": "pass", "values": values}
    doc |= {"uncertainties": {key: 0.2 if key == "helix_rms_um" else 1.1 for key in FIGURES}, "limits": LIMITS}
    doc |= {"campaign": campaign, "runs": labels, "text": "within limits: worst body diagonal 10.0 µm (limit 20)", "cause": None}
    return {"id": number, "machine_id": machine + 1, "campaign_id": number, "verdict": "pass", "doc": doc, "utc": _utc(at)}


def _utc(at: datetime) -> str:
    return at.isoformat(timespec="microseconds").replace("+00:00", "Z")
