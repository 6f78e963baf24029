"""The instruments file of `abbe plan --instruments FILE.toml`: available bars, noise of the instruments, duration of set-ups."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from abbe.models.planning.instruments import BAR_LENGTHS_MM, Instruments, SetupMinutes
from abbe.service.config import read_toml
from abbe.service.errors import ConfigError
from abbe.service.explain import expected, location_text, nearest
from abbe.service.site import Site

USUAL = SetupMinutes()
Micrometres = Annotated[float, Field(gt=0.0, le=1000.0)]
Minutes = Annotated[float, Field(ge=0.0, le=1440.0)]
Length = Annotated[float, Field(ge=10.0, le=2000.0)]


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True)


class SetupTable(_Table):
    """``[setup]``: minutes that a person needs."""

    cup_min: Minutes = USUAL.cup
    bar_min: Minutes = USUAL.bar
    line_min: Minutes = USUAL.line
    diagonal_min: Minutes = USUAL.diagonal


class InstrumentsFile(_Table):
    """Available instruments; an omitted key keeps its default."""

    bar_lengths_mm: tuple[Length, ...] = BAR_LENGTHS_MM
    laser: bool = True
    bar_noise_um: Micrometres = 0.5
    laser_noise_um: Micrometres = 0.3
    bar_length_u_um: Micrometres = 2.0
    setup: SetupTable = SetupTable()


def read_instruments(path: Path | None) -> Instruments:
    """Read instruments from a file, or return the planner's defaults. Raises ConfigError with file, key and expected value."""
    if path is None:
        return Instruments()
    if not path.exists():
        raise ConfigError(f"instruments file {path} does not exist", "docs/how-to/plan.md shows one")
    content = read_toml(path, "instruments file")
    try:
        found = InstrumentsFile.model_validate_json(json.dumps(content, default=str), strict=True)
        times = SetupMinutes(found.setup.cup_min, found.setup.bar_min, found.setup.line_min, found.setup.diagonal_min)
        return Instruments(
            tuple(sorted(set(found.bar_lengths_mm))),
            found.laser,
            found.bar_noise_um * 1e-3,
            found.laser_noise_um * 1e-3,
            u_bar_length_mm=found.bar_length_u_um * 1e-3,
            setup=times,
        )
    except ValidationError as error:
        first = error.errors()[0]
        place = first["loc"]
        if first["type"] == "extra_forbidden":
            table = SetupTable if place[0] == "setup" and len(place) > 1 else InstrumentsFile
            raise ConfigError(f"{path}: unknown key {location_text(place)!r}", nearest(str(place[-1]), table.model_fields)) from None
        raise ConfigError(f"{path}: {location_text(place)}: {expected(first)}", "correct it; docs/how-to/plan.md shows a file") from None
    except ValueError as error:
        raise ConfigError(f"{path}: {error}", "give bar_lengths_mm or laser = true") from None


def at_this_machine(tools: Instruments, site: Site) -> tuple[Instruments, tuple[str, ...]]:
    """Return the instruments that a machine can use, and messages about those left out.

    A machine file that names a ball-bar or a laser under ``[devices]`` has no other; one that names neither is planned with all.

    Raises
    ------
    ConfigError
        No instrument is left.
    """
    tools = replace(tools, max_feed_mm_min=site.max_feed_mm_min)
    has_bar, has_laser = site.urls.ballbar is not None, site.urls.laser is not None
    if not has_bar and not has_laser:
        return tools, ()
    messages = []
    if tools.laser and not has_laser:
        messages.append("planned without laser: the machine file names none under [devices]")
    if tools.bar_lengths_mm and not has_bar:
        messages.append("planned without ball-bar: the machine file names none under [devices]")
    try:
        return replace(tools, laser=tools.laser and has_laser, bar_lengths_mm=tools.bar_lengths_mm if has_bar else ()), tuple(messages)
    except ValueError:
        remedy = "correct the instruments file, or name under [devices] what it lists"
        raise ConfigError(f"nothing to measure with: {'; '.join(messages)}", remedy) from None
