"""From a plan to the text of an NC program in one of the dialects."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from abbe.models.machine import Machine
from abbe.models.paths.circles import PLANES
from abbe.service.errors import ConfigError
from abbe.service.sequences.nc.blocks import Arc, Block, Dwell, Go, Program, Smooth, program
from abbe.service.sequences.nc.gcode import DIALECTS, gcode
from abbe.service.sequences.nc.heidenhain import heidenhain
from abbe.service.sequences.nc.settings import NcSettings
from abbe.service.sequences.steps import CampaignPlan, Point

# The run time counts every block as a controller drives it, not the plan's length at full feed.


@dataclass(frozen=True, slots=True)
class Pace:
    """Assumptions about a controller: acceleration along the path, and the time of an exact stop until the axes are in position."""

    acceleration_mm_s2: float = 500.0
    stop_s: float = 0.1


@dataclass(frozen=True, slots=True)
class Runtime:
    """Time in s that the axes move (stops included) and that the program dwells. Both exclude the way to the first position and the halts
    for a person."""

    moving_s: float
    resting_s: float

    @property
    def total_s(self) -> float:
        """Sum of both."""
        return self.moving_s + self.resting_s


def runtime(blocks: tuple[Block, ...], pace: Pace) -> Runtime:
    """Time of all blocks: each line or arc from standstill to standstill; a sequence without stops counts as one."""
    moving, resting, here = 0.0, 0.0, None
    smooth, run_mm, run_feed = False, 0.0, 0.0
    for block in blocks:
        match block:
            case Dwell(seconds, _):
                resting += seconds
            case Smooth(on):
                moving += one_move_s(run_mm, run_feed, pace) if run_mm else 0.0
                smooth, run_mm = on, 0.0
            case Go() | Arc():
                way = _way_mm(block, here)
                here = block.target_mm
                if smooth and (run_feed == block.feed_mm_min or not run_mm):
                    run_mm, run_feed = run_mm + way, block.feed_mm_min
                else:
                    moving += one_move_s(way, block.feed_mm_min, pace)
    return Runtime(moving + (one_move_s(run_mm, run_feed, pace) if run_mm else 0.0), resting)


def one_move_s(way_mm: float, feed_mm_min: float, pace: Pace) -> float:
    """Time in s from standstill to standstill: accelerate, run at the feed if the length allows it, brake, stop exactly."""
    if way_mm <= 0.0:
        return 0.0
    speed, rise = feed_mm_min / 60.0, pace.acceleration_mm_s2
    if way_mm < speed**2 / rise:
        return 2.0 * math.sqrt(way_mm / rise) + pace.stop_s
    return way_mm / speed + speed / rise + pace.stop_s


def _way_mm(block: Go | Arc, here: Point | None) -> float:
    if isinstance(block, Go):
        return 0.0 if here is None else math.dist(here, block.target_mm)
    a, b = ("XYZ".index(c) for c in block.plane)
    first, last = (math.atan2(p[b] - block.centre_mm[b], p[a] - block.centre_mm[a]) for p in (block.start_mm, block.target_mm))
    turn = (last - first if block.positive else first - last) % (2.0 * np.pi)
    return float(turn * math.hypot(block.start_mm[a] - block.centre_mm[a], block.start_mm[b] - block.centre_mm[b]))


NAMES = (*DIALECTS, "heidenhain")


@dataclass(frozen=True, slots=True)
class NcProgram:
    """Program text, run time, and a warning for the operator about its size."""

    text: str
    runtime: Runtime
    size: str
    warning: str = ""


def nc_program(name: str, machine: Machine, plan: CampaignPlan, dialect: str, settings: NcSettings | None = None) -> NcProgram:
    """Return the NC program of a checked plan. Raises ConfigError for an unknown dialect."""
    if dialect not in NAMES:
        raise ConfigError(f"there is no NC dialect {dialect!r}", f"use one of: {', '.join(sorted(NAMES))}")
    settings = settings or NcSettings()
    arcs = ("XY",) if dialect == "heidenhain" else PLANES  # C runs in the plane across the tool's axis, which TOOL CALL names
    made = program(name, plan, machine.stroke_mm, arcs)
    pace = Pace(settings.acceleration_mm_s2)
    took = runtime(made.blocks, pace)
    made = replace(made, head=(*made.head, *_runtime_comments(took, pace)))
    text = heidenhain(made, settings.heidenhain_tool) if dialect == "heidenhain" else gcode(made, DIALECTS[dialect])
    size, blocks = len(text.encode()), text.count("\n")
    memory = settings.memory_of(dialect)
    warning = _too_long(dialect, size, memory) if memory is not None and size > memory * 1024.0 else ""
    return NcProgram(text, took, f"{size} bytes, {blocks} blocks, {_minutes(made, took)}", warning)


def _minutes(made: Program, took: Runtime) -> str:
    return f"about {math.ceil(took.total_s / 60.0)} min without the {made.halts} stops for a person"


def _runtime_comments(took: Runtime, pace: Pace) -> tuple[str, str]:
    """Comments with the run time, rounded up: the operator should wait less than announced, not longer."""
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
