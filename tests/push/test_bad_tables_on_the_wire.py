"""Bad tables at a simulated controller's real socket: rejected with a reason each, and not one write request reaches it."""

from __future__ import annotations

from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest

from abbe.models.compensation.tables import NineTables
from abbe.service.compensation.pushing import Pushing, Questions, WantedTable
from abbe.service.domain.push_entry import PushState
from abbe.service.errors import TableRefused
from abbe.service.push.operations import VerificationResult
from abbe.service.push.validate import PushLimits, reasons_against
from abbe.service.storage.store import Store
from abbe.service.tables.nine_tables import read_base
from tests.faults.sequencer_world import bench
from tests.push.bad_tables import CLASSES, EACH, good

SMALL = tuple(np.array([0.0, 100.0]) for _ in range(3))


def tables() -> NineTables:
    curves = tuple(np.array([[0.0] * 3, [1e-3 * (a + 1), 2e-3, -1e-3]]) for a in range(3))
    nothing = np.zeros((2, 3))
    return NineTables((SMALL[0], SMALL[1], SMALL[2]), (curves[0], curves[1], curves[2]), (nothing, nothing, nothing))


def counted(registers: Any) -> list[int]:
    """Addresses of every write request that reaches the simulated controller from now on."""
    seen: list[int] = []
    honest = registers.write

    def write(address: int, values: list[int]) -> bool:
        seen.append(address)
        return bool(honest(address, values))

    registers.write = write
    return seen


async def never() -> VerificationResult:
    raise AssertionError("a rejected table is neither probed nor verified")


async def kept() -> VerificationResult:
    return VerificationResult(True, "a stand-in")


@pytest.mark.timeout(120)
async def test_every_class_of_bad_tables_is_rejected_and_writes_no_register(tmp_path: Path) -> None:
    async with bench(tmp_path, seed=3) as b:
        b.sim.pace(100.0)
        with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as store:
            controller, log = b.session.controller, counted(b.sim.registers)
            base, gen = await read_base(controller), b.sim.world.controller.comp.generation
            wanted = WantedTable(tables(), base, 100, None, {})
            for n, (name, (make, word)) in enumerate(CLASSES.items()):
                reasons = reasons_against(*make(Random(f"{name} {n % EACH}")), PushLimits())
                questions = Questions(lambda reasons=reasons: reasons, "a test", never, never)
                with pytest.raises(TableRefused, match=word):
                    await Pushing(controller, store, b.site).bring(wanted, questions)
                last = store.pushes.entries(b.site.name)[-1]
                assert (last.state, last.doc["reasons"]) == (PushState.REJECTED, reasons)
            assert log == []
            assert b.sim.world.controller.comp.generation == gen
            # The same door opens for a good one: what was counted is what a push would have written.
            assert reasons_against(*good(Random(1)), PushLimits()) == []
            assert (await Pushing(controller, store, b.site).bring(wanted, Questions(list, "a test", kept, kept))).kept
            assert len(log) > 4
            assert b.sim.world.controller.comp.generation > gen
