"""Tables that were on their way once and that nothing has verified: whoever makes one the active one, nothing is built on it."""

from __future__ import annotations

from collections.abc import Sequence

from service.push.entries import Entry
from service.push.states import State


def unverified_crcs(entries: Sequence[Entry]) -> dict[int, int]:
    """Which tables of a machine's journal were neither kept nor vouched for: CRC -> number of the push.

    A table that was in force before a push was put there by a person, unless an earlier push had brought it and not kept it.
    """
    candidates: dict[int, int] = {}
    pushed: dict[int, int] = {}
    fine: set[int] = set()
    for entry in entries:
        if entry.state is State.SNAPSHOT:
            base, crc = int(entry.doc["base_crc"]), int(entry.doc["crc"])
            if base not in candidates:
                fine.add(base)
            pushed[entry.push] = crc
            candidates.setdefault(crc, entry.push)
        elif entry.state is State.KEEP:
            fine.add(pushed[entry.push])
        elif entry.state is State.ACCEPTED:
            fine.add(int(entry.doc["accepted_crc"]))
    return {crc: push for crc, push in candidates.items() if crc not in fine}
