"""Examine a machine and this computer without moving anything: file, devices, permissions, locks, clock, disk, database, certificates."""

from __future__ import annotations

import os
import shutil
from collections.abc import AsyncIterator, Callable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, Literal

from abbe.drivers import registry
from abbe.drivers.errors import DriverError
from abbe.drivers.links.urls import installed, parse_url, split_report, untested_remedy
from abbe.service.campaigns.plausibility import check_plausibility
from abbe.service.config import LoadedMachine
from abbe.service.devices.session import lock_machine, no_console
from abbe.service.errors import AbbeError, MachineInUse
from abbe.service.secrets import mask_secrets
from abbe.service.site import Site, site_of
from abbe.service.storage.engine import database_readable_by_others
from abbe.service.storage.engine import parse_url as parse_database
from abbe.service.storage.store import Store

State = Literal["good", "look", "bad"]
FREE_BYTES, FREE_LOW_BYTES = 5 * 10**9, 10**9
"""Free space of the database's disk, bytes: less than the first is worth a look, less than the second is bad (a campaign takes 0.1 GB)."""
SYNCHRONISED = Path("/run/systemd/timesync/synchronized"), Path("/run/chrony"), Path("/run/ntpd.pid")
"""A file or folder of a program that sets the clock."""
SOON = timedelta(days=30)


@dataclass(frozen=True, slots=True)
class Examined:
    """One finding: ``good``, ``look`` (works, but look at it) or ``bad`` (Abbe cannot work), and what to do."""

    what: str
    state: State
    text: str
    remedy: str = ""


async def examine(loaded: LoadedMachine, now: datetime) -> AsyncIterator[Examined]:
    """Yield the findings one by one. Connects to every device, reads, and moves nothing.

    Devices that another process is using are left alone.
    """
    site = site_of(loaded.machine)
    for one in (*_file(loaded, now), *_certificates(loaded, now), *_place(loaded), *_database(loaded, now), *_clock(), *_ports(site)):
        yield one
    try:
        with lock_machine(site.urls.cnc):
            yield Examined("lock", "good", "no other process uses this machine")
            async for one in _devices(site):
                yield one
    except MachineInUse as error:
        yield Examined("lock", "look", f"{error.detail}: its devices are left alone", error.remedy)
    except AbbeError as error:
        yield Examined("lock", "bad", error.detail, error.remedy)


def _file(loaded: LoadedMachine, now: datetime) -> Iterator[Examined]:
    found = check_plausibility(loaded.machine, loaded.path.resolve().parent, now.date())
    yield from (Examined("machine file", "bad", line, "correct the machine file") for line in found.errors)
    yield from (Examined("machine file", "look", line, "correct the machine file if this is not intended") for line in found.warnings)
    if found.good:
        yield Examined("machine file", "good", str(loaded.path))


def _certificates(loaded: LoadedMachine, now: datetime) -> Iterator[Examined]:
    name = loaded.machine.web.certificate
    if not name:
        return
    from cryptography.x509 import load_pem_x509_certificate

    path = loaded.path.resolve().parent / name
    try:
        ends = load_pem_x509_certificate(path.read_bytes()).not_valid_after_utc
    except (OSError, ValueError) as error:
        yield Examined("certificate of the page", "bad", f"{path}: {error}", "give a readable PEM file under [web] certificate")
        return
    state: State = "bad" if ends < now else "look" if ends < now + SOON else "good"
    yield Examined("certificate of the page", state, f"{path} is valid until {ends:%Y-%m-%d}", "" if state == "good" else "renew it")


def _place(loaded: LoadedMachine) -> Iterator[Examined]:
    """Examine the folder of a SQLite file: its rights and its free space."""
    parsed = parse_database(loaded.database_url)
    if parsed.drivername != "sqlite" or not parsed.database or parsed.database == ":memory:":
        return
    folder = Path(parsed.database).parent
    if not os.access(folder, os.W_OK | os.X_OK):
        yield Examined("disk", "bad", f"{folder} cannot be written by this account", "make the folder, or change its rights")
        return
    free = shutil.disk_usage(folder).free
    state: State = "bad" if free < FREE_LOW_BYTES else "look" if free < FREE_BYTES else "good"
    yield Examined("disk", state, f"{free / 1e9:.1f} GB are free in {folder}", "" if state == "good" else "make room")


def _database(loaded: LoadedMachine, now: datetime) -> Iterator[Examined]:
    url = loaded.database_url
    shown, parsed = mask_secrets(url), parse_database(url)
    if parsed.drivername == "sqlite" and parsed.database and not Path(parsed.database).exists():
        yield Examined("database", "good", f"{shown} is not there yet: the first measurement makes it")
        return
    try:
        with Store.open(url) as store:
            last = store.audit.events(1)
            yield Examined("database", "good", f"{shown}: {len(store.campaigns.all())} campaigns")
    except AbbeError as error:
        yield Examined("database", "bad", error.detail, error.remedy)
        return
    if warning := database_readable_by_others(url):
        yield Examined("database", "look", *warning.rsplit(" - ", 1))
    if last and datetime.fromisoformat(last[0].utc).replace(tzinfo=UTC) > now + timedelta(minutes=1):
        yield Examined(
            "clock", "bad", f"the newest record is of {last[0].utc}, later than this computer's {now:%Y-%m-%d %H:%M}", "set the clock"
        )


def _clock() -> Iterator[Examined]:
    if any(path.exists() for path in SYNCHRONISED):
        yield Examined("clock", "good", "a time service sets it")
    else:
        yield Examined("clock", "look", "no time service is seen", "start one (systemd-timesyncd, chrony), or set the clock by hand")


def _ports(site: Site) -> Iterator[Examined]:
    """Examine the rights on serial ports, because the error from opening a port is less clear."""
    for role in site.urls.named():
        try:
            port = getattr(parse_url(getattr(site.urls, role)), "path", None)
        except DriverError:  # the URL of an installed driver
            continue
        if port is None or not Path(port).exists() or os.access(port, os.R_OK | os.W_OK):
            continue
        yield Examined(f"{role}: rights", "bad", f"{port} may not be used by this account", "join the group of the port, mostly dialout")


async def _devices(site: Site) -> AsyncIterator[Examined]:
    opens: dict[str, Callable[[str], Any]] = {
        "cnc": registry.open_controller,
        "ballbar": registry.open_ballbar,
        "laser": registry.open_laser,
        "fixture": lambda url: registry.open_fixture(url, no_console),
    }
    for role, opened in opens.items():
        url = getattr(site.urls, role)
        if url is None and role == "cnc":
            yield Examined(role, "look", "not in the machine file: only `abbe listen` can measure", "add cnc = ... under [devices]")
            continue
        if url is None:
            yield Examined(role, "look", "not in the machine file", f"add {role} = ... under [devices], if there is one")
            continue
        try:
            device = await opened(url)
        except (AbbeError, DriverError) as error:
            yield _failed(role, error)
            continue
        try:
            yield _answered(role, url, await _read(role, device))
        except (AbbeError, DriverError) as error:
            yield _failed(role, error)
        finally:
            await device.close()


def _answered(role: str, url: str, what: str) -> Examined:
    """Return the finding about a device that answers; a driver from a package without a test report has to be tested first."""
    if installed(url) is None or split_report(url)[1]:
        return Examined(role, "good", f"{url}: {what}")
    return Examined(role, "look", f"{url}: {what}; its driver is not tested", untested_remedy(url))


def _failed(role: str, error: AbbeError | DriverError) -> Examined:
    text = str(error).removesuffix(f" ({error.remedy})").removesuffix(f" - {error.remedy}")
    return Examined(role, "bad", f"{error.code}: {text}", error.remedy)


async def _read(role: str, device: Any) -> str:
    """Identify a device and take one reading; return both as text."""
    who = await device.identify()
    if role == "fixture":
        return str(who)
    name = ", ".join(
        filter(None, (who.model, who.serial_no and f"serial number {who.serial_no}", who.firmware and f"firmware {who.firmware}"))
    )
    if role == "laser":
        from abbe.service.campaigns.device_checks import check_sensors

        reading = await device.peek()
        check_sensors(role, reading)
        return f"{name}; air {reading.air_temp_c:.1f} °C, {reading.air_pressure_pa / 100:.0f} hPa"
    if role == "cnc":
        status = await device.status()
        at = ", ".join(f"{value:.3f}" for value in status.position_mm)
        return f"{name}; axes at {at} mm"
    return name
