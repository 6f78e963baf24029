"""What a month of ten machines costs: the real service on a history as it would have left it, asked over loopback, against one day;
then a copy of it is made, and brought back."""

from __future__ import annotations

import http.client
import json
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from datetime import timedelta
from pathlib import Path

from sqlalchemy import func, select

from abbe.service.queries.fleet import fleet
from abbe.service.storage.store import Store
from abbe.service.storage.tables import chunks, runs
from abbe.service.verification.trend_table import trends
from tests.experiments.bench.history_case import MONTH, START, History, build
from tests.system.serve_bench import abbe

ASKED = 20
GOALS_MS = {"page": 200.0, "machines": 300.0, "trend": 300.0}
"""Stated, never demanded."""
WORDS = {
    "page": "home page",
    "machines": "all machines (/fleet)",
    "status": "/api/v1/status",
    "checks": "/api/v1/verifications?limit=1000",
    "trend": "trend of one machine (abbe trend)",
    "fleet": "all machines (abbe fleet)",
}
PATHS = {"page": "/", "machines": "/fleet", "status": "/api/v1/status", "checks": "/api/v1/verifications?limit=1000"}
FILE = """name = "{name}"
chain = "w-X-Y-b-Z-t"
[stroke_mm]
X = [0.0, 600.0]
Y = [0.0, 500.0]
Z = [0.0, 450.0]
[store]
url = "{url}"
[devices]
cnc = "modbus+tcp://127.0.0.1:9"
ballbar = "socket://127.0.0.1:9"
laser = "modbus+tcp://127.0.0.1:9"
fixture = "fixture+tcp://127.0.0.1:9"
[alarm]
watch_table = false
[[schedule]]
name = "yearly"
cron = "0 6 1 1 *"
recipe = "quick-check"
"""


def compared(progress: Callable[[str], None], month: History = MONTH) -> dict:
    """Both histories, each in a service of its own. ``right``: the month's page shows its checks, and nothing of other machines."""
    found = {}
    for name, history in {"month": month, "day": History(machines=1, days=1, runs=66)}.items():
        with tempfile.TemporaryDirectory() as folder:
            progress(f"history: building the {name}")
            built_s = _built(Path(folder), history)
            progress(f"history: asking the {name}")
            size = (Path(folder) / "abbe.sqlite3").stat().st_size
            asked = asked_of(f"sqlite:///{Path(folder) / 'abbe.sqlite3'}", Path(folder), history)
            progress(f"history: backing the {name} up")
            copied = _copied(Path(folder), history)
            asked["right"] = asked["right"] and copied.pop("same")
            found[name] = asked | copied | {"built_s": built_s, "runs": history.runs, "days": history.days, "bytes": size}
    progress("")
    return found


def _built(folder: Path, history: History) -> float:
    began_s = time.perf_counter()
    build(f"sqlite:///{folder / 'abbe.sqlite3'}", history)
    return time.perf_counter() - began_s


def asked_of(url: str, folder: Path, history: History) -> dict:
    """Ask a service of a history's third machine, its files in ``folder``: the middle of all times, and whether the answers are right."""
    name = history.name(min(2, history.machines - 1))
    with _served(url, folder, name) as port:
        times = {key: [_get(port, path)[0] for _ in range(ASKED)] for key, path in PATHS.items()}
        checks = json.loads(_get(port, PATHS["checks"])[1])["verifications"]
        page = _get(port, "/")[1].decode()
    with Store.open(url) as store:
        times["trend"] = [_timed(lambda: trends(store.verifications.of_machine(name, limit=100_000))) for _ in range(ASKED)]
        now = START + timedelta(days=history.days)
        times["fleet"] = [_timed(lambda: fleet(store, now)) for _ in range(3)]
    right = {one["machine"] for one in checks} == {name} and len(checks) == min(1000, history.days * history.checks_a_day)
    right = right and "</html>" in page
    return {"ms": {key: sorted(1e3 * t for t in all_s)[len(all_s) // 2] for key, all_s in times.items()}, "right": right}


def _copied(folder: Path, history: History) -> dict:
    """Seconds of both commands, their start and their checks included. ``same``: what is back says the same of every machine."""
    copy, back = folder / "copy", folder / "back"
    back.mkdir()
    url, url_back = (f"sqlite:///{place / 'abbe.sqlite3'}" for place in (folder, back))
    took = {"backup_s": _timed(lambda: _done("backup", "--db", url, copy))}
    took["restore_s"] = _timed(lambda: _done("restore", "--db", url_back, copy))
    return took | {"same": _told(url, history) == _told(url_back, history)}


def _done(*words: str | Path) -> None:
    process = abbe(*words)
    if process.wait():
        raise SystemExit("\n".join(process.lines))


def _told(url: str, history: History) -> tuple:
    with Store.open(url) as store:
        names = [history.name(k) for k in range(history.machines)]
        counts = store.read(lambda c: [c.execute(select(func.count()).select_from(table)).scalar() for table in (runs, chunks)])
        return counts, [trends(store.verifications.of_machine(name, limit=100_000)) for name in names]


@contextmanager
def _served(url: str, folder: Path, name: str) -> Iterator[int]:
    """The real command, on a port of its own choice."""
    (folder / "machine.toml").write_text(FILE.format(name=name, url=url))
    with closing(abbe("serve", "-m", folder / "machine.toml", "--port", "0")) as service:
        yield int(json.loads(service.expect('"serving"'))["page"].rstrip("/").rpartition(":")[2])
        service.terminate()


def _get(port: int, path: str) -> tuple[float, bytes]:
    began_s = time.perf_counter()
    with closing(http.client.HTTPConnection("127.0.0.1", port, timeout=30)) as connection:
        connection.request("GET", path)
        answer = connection.getresponse()
        body = answer.read()
    if answer.status != 200:
        raise SystemExit(f"{path}: {answer.status}")
    return time.perf_counter() - began_s, body


def _timed(work: Callable[[], object]) -> float:
    began_s = time.perf_counter()
    work()
    return time.perf_counter() - began_s


def lines(found: dict) -> list[str]:
    """The printed table."""
    month, day = found["month"], found["day"]
    out = [
        "",
        f"{'A month of ten machines: ' + format(month['runs'], ',') + ' runs':<44}{'ms':>9}{'ms, one day':>14}{'ratio':>8}{'goal ms':>9}",
    ]
    for key, ms in month["ms"].items():
        goal = GOALS_MS.get(key)
        met = "" if goal is None else f"{goal:9.0f} {'met' if ms < goal else 'NOT MET'}"
        out.append(f"  {WORDS[key]:<42}{ms:9.1f}{day['ms'][key]:14.1f}{ms / day['ms'][key]:8.1f}{met}")
    wrong = "" if month["right"] and day["right"] else "   DIFFERS"
    growth = month["bytes"] / month["days"] / 1e6
    for key in ("backup", "restore"):
        ms, day_ms = 1e3 * month[f"{key}_s"], 1e3 * day[f"{key}_s"]
        out.append(f"  {'abbe ' + key:<42}{ms:9.1f}{day_ms:14.1f}{ms / day_ms:8.1f}")
    return [
        *out,
        f"  database {month['bytes'] / 1e6:.0f} MB, {growth:.1f} MB a day, {month['bytes'] / month['runs'] / 1e3:.1f} kB a run{wrong}",
        "",
        "Middle of all askings. Pages over loopback from a real `abbe serve`, a new connection each; trend and fleet are their functions,",
        "backup and restore the whole commands, all checks included.",
    ]
