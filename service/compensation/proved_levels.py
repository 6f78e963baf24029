"""What a machine's controller was proved to do for a safe push, as the store keeps it beside the proof of its sign.

A proof belongs to one controller with one firmware: after another was put in, nothing is proved any more. What was never proved counts
as far as the protocol's status block shows it, and that is never enough for an unattended push.
"""

from __future__ import annotations

import asyncio
from dataclasses import asdict, dataclass, fields

from abbe.drivers.api import BankState, DeviceInfo, Identity
from abbe.service.domain.document import Doc
from abbe.service.errors import TableRefused
from abbe.service.push.levels import Capabilities, objection
from abbe.service.site import Site
from abbe.service.storage.store import Store

KIND = "levels"
HINT = "what this controller does for a safe push was never proved{}: abbe comp commission does that, until then a person has to attend"


@dataclass(frozen=True, slots=True)
class LevelStatus:
    """What counts for a push now. ``hint``: what has to be said about it; empty when it was proved."""

    capabilities: Capabilities
    hint: str

    @property
    def level(self) -> int:
        """Capability level (`abbe.service.push.levels`)."""
        return self.capabilities.level


def identity(info: DeviceInfo) -> Doc:
    """What a proof is bound to beside the machine's name; the boot id is not in it, a restart changes nothing that was proved."""
    return {"model": info.model, "serial": info.serial_no, "firmware": info.firmware}


def flags_of(capabilities: Capabilities) -> dict[str, bool]:
    """The flags by name."""
    return asdict(capabilities)


def last_proof(store: Store, site: Site) -> Doc | None:
    """Document of the last commissioning of this machine's controller; None if there was none."""
    ids = {c.id for c in store.campaigns.all() if store.machines.get(c.machine_id).name == site.name}
    last = [s for s in store.solutions.all() if s.kind == KIND and s.campaign_id in ids][-1:]
    return dict(last[0].doc) if last else None


async def level_status(controller: Identity, store: Store, site: Site) -> LevelStatus:
    """Find out what counts for a push into this controller, as it is now."""
    info = await controller.identify()
    doc = await asyncio.to_thread(last_proof, store, site)
    if doc is not None and doc["identity"] == identity(info):
        return LevelStatus(Capabilities(**{f.name: doc["flags"].get(f.name) is True for f in fields(Capabilities)}), "")
    return LevelStatus(await _visible(controller), HINT.format("" if doc is None else " since it is another one, or has another firmware"))


async def _visible(controller: Identity) -> Capabilities:
    """What can be seen without a test: two banks, a generation and a boot id in the status block. Nothing of it is proved."""
    now = await controller.comp_status()
    banks = now.active_bank in (0, 1) and now.bank_state[now.active_bank] is not BankState.EMPTY
    return Capabilities(two_banks=banks, generation=now.gen != 0, boot_id=now.boot_id != 0)


async def check_level(controller: Identity, store: Store, site: Site, *, attended: bool = True) -> LevelStatus:
    """Refuse before anything is measured for a table that could not be pushed; return what counts for a push.

    Raises
    ------
    TableRefused
        This controller allows no such push.
    """
    found = await level_status(controller, store, site)
    no = objection(found.level, attended=attended)
    if no:
        raise TableRefused(no, "nothing was written")
    return found
