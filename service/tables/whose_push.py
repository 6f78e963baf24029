"""Whether an open push is one into the control that is connected: its journal is found by an address or a name, and either may be
another machine's by now.
"""

from __future__ import annotations

from abbe.drivers.api import Identity
from abbe.service.errors import TableMismatch
from abbe.service.push.entries import Journal, facts
from abbe.service.site import Site


async def is_own(controller: Identity, site: Site, journal: Journal) -> bool:
    """Whether a push was begun on this control, by what proves it: address and name, address and start of the control, or its table.

    A table carries a number drawn by lot, so the table of the push in force is the proof that this is its control. The table from before
    the push proves nothing: two controls as they came have the same one.

    Parameters
    ----------
    controller : Identity
        Only read, and only where address and name do not match.
    site : Site
        The machine as its file names it now.
    journal : tuple of Entry
        The push.
    """
    known = facts(journal)
    here = _address(journal) in ("", site.control)
    if here and _name(journal, site) == site.name:
        return True
    now = await controller.comp_status()
    return (here and now.boot_id == known.get("boot")) or now.bank_crc[now.active_bank] == known.get("crc")


async def check_own(controller: Identity, site: Site, journal: Journal) -> None:
    """Refuse to end a push of which nothing proves that it was begun on this control. Nothing is written.

    Raises
    ------
    TableMismatch
        Which push, where it was begun, and what a person can do.
    """
    if await is_own(controller, site, journal):
        return
    at = _address(journal) or "an address not noted"
    raise TableMismatch(
        f"push {journal[-1].push} of {_name(journal, site)!r} was begun at {at} and has not ended, and its table is not in force here",
        "start with that machine's file; or, if this is that machine and its table is right: `abbe accept-table MACHINE.toml --yes`; "
        "nothing was written",
    )


def _address(journal: Journal) -> str:
    return str(facts(journal).get("control", ""))


def _name(journal: Journal, site: Site) -> str:
    return str(facts(journal).get("machine", site.name))
