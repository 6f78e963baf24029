"""One machine as a job sees it: its nominal geometry, where its devices are, and the limits that protect it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from datetime import date
from typing import Any

from abbe.models.machine import Machine
from abbe.service.config_schema import MachineFile
from abbe.service.domain.machine import AxisMaterial, DeviceUrls, Rules, machine_from_doc
from abbe.service.domain.machine_file import CaptureSettings, NcSettings
from abbe.service.errors import TableRefused
from abbe.service.push.validate import PushLimits
from abbe.service.sequences.control import Suspending, Watching


@dataclass(frozen=True, slots=True)
class Site:
    """Facts about a machine that a job needs. ``doc``: the machine object (docs/schemas/machine.schema.json).

    ``calibrated_until``: last day of the certificate of ``ballbar``, ``laser``, ``artefact``, as far as there is a certificate.
    ``two_people``: a proposed table is only pushed after approval by a person other than its proposer. ``materials``: expansion and
    stated temperature of the scales by axis. ``room_c``: range of the air temperature that a person states for a machine without a
    laser, by the room's own thermometer; valid until the day ``room`` of ``calibrated_until``.
    """

    name: str
    machine: Machine
    doc: dict[str, Any]
    urls: DeviceUrls
    limits: PushLimits = field(default_factory=PushLimits)
    max_feed_mm_min: float = 6000.0
    temperature_c: tuple[float, float] = (18.0, 24.0)
    capture: CaptureSettings = field(default_factory=CaptureSettings)
    watching: Watching = field(default_factory=Watching)
    nc: NcSettings = field(default_factory=NcSettings)
    calibrated_until: dict[str, date] = field(default_factory=dict)
    two_people: bool = False
    materials: Mapping[str, AxisMaterial] = field(default_factory=dict)
    room_c: tuple[float, float] | None = None


def site_of(config: MachineFile) -> Site:
    """Return the site that a machine file describes."""
    doc = config.machine_doc()
    devices, limits = config.devices, config.limits
    return Site(
        config.name,
        machine_from_doc(doc),
        doc,
        DeviceUrls(devices.cnc, devices.ballbar, devices.laser, devices.fixture),
        limits.for_push(),
        limits.feed_mm_min,
        limits.temperature_c,
        config.store.for_capture(),
        Watching(limits.run_temperature_c, Suspending(frozenset(limits.continue_after), limits.suspend_s, limits.settle_s)),
        NcSettings(config.nc.acceleration_mm_s2, config.nc.heidenhain_tool, {str(name): kib for name, kib in config.nc.memory_kib.items()}),
        config.calibration.until(),
        limits.two_people,
        config.material.by_axis(),
        config.calibration.room_temperature_c,
    )


def rules_of(config: MachineFile | None) -> Rules:
    """Limits of the check, certificates, allowed temperature and expansion from a machine file; empty without a file."""
    if config is None:
        return Rules()
    materials = config.material.by_axis()
    return Rules(
        config.verify.limits_um(),
        config.calibration.until(),
        config.limits.temperature_c,
        materials,
        config.calibration.identities(),
        config.issuer,
        config.item,
    )


def check_certificates(site: Site) -> None:
    """Check that an instrument has a certificate, before time is spent on measuring: without one, nothing can be pushed.

    Raises
    ------
    TableRefused
        The machine file names no certificate.
    """
    if not site.calibrated_until:
        raise TableRefused(
            "the instruments have no calibration certificate", "name them under [calibration] in the machine file; nothing was measured"
        )


INSTRUMENTS = {"ballbar": "ball-bar", "laser": "laser", "artefact": "artefact", "room": "room"}
"""Instruments that have a certificate (`abbe.service.domain.run.Run.instrument`), in words."""


def certificates(site: Site, today: date, roles: Iterable[str] = INSTRUMENTS) -> list[str]:
    """Return messages about expired certificates of these instruments."""
    return [
        f"the certificate of the {INSTRUMENTS[role]} ended on {day}: what is measured now goes into no table ([calibration] {role})"
        for role, day in ended_certificates(site, today, roles).items()
    ]


def ended_certificates(site: Site, today: date, roles: Iterable[str] = INSTRUMENTS) -> dict[str, date]:
    """Return the last valid days of the expired certificates of these instruments, by role."""
    return {role: day for role, day in site.calibrated_until.items() if role in roles and day < today}
