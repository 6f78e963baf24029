"""From a plan to the text of an NC program in one of the dialects."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from abbe.models.machine import Machine
from abbe.models.paths.circles import PLANES
from abbe.service.errors import ConfigError
from abbe.service.sequences.nc.blocks import Program, program
from abbe.service.sequences.nc.duration import Pace, Runtime, runtime
from abbe.service.sequences.nc.gcode import DIALECTS, gcode
from abbe.service.sequences.nc.heidenhain import heidenhain
from abbe.service.sequences.nc.settings import NcSettings
from abbe.service.sequences.steps import CampaignPlan

NAMES = (*DIALECTS, "heidenhain")


@dataclass(frozen=True, slots=True)
class NcProgram:
    """The text, how long it runs, and what the operator should know about its size."""

    text: str
    runtime: Runtime
    size: str
    warning: str = ""


def nc_program(name: str, machine: Machine, plan: CampaignPlan, dialect: str, settings: NcSettings | None = None) -> NcProgram:
    """The NC program of a checked plan.

    Raises
    ------
    ConfigError
        There is no such dialect.
    """
    if dialect not in NAMES:
        raise ConfigError(f"there is no NC dialect {dialect!r}", f"use one of: {', '.join(sorted(NAMES))}")
    settings = settings or NcSettings()
    arcs = ("XY",) if dialect == "heidenhain" else PLANES  # C runs in the plane across the tool's axis, which TOOL CALL names
    made = program(name, plan, machine.stroke_mm, arcs)
    pace = Pace(settings.acceleration_mm_s2)
    took = runtime(made.blocks, pace)
    made = replace(made, head=(*made.head, *_time_words(took, pace)))
    text = heidenhain(made, settings.heidenhain_tool) if dialect == "heidenhain" else gcode(made, DIALECTS[dialect])
    size, blocks = len(text.encode()), text.count("\n")
    memory = settings.memory_of(dialect)
    warning = _too_long(dialect, size, memory) if memory is not None and size > memory * 1024.0 else ""
    return NcProgram(text, took, f"{size} bytes, {blocks} blocks, {_minutes(made, took)}", warning)


def _minutes(made: Program, took: Runtime) -> str:
    return f"about {math.ceil(took.total_s / 60.0)} min without the {made.halts} stops for a person"


def _time_words(took: Runtime, pace: Pace) -> tuple[str, str]:
    """Rounded up: whoever stands beside it rather waits less than was said."""
    return (
        f"runs {math.ceil(took.total_s / 60.0)} min: {took.moving_s:.0f} s of moves, {took.resting_s:.0f} s of dwells; not counted are"
        " the stops for a person and the way to the first position",
        f"that is with {pace.acceleration_mm_s2:g} mm/s2 along the path, {pace.stop_s:g} s at each exact stop, feed override 100 percent",
    )


def _too_long(dialect: str, size: int, memory_kib: float) -> str:
    return (
        f"{size / 1024.0:.0f} KiB are more than the {memory_kib:g} KiB that a {dialect} control is taken to hold: run it from its card"
        " or by drip feed, cut the recipe, or say under [nc] memory_kib what yours holds"
    )
