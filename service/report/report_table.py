"""Remarks about the tables in force during the runs of a report: unverified, verified elsewhere, or unknown to this database."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from abbe.service.domain.measured import RunTable
from abbe.service.domain.run import Run
from abbe.service.rendering.document import Sign
from abbe.service.runs.exchange import Images
from abbe.service.storage.store import Store
from abbe.service.tables.known_tables import KnownTables, known_tables
from abbe.service.tables.measured_with import KIND_AT, NO_CORRECTION, images_of
from abbe.service.tables.table_gate import STRANGE

WORD = "Unverified table"


@dataclass(frozen=True, slots=True)
class TableRemarks:
    """Remarks about the tables in force. ``unverified``: why the verdict by the limits is not valid; empty if it is valid."""

    unverified: str = ""
    remarks: tuple[str, ...] = ()

    def verdict(self, by_limits: tuple[Sign, str, str]) -> tuple[Sign, str, str]:
        """The verdict by the limits, replaced by "bad" for an unverified table."""
        if not self.unverified:
            return by_limits
        _, word, text = by_limits
        return "bad", WORD, f"{self.unverified[:1].upper()}{self.unverified[1:]}. By the figures alone: {word}. {text}".strip()


NO_TABLE_REMARKS = TableRemarks()


def table_remarks(store: Store, machine: str, runs: Sequence[Run]) -> TableRemarks:
    """Judge the tables in force during these runs of a machine by the current journals of this database."""
    used = {r.table.crc: r.table for r in runs if r.table.crc is not None}
    if not used:
        return TableRemarks()
    known, images, chain = known_tables(store), images_of(store), store.pushes.chain(machine)
    unverified = [
        f"measured with the table of push {push.push} of machine {push.machine!r} (CRC {crc:08X}), which was never verified"
        for crc in sorted(used)
        if (push := known.unverified.get(crc)) is not None
    ]
    remarks = [_remark(crc, known, chain) for crc in sorted(used) if crc not in known.unverified and _corrects(crc, used[crc], images)]
    return TableRemarks("; ".join(unverified), (*unverified, *filter(None, remarks)))


def _corrects(crc: int, table: RunTable, images: Images) -> bool:
    """Whether a table corrects anything: according to its image or, without one, to the control."""
    image = images(crc)
    return bool(table.acting) if image is None else int.from_bytes(image[KIND_AT], "big") != NO_CORRECTION


def _remark(crc: int, known: KnownTables, chain: str) -> str:
    """Origin of a foreign table, and who accepted it for this machine; empty if this machine's own pushes wrote it or found it in force."""
    elsewhere, here, push = known.elsewhere(crc, chain), known.endorsed.get(crc, {}).get(chain), known.pushed.get(crc)
    if elsewhere is not None:
        return f"measured with a table (CRC {crc:08X}) that was {elsewhere.not_here}: not accepted"
    if here is not None and (here.how != "accepted" or (push is not None and push.chain == chain)):
        return ""
    who = "not accepted" if here is None else f"accepted by {here.by or 'a person'} at {here.utc}"
    what = STRANGE if push is None else f"a table of machine {push.machine!r}"
    return f"measured with {what} (CRC {crc:08X}): {who}"
