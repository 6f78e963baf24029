"""A push in the journal of a machine, as far as it is said to have gone, without a controller: for tests of whoever reads the journal."""

from __future__ import annotations

from typing import Any

from abbe.drivers.tables import crc32
from abbe.service.clock import Clock
from abbe.service.domain.push_entry import PushState, S
from abbe.service.push.journal import StoreBook
from abbe.service.storage.store import Store

UP_TO_ACTIVE = (S.SNAPSHOT, S.VALIDATED, S.APPROVED, S.LEASED, S.STAGING, S.STAGED, S.ACTIVATING, S.PROBATION)
KEPT = (*UP_TO_ACTIVE, S.PROBED, S.VERIFIED, S.KEEP)
TAKEN_BACK = (*UP_TO_ACTIVE, S.ROLLBACK, S.ACTIVATING_BACK, S.ROLLED_BACK)


async def as_if_pushed(
    store: Store,
    clock: Clock,
    machine: str,
    doc: dict[str, Any],
    images: tuple[bytes, bytes],
    states: tuple[PushState, ...],
    control: str = "",
    solution: int | None = None,
) -> None:
    """Write the entries. ``images``: of the table that goes and of the one that comes; ``doc``: what is kept with the latter; ``control``:
    identity of the control, empty as older versions wrote; ``solution``: from which the new table was computed.
    """
    base, image = images
    table = store.tables.add(store.machines.add(machine, {"name": machine}), solution, image, crc32(image), doc)
    known = {"table": table, "base_image": base.hex(), "base_crc": crc32(base), "base_bank": 0, "image": image.hex()}
    known |= {"crc": crc32(image), "target": 1, "base_meaning": "b", "meaning": "m", "owner": 0x00770000}
    known |= {"boot": 0x7FFFFFFF, "gen": 1, "map": "", "limits": "", "level": 3, "attended": True, "chunk_words": 100}
    known |= {"machine": machine} | ({"control": control} if control else {})
    more = {S.SNAPSHOT: known, S.APPROVED: {"approved_by": "ann"}, S.VERIFIED: {"verify": "better"}, S.ROLLBACK: {"why": "worse"}}
    book = await StoreBook.new(store, machine, clock, control)
    for state in states:
        await book.append(await book.entries(), state, more.get(state, {}))
