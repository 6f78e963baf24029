"""With which compensation tables the runs of a solution were measured: files for a control hold only for a machine without any.

A machine that is measured while a table is in force shows what that table has left. Files made of that alone, put in its place, take the
old correction away and leave the machine worse. They are refused; where Abbe writes the tables itself, it adds them (`abbe correct`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from abbe.service.domain.document import Doc
from abbe.service.errors import FormatRefused
from abbe.service.storage.store import Store
from abbe.service.tables.push_journal import JournalView

KIND_AT, NO_CORRECTION = slice(4, 6), 0
"""Bytes of an image that say its kind (docs/protocols/cnc.md, word 2), and the kind that corrects nothing."""
Images = Callable[[int], bytes | None]
REMEDY = "measure again without a table in force; or, where the control has Abbe's register map, let abbe correct add the tables"
CONFIRM_REMEDY = "if none was, say so: --without-table"


def distinct(tables: Iterable[Doc]) -> list[Doc]:
    """Tables by their CRC, with what the controller said about whether one acts (``acting``; missing in runs of older versions)."""
    found: dict[int, Doc] = {}
    for table in tables:
        one = {"crc": int(table["crc"])} | ({} if table.get("acting") is None else {"acting": bool(table["acting"])})
        found[one["crc"]] = found.get(one["crc"], {}) | one
    return [found[crc] for crc in sorted(found)]


def tables_of(doc: dict[str, Any]) -> list[Doc]:
    """Tables that a solution's document names."""
    return distinct(doc.get("inputs", {}).get("tables", []))


def stored_tables(store: Store, solution_id: int) -> list[Doc]:
    """Tables of a stored solution's runs, also where its document is older than that it names them."""
    solution = store.solutions.get(solution_id)
    runs = [r.start_doc for r in store.runs.all(solution.campaign_id) if r.id in set(solution.run_ids)]
    found = [start.get("imported", start).get("table", {}) for start in runs]
    return distinct([t for t in found if "crc" in t] + tables_of(solution.doc))


def images_of(store: Store) -> Images:
    """Images by their CRC, as far as this database has met them: written by a push, or in force before one."""
    found = {t.crc: t.image for t in store.tables.all()}
    for name in {store.machines.get(t.machine_id).name for t in store.tables.all()}:
        found |= {push.base_crc: push.base_image for push in JournalView.read(store, name, origins=False).bases() if push.base_image}
    return found.get


def no_images(crc: int) -> bytes | None:
    """For a solution that comes from no database."""
    return None


def check_fresh(tables: list[Doc], images: Images, *, confirmed_none: bool = False) -> bool:
    """Refuse a solution that was measured with a correction in force; gives whether it is known that there was none.

    Parameters
    ----------
    tables : list of dict
        From `distinct`.
    images : callable
        Image of a CRC, or None.
    confirmed_none : bool
        A person says that no correction was in force: believed where nothing else is known, never against what is known.

    Raises
    ------
    FormatRefused
        A table corrected something, or it is not known whether it did.
    """
    for table in tables:
        image = images(table["crc"])
        acts = table.get("acting")
        if image is not None:
            acts = int.from_bytes(image[KIND_AT], "big") != NO_CORRECTION
        name = f"table {table['crc']:08X}"
        if acts:
            raise FormatRefused(f"this solution was measured while {name} corrected the machine: alone it would take that away", REMEDY)
        if acts is None and not confirmed_none:
            raise FormatRefused(f"this solution was measured with {name}, and nothing says whether it corrected anything", CONFIRM_REMEDY)
    return bool(tables) or confirmed_none
