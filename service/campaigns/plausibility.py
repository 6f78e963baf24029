"""Checks of a machine file that connect to nothing: faults, and probable mistakes.

Errors and probable mistakes in a machine file are found at once, not by the schedule at night. `abbe.service.config_schema` refuses
impossible values (a stroke of 1e9 mm, 68 degrees C) when it reads the file.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING

from abbe.drivers.device_file import load
from abbe.drivers.errors import DriverError
from abbe.drivers.links.urls import FixtureConsoleUrl, described_by, installed, parse_url
from abbe.service.config_schema import MachineFile
from abbe.service.domain.schedule import Schedule
from abbe.service.errors import AbbeError, ConfigError
from abbe.service.site import INSTRUMENTS, Site, certificates, site_of

if TYPE_CHECKING:
    from abbe.service.sequences.steps import CampaignPlan

SMALL_MM, LARGE_MM = 200.0, 20_000.0
"""A longest axis outside these limits is possible but rare."""
ROOM_C = (10.0, 35.0)
"""A window of the air temperature beyond this is possible but rare."""
LONG_VALID_YEARS = 10


@dataclass(frozen=True, slots=True)
class Plausibility:
    """Errors, and values that are valid but rarely intended; one line each."""

    errors: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()

    @property
    def good(self) -> bool:
        """Whether there are no errors and no warnings."""
        return not self.errors and not self.warnings


def check_plausibility(config: MachineFile, folder: Path, today: date) -> Plausibility:
    """Check a whole machine file without connecting to anything. ``folder``: folder of the machine file and the recipe files."""
    site = site_of(config)
    rare = [*_strokes(config), *_window(config), *certificates(site, today), *_far(site, today), *_none(site)]
    return Plausibility((*_device_files(site), *unattended(config, site, folder)), tuple(rare))


def _device_files(site: Site) -> list[str]:
    """Return faults of the device files that the addresses name; no device is connected."""
    found = []
    for role in ("cnc", "laser", "ballbar"):
        url = getattr(site.urls, role)
        if url is not None and installed(url) is None and (named := described_by(parse_url(url))):
            try:
                load(named.device)
            except DriverError as error:
                found.append(f"devices.{role}: {error}")
    return found


def check_unattended(config: MachineFile, folder: Path) -> None:
    """Raise ConfigError with all reasons why a schedule could not run, in one line."""
    found = unattended(config, site_of(config), folder)
    if found:
        raise ConfigError("; ".join(found), "correct the machine file; `abbe check-config` lists all of this")


def unattended(config: MachineFile, site: Site, folder: Path) -> list[str]:
    """Return the reasons why scheduled checks and their automatic follow-ups could not run: recipe, strokes, feed, devices, fixture."""
    if not config.schedule:
        return []

    from abbe.service.sequences.check import paced
    from abbe.service.sequences.recipes.campaigns import campaign_source, recipe_plan

    found = []
    for entry in config.schedule:
        found += _lines(entry, site, lambda entry=entry: recipe_plan(entry.recipe, site.machine))  # type: ignore[misc]
        if entry.on_alarm == "propose":
            found += _lines(
                entry, site, lambda: paced(campaign_source(config.alarm.campaign, folder).plan(site.machine), site.max_feed_mm_min)
            )
    return list(dict.fromkeys(found))


def _lines(entry: Schedule, site: Site, plan: Callable[[], CampaignPlan]) -> list[str]:
    from abbe.service.campaigns.device_checks import check_configured, needed_by
    from abbe.service.sequences.check import dry_run_campaign

    try:
        made = plan()
        dry_run_campaign(site.machine, made, site.max_feed_mm_min)
        check_configured(needed_by(made, air=site.watching.air_c is not None), site.urls.named())
        if site.urls.fixture is not None and isinstance(parse_url(site.urls.fixture), FixtureConsoleUrl):
            raise ConfigError("the fixture is the console, which is unattended in a schedule", "configure a remote fixture under [devices]")
    except AbbeError as error:
        return [f"schedule {entry.name!r}: {error}"]
    return []


def _strokes(config: MachineFile) -> list[str]:
    lengths = {axis: high - low for axis, (low, high) in config.stroke_mm.model_dump().items()}
    axis, longest = max(lengths.items(), key=lambda pair: pair[1])
    if longest < SMALL_MM and not config.short_strokes:
        return [f"the longest axis has {longest:g} mm: are the strokes inches? (stroke_mm; short_strokes = true if they are not)"]
    return [f"stroke_mm.{axis} is {longest:g} mm long: is that intended?"] if longest > LARGE_MM else []


def _window(config: MachineFile) -> list[str]:
    low, high = config.limits.temperature_c
    if low >= ROOM_C[0] and high <= ROOM_C[1]:
        return []
    return [
        f"limits.temperature_c is {low:g} to {high:g} degrees C: is that intended? a table holds at the temperature that it was measured at"
    ]


def _far(site: Site, today: date) -> list[str]:
    far = {role: day for role, day in site.calibrated_until.items() if day.year - today.year > LONG_VALID_YEARS}
    return [
        f"the certificate of the {INSTRUMENTS[role]} ends in {day.year}: is the year right? ([calibration] {role})"
        for role, day in far.items()
    ]


def _none(site: Site) -> list[str]:
    without = [role for role in INSTRUMENTS if role in site.urls.named() and role not in site.calibrated_until]
    return [f"the {INSTRUMENTS[role]} has no certificate: what it measures goes into no table ([calibration] {role})" for role in without]
