"""The devices of the machine for the screen `/devices`, from core and store; the screen contacts no device."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from datetime import date

from abbe.service.compensation.proved_levels import KIND
from abbe.service.domain.device_status import DeviceStatus
from abbe.service.domain.measured import CampaignRecord
from abbe.service.secrets import mask_secrets
from abbe.service.sequences.journal import Trouble, troubles
from abbe.service.storage.store import Store

CAMPAIGNS = 10
"""Number of latest campaigns that are searched for incidents."""
INSTRUMENTS = ("ballbar", "laser")
SOON_DAYS = 30
CONTROLLER = "cnc"
PROOFS = 20


@dataclass(frozen=True, slots=True)
class Certificate:
    """The certificate of an instrument. ``until``: last valid day, None: unknown; ``days``: days left, negative: expired."""

    until: date | None
    days: int = 0

    @property
    def sign(self) -> str:
        """``ok``, ``bad`` (expired), or ``open`` (expires within `SOON_DAYS`, or unknown)."""
        if self.until is None:
            return "open"
        return "bad" if self.days < 0 else "open" if self.days < SOON_DAYS else "ok"


@dataclass(frozen=True, slots=True)
class DeviceLine:
    """One device. ``url``: without passwords; ``certificate``: None unless it is an instrument; ``firmware``: empty if unknown."""

    device: DeviceStatus
    url: str
    certificate: Certificate | None
    firmware: str = ""


@dataclass(frozen=True, slots=True)
class DeviceScreen:
    """Devices and the incidents of their connections, from ``campaigns`` campaigns."""

    lines: Sequence[DeviceLine]
    incidents: Sequence[Trouble]
    campaigns: int


def device_screen(
    store: Store, machine: str, devices: Sequence[DeviceStatus], until: Mapping[str, date] | None, today: date
) -> DeviceScreen:
    """The devices of a machine, and the incidents of their connections in its latest campaigns."""
    own = {record.id for record in store.machines.all() if record.name == machine}
    campaigns = latest_of(store, own)
    latest, numbers = campaigns[-CAMPAIGNS:], {c.id for c in campaigns}
    journal = [entry for campaign in latest for entry in store.checkpoints.of_campaign(campaign.id)]
    proof = next((one.doc for one in store.solutions.latest(KIND, PROOFS) if one.campaign_id in numbers), {})
    known = proof.get("identity") or {}
    firmware = " ".join(str(known[k]) for k in ("model", "firmware") if known.get(k))
    lines = [
        DeviceLine(d, mask_secrets(d.url), _certificate(d.role, until or {}, today), firmware if d.role == CONTROLLER else "")
        for d in devices
    ]
    return DeviceScreen(lines, list(reversed(troubles(journal))), len(latest))


def latest_of(store: Store, machines: Collection[int]) -> list[CampaignRecord]:
    """Campaigns of the given machine descriptions, oldest first."""
    return [c for c in store.campaigns.all() if c.machine_id in machines]


def _certificate(role: str, until: Mapping[str, date], today: date) -> Certificate | None:
    if role not in INSTRUMENTS:
        return None
    last = until.get(role)
    return Certificate(None) if last is None else Certificate(last, (last - today).days)
