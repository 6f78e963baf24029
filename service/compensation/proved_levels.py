"""The capability level that a machine's controller has proved for a safe push, stored beside the proof of its sign.

A proof belongs to one controller with one firmware and lapses when either is replaced. An unproved controller gets the level that the
protocol's status block shows; that is never enough for an unattended push.
"""

from __future__ import annotations

import asyncio
from dataclasses import asdict, dataclass, fields

from abbe.drivers.api import BankState, DeviceInfo, Identity, has_one_table
from abbe.service.domain.document import Doc
from abbe.service.errors import TableRefused
from abbe.service.push.journal import Capabilities, objection
from abbe.service.site import Site
from abbe.service.storage.store import Store

KIND = "levels"
HINT = "this controller's capabilities for a safe push were never proved{}: run abbe comp commission; until then a person has to attend"
ONE_TABLE = (
    "this control has one table, so it can have the lower push level only, and this level was never commissioned{}: "
    "abbe comp commission --one-bank; until then nothing is written into the control"
)


@dataclass(frozen=True, slots=True)
class LevelStatus:
    """The capabilities that a push may rely on now. ``hint``: a warning for people; empty when they are proved."""

    capabilities: Capabilities
    hint: str

    @property
    def level(self) -> int:
        """Capability level (`abbe.service.push.journal`)."""
        return self.capabilities.level


def identity(info: DeviceInfo) -> Doc:
    """The controller's identity, for which a proof holds. It has no boot id, because a restart invalidates no proof."""
    return {"model": info.model, "serial": info.serial_no, "firmware": info.firmware}


def flags_of(capabilities: Capabilities) -> dict[str, bool]:
    """The flags of a controller by name."""
    return asdict(capabilities)


def last_proof(store: Store, site: Site) -> Doc | None:
    """Document of the last commissioning of this machine's controller; None if it was never commissioned."""
    ids = {c.id for c in store.campaigns.all() if store.machines.get(c.machine_id).name == site.name}
    last = [s for s in store.solutions.all() if s.kind == KIND and s.campaign_id in ids][-1:]
    return dict(last[0].doc) if last else None


async def level_status(controller: Identity, store: Store, site: Site) -> LevelStatus:
    """Identify the controller and return the capabilities that a push into it may rely on."""
    info = await controller.identify()
    doc = await asyncio.to_thread(last_proof, store, site)
    if doc is not None and doc["identity"] == identity(info):
        return LevelStatus(Capabilities(**{f.name: doc["flags"].get(f.name) is True for f in fields(Capabilities)}), "")
    hint = ONE_TABLE if has_one_table(controller) else HINT
    return LevelStatus(await _visible(controller), hint.format("" if doc is None else " since the controller or its firmware was replaced"))


async def _visible(controller: Identity) -> Capabilities:
    """Features that the status block shows without a test: two banks, a generation, a boot id. None of it is proved.

    A control with one table shows nothing: a person has to request its level (`abbe comp commission --one-bank`).
    """
    if has_one_table(controller):
        return Capabilities()
    now = await controller.comp_status()
    banks = now.active_bank in (0, 1) and now.bank_state[now.active_bank] is not BankState.EMPTY
    return Capabilities(two_banks=banks, generation=now.gen != 0, boot_id=now.boot_id != 0)


async def check_level(controller: Identity, store: Store, site: Site, *, attended: bool = True) -> LevelStatus:
    """Refuse a controller that allows no (attended or unattended) push, before anything is measured for it; return its level.

    Raises
    ------
    TableRefused
        The controller's level is too low.
    """
    found = await level_status(controller, store, site)
    no = objection(found.level, attended=attended)
    if no:
        raise TableRefused(no, "nothing was written")
    return found
