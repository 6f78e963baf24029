"""Find the tables that were in force while a solution's runs were measured, and refuse an export if one of them corrected the machine.

A machine that is measured with a table in force shows only the error that the table leaves. Files made from that error alone would replace
the old correction and make the machine worse. `abbe correct` adds the old and the new correction instead.
"""

from __future__ import annotations

from abbe.service.domain.document import Doc
from abbe.service.domain.solution_file import TableInForce, distinct
from abbe.service.errors import FormatRefused
from abbe.service.runs.exchange import Images
from abbe.service.storage.store import Store
from abbe.service.tables.push_journal import JournalView

KIND_AT, NO_CORRECTION = slice(4, 6), 0
"""Place of the table's kind in an image (docs/protocols/cnc.md, word 2), and the kind that corrects nothing."""
REMEDY = "measure again without a table in force; or, if the control has Abbe's register map, add the tables with `abbe correct`"
CONFIRM_REMEDY = "if no correction was in force, confirm with --without-table"


def tables_of(doc: Doc) -> list[TableInForce]:
    """Tables named in a solution's document."""
    return distinct(doc.get("inputs", {}).get("tables", []))


def stored_tables(store: Store, solution_id: int) -> list[TableInForce]:
    """Tables of a stored solution's runs, also for older documents that do not name them."""
    solution = store.solutions.get(solution_id)
    runs = [r.start_doc for r in store.runs.all(solution.campaign_id) if r.id in set(solution.run_ids)]
    found = [start.get("imported", start).get("table", {}) for start in runs]
    return distinct([t for t in found if "crc" in t] + solution.doc.get("inputs", {}).get("tables", []))


def images_of(store: Store) -> Images:
    """Return a look-up from CRC to the image of a table that a push of this database wrote or found in force."""
    found = {t.crc: t.image for t in store.tables.all()}
    for name in {store.machines.get(t.machine_id).name for t in store.tables.all()}:
        found |= {push.base_crc: push.base_image for push in JournalView.read(store, name, origins=False).bases() if push.base_image}
    return found.get


def check_fresh(tables: list[TableInForce], images: Images, *, confirmed_none: bool = False) -> bool:
    """Refuse a solution that was measured with a correction in force; return True if it is known that there was none.

    Parameters
    ----------
    tables : list of TableInForce
        From `distinct`.
    images : callable
        Returns the image of a CRC, or None.
    confirmed_none : bool
        A person states that no correction was in force. This counts only if neither the image nor the record of the run shows it.

    Raises
    ------
    FormatRefused
        A table corrected something, or it is not known whether it did.
    """
    for table in tables:
        image = images(table.crc)
        acts = table.acting
        if image is not None:
            acts = int.from_bytes(image[KIND_AT], "big") != NO_CORRECTION
        name = f"table {table.crc:08X}"
        if acts:
            raise FormatRefused(
                f"this solution was measured while {name} corrected the machine: files made from it would remove that correction", REMEDY
            )
        if acts is None and not confirmed_none:
            raise FormatRefused(
                f"this solution was measured with {name}; it is not recorded whether that table was in force", CONFIRM_REMEDY
            )
    return bool(tables) or confirmed_none
