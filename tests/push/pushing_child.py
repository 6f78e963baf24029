"""A process that forks children which push, or recover, on real sockets and a real database.

They kill themselves where they are told to (``at``, ``when``), or are killed from outside so long after they began (``kill_s``). One JSON
object a line comes in; the exit code, what the child said and how long it took goes out.
"""

from __future__ import annotations

import asyncio
import json
import os
import select
import signal
import sys
import time
import zlib
from typing import Any

import numpy as np

from abbe.drivers.registry import open_controller
from abbe.drivers.tables import encode
from abbe.models.compensation.tables import NineTables
from abbe.service.clock import SystemClock
from abbe.service.errors import AbbeError
from abbe.service.push import operations as o
from abbe.service.push.execute import ControllerPort, PushActors, push, recover, semantic_digest_of_tables
from abbe.service.push.journal import OperationOrder, StoreBook, check_chain, facts
from abbe.service.storage.store import Store
from abbe.service.tables.nine_tables import table_image

MACHINE = "sim"


def _curve(height: int, a: int, n: int) -> np.ndarray:
    return 1e-4 * np.array([[0 if k == 0 else height + 5 * a + 3 * i + k for i in range(3)] for k in range(n)])


def tables(height: int) -> NineTables:
    """25 + 21 + 19 points; ``height`` in units of 0.1 um makes each set another."""
    grids = tuple(np.linspace(0.0, 50.0 * (n - 1), n) for n in (25, 21, 19))
    curves = tuple(_curve(height, a, g.size) for a, g in enumerate(grids))
    none = tuple(np.full_like(c, np.nan) for c in curves)
    return NineTables((grids[0], grids[1], grids[2]), (curves[0], curves[1], curves[2]), (none[0], none[1], none[2]))


class Killer:
    """Counts operations and journal writes, and ends the process at one of them."""

    def __init__(self, at: int, when: str, count_file: int | None = None) -> None:
        self.at, self.when, self.n, self.names = at, when, 0, []

    async def around(self, name: str, do: Any) -> Any:
        k, self.n = self.n, self.n + 1
        self.names.append(name)
        if k == self.at and self.when == "before":
            os.kill(os.getpid(), signal.SIGKILL)
        if k == self.at and self.when == "during":
            asyncio.get_running_loop().call_later(0.002, os.kill, os.getpid(), signal.SIGKILL)
        answer = await do
        if k == self.at:
            os.kill(os.getpid(), signal.SIGKILL)
        return answer


class KillingPort:
    def __init__(self, real: ControllerPort, killer: Killer) -> None:
        self._real, self._killer = real, killer

    async def execute(self, op: Any, journal: Any) -> Any:
        return await self._killer.around(op.kind.name, self._real.execute(op, journal))


class KillingBook:
    def __init__(self, real: StoreBook, killer: Killer) -> None:
        self._real, self._killer = real, killer

    async def entries(self) -> Any:
        return await self._real.entries()

    async def append(self, journal: Any, state: Any, doc: Any) -> Any:
        return await self._killer.around(f"journal {state}", self._real.append(journal, state, doc))


def people(clock: SystemClock, *, better: bool) -> PushActors:
    """Stand-ins that answer at once: the probe and the verification of a real machine take motion and instruments."""

    async def validate(journal: Any) -> list[str]:
        return []

    async def approve(journal: Any) -> o.Approval:
        return o.Approval(facts(journal).binding("today"), "a test", "today", clock.monotonic_s() + 60.0)

    async def probe(journal: Any) -> o.VerificationResult:
        return o.VerificationResult(True, "stand-in")

    async def verify(journal: Any) -> o.VerificationResult:
        return o.VerificationResult(better, "stand-in")

    return PushActors(validate, approve, probe, verify)


async def work(words: dict[str, Any]) -> dict[str, Any]:
    """Push or recover; a refusal of the service is an answer like any other."""
    try:
        return await _work(words)
    except AbbeError as error:
        return {"state": None, "settled": True, "why": "", "refused": f"{error.code} {error}"}


async def _work(words: dict[str, Any]) -> dict[str, Any]:
    clock = SystemClock()
    await clock.sleep(words.get("delay_s", 0.0))  # of a race: where in the other's push this one begins
    killer = Killer(words.get("at", -1), words.get("when", ""))
    with Store.open(words["store"]) as store:
        controller = await open_controller(words["cnc"])
        try:
            port = KillingPort(ControllerPort(controller, people(clock, better=words.get("better", True)), clock), killer)
            if words["do"] == "push":
                image = encode(table_image(tables(words["height"]), 100, words["height"]))
                meaning = semantic_digest_of_tables(tables(words["height"]))
                order = OperationOrder(MACHINE, image, zlib.crc32(image), meaning, "limits", words["owner"] << 16)
                ended = await push(port, KillingBook(await StoreBook.new(store, MACHINE, clock), killer), order)
            else:
                book = await StoreBook.last(store, MACHINE, clock)
                ended = await recover(port, KillingBook(book, killer)) if book is not None else None
            check_chain(store.pushes.entries(MACHINE))
            comp = await controller.comp_status()
            active = await controller.read_bank(comp.active_bank)
        finally:
            await controller.close()
    return {
        "state": ended and ended.state, "settled": ended is None or ended.settled, "why": _why(ended), "n": killer.n,
        "names": killer.names, "active": active.hex(), "lease": comp.lease_owner,
    }  # fmt: skip


def _why(ended: Any) -> str:
    """What a person would read."""
    if ended is None:
        return ""
    known = facts(ended.journal)
    return str(known.pending or known.why or "; ".join(known.reasons) or ended.why)


def main() -> None:
    print("ready", flush=True)  # noqa: T201
    for line in sys.stdin:
        words = json.loads(line)
        read, write = os.pipe()
        began_s = time.monotonic()
        pid = os.fork()
        if pid == 0:
            os.close(read)
            code = 1
            try:
                os.write(write, json.dumps(asyncio.run(work(words))).encode())
                code = 0
            finally:
                os._exit(code)
        os.close(write)
        if "kill_s" in words and not select.select([read], [], [], words["kill_s"])[0]:
            os.kill(pid, signal.SIGKILL)
        with os.fdopen(read) as pipe:
            said = pipe.read()
        _, status = os.waitpid(pid, 0)
        took_s = time.monotonic() - began_s
        print(json.dumps({"status": status, "said": json.loads(said) if said else None, "took_s": took_s}), flush=True)  # noqa: T201


if __name__ == "__main__":
    main()
