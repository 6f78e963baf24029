"""What many tests need and do not test: a control whose sign, axis and unit count as proved."""

from __future__ import annotations

from abbe.drivers.api import Controller
from abbe.drivers.registry import open_controller
from abbe.service.compensation.commission import KIND
from abbe.service.compensation.proved_levels import KIND as LEVELS
from abbe.service.compensation.proved_levels import flags_of, identity
from abbe.service.push.journal import Capabilities
from abbe.service.site import Site
from abbe.service.storage.store import Store

NAME = f"{KIND} pretended"


async def as_if_commissioned(controller: Controller, store: Store, site: Site) -> None:
    """Put a proof of this control into the store, as a commissioning would that had found nothing wrong."""
    if any(c.name == NAME for c in store.campaigns.all()):
        return
    machine = store.machines.add(site.name, site.doc)
    campaign = store.campaigns.add(machine, NAME, {})
    store.solutions.add(campaign, KIND, [], {"proved": True, "faults": [], "identity": identity(await controller.identify())})


async def as_if_commissioned_at(url: str, store: Store, site: Site) -> None:
    """The same for a control that nobody has opened."""
    controller = await open_controller(url)
    try:
        await as_if_commissioned(controller, store, site)
    finally:
        await controller.close()


async def as_if_proved_for_nobody_there(controller: Controller, store: Store, site: Site) -> None:
    """The same for what the control does for a push that nobody attends."""
    machine = store.machines.add(site.name, site.doc)
    campaign = store.campaigns.add(machine, f"{LEVELS} pretended", {})
    flags = flags_of(Capabilities(*[True] * 6)) | {"can_disable": True}
    store.solutions.add(campaign, LEVELS, [], {"identity": identity(await controller.identify()), "flags": flags})
