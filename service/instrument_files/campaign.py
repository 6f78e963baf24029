"""Files of instruments as one campaign: settled tests become runs, everything else is kept beside them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from abbe.models.arrays import F1
from abbe.models.machine import AXES
from abbe.service.domain.document import Doc
from abbe.service.domain.run import PLACES, Columns, Run, RunTiming, parsed_setup
from abbe.service.domain.run_file import ASSUMED_MODEL, CAMPAIGN_FORMAT, CampaignFile, SourceFile
from abbe.service.errors import FileFormatError
from abbe.service.instrument_files.answers import LENGTHS, Answers, laser_of, settled, unknown_of
from abbe.service.instrument_files.content import AxisReadings, Content, Trace
from abbe.service.runs.checks import check, check_run
from abbe.service.runs.exchange import FolderContent

NEAREST_MM = 0.1
"""Least distance of two targets: evaluations round positions to 0.05 mm."""
ASSUMED_CHAIN = "w-b-X-Y-Z-t"
PAUSE_S = 60.0
"""Time between the tests of two files on the campaign's clock, s, if their times are unknown."""
MOST_SAMPLES = 100_000
"""Largest number of values from a trace; a longer one is averaged in blocks."""
COUNTED = RunTiming.from_document({"counted": True})
"""Timing of a run whose file has no times."""


@dataclass(frozen=True, slots=True)
class Made:
    """A campaign made of files, checked like a campaign folder; ``origins``: origin of each file, in order."""

    folder: FolderContent
    origins: tuple[SourceFile, ...]


def campaign_of(contents: Sequence[Content], answers: Answers, name: str, machine: Doc | None) -> Made:
    """Make one campaign of files of one machine.

    Parameters
    ----------
    contents : sequence of Content
        One for each file.
    answers : Answers
        Used for every file that does not answer the question itself.
    name : str
        Name of the campaign.
    machine : dict, optional
        Machine object of a machine file. Without it, chain and strokes are assumed, and every origin states that.

    Raises
    ------
    FileFormatError
        A question is open, two files name different machines, one file is given twice, or a test cannot be stored.
    """
    _check_together(contents)
    tests = [settled(content, answers) for content in contents]
    traces = [_standstill(content.trace, answers) for content in contents if content.trace is not None]
    linear = [test for test in tests if test is not None and _is_run(test)]
    measured = [(test.axis, test.position_mm) for test in tests if test is not None]
    measured += [(axis, columns[f"{axis.lower()}_mm"]) for columns, axis in traces]
    made = machine or _assumed_machine(contents, measured)
    runs, start = list[Run](), 0.0
    timings = [COUNTED if test.t_s is None else RunTiming() for test in linear] + [RunTiming() for _ in traces]
    for (columns, axis), timing in zip([*((_columns(test), test.axis) for test in linear), *traces], timings, strict=True):
        run = _run(name, len(runs) + 1, made, axis, {k: v + start if k == "t_s" else v for k, v in columns.items()})
        run = replace(run, timing=timing)
        start = float(run.columns.t_s[-1]) + PAUSE_S
        runs.append(run)
    origins = [_origin(*one, machine) for one in zip(contents, tests, strict=True)]
    instruments = {"laser": laser_of(linear)} if linear else {}
    further = {"origins": [one.model_dump() for one in origins]} | _beside(contents, tests)
    return Made(checked_campaign(name, made, runs, {"instruments": instruments} | further), tuple(origins))


def checked_campaign(name: str, machine: Doc, runs: Sequence[Run], further: Doc) -> FolderContent:
    """Make a campaign of runs that come from files, and check it like a campaign folder; ``further``: the other keys of its document.

    Raises
    ------
    FileFormatError
        A run or the campaign violates its format.
    """
    document = {
        "format": CAMPAIGN_FORMAT,
        "campaign": name,
        "machine": machine,
        "current_model": {"includes": list(ASSUMED_MODEL), "errors": None},
        "setups": {run.setup.setup_id: {"kind": run.instrument, "t_set_s": run.setup.t_set_s} for run in runs},
        "temperature_sensors": any(run.columns.temperatures_c for run in runs),
        "runs": [{"run_id": run.run_id, "test": run.test, "role": run.role, "file": f"{run.run_id}.json"} for run in runs],
    } | further
    files = [run.to_document() for run in runs]
    for run, file in zip(runs, files, strict=True):
        check_run(Path(f"{run.run_id}.json"), file)
    check(Path("campaign.json"), document, CampaignFile)
    return FolderContent(document, files, [run.with_artefact(document) for run in runs], None, {})


def _check_together(contents: Sequence[Content]) -> None:
    seen = dict[str, str]()
    for content in contents:
        if content.sha256 in seen:
            raise FileFormatError(f"{content.name}: it is a copy of {seen[content.sha256]}", "give every measurement once")
        seen[content.sha256] = content.name
    named = {content.machine: content.name for content in contents if content.machine}
    if len(named) > 1:
        listing = ", ".join(f"{machine!r} ({file})" for machine, file in named.items())
        raise FileFormatError(f"the files name different machines: {listing}", "import the files of each machine separately")


def _is_run(test: AxisReadings) -> bool:
    return test.quantity == "length" and bool((test.direction != 0.0).all())


def _assumed_machine(contents: Sequence[Content], measured: Sequence[tuple[str, F1]]) -> Doc:
    stroke = {axis: [-1.0, 1.0] for axis in AXES}
    for axis in AXES:
        places = [value for name, position in measured if name == axis for value in position]
        if places:
            low, high = float(min(places)), float(max(places))
            stroke[axis] = [low, high] if low < high else [low - 1.0, high + 1.0]
    name = next((content.machine for content in contents if content.machine), "unknown machine")
    return {"name": name, "chain": ASSUMED_CHAIN, "vertical_axis": "Z", "stroke_mm": stroke}


def _columns(test: AxisReadings) -> dict[str, F1]:
    n = test.position_mm.size
    targets = np.unique(test.position_mm)
    if targets.size > 1 and np.diff(targets).min() < NEAREST_MM:
        raise FileFormatError(
            f"targets are closer than {NEAREST_MM:g} mm: they would count as one",
            "check the unit of the targets; if it is right, leave out every second target",
        )
    zero = np.zeros(n)
    places = {place: test.position_mm if place == f"{test.axis.lower()}_mm" else zero for place in PLACES}
    return {
        "t_s": np.arange(n, dtype=np.float64) if test.t_s is None else test.t_s - test.t_s[0],
        **places,
        "feed_mm_min": np.full(n, test.feed_mm_min or 0.0),
        "direction": test.direction,
        "deviation_mm": test.deviation,
        **test.further,
    }


def _standstill(trace: Trace, answers: Answers) -> tuple[dict[str, F1], str]:
    """A trace of a standing axis as columns, averaged in blocks if it is long: displacement since its first sample."""
    axis = trace.axis or str(answers.axis)
    block = -(-trace.samples.size // MOST_SAMPLES)
    n = trace.samples.size // block
    mean = trace.samples[: n * block].reshape(n, block).mean(axis=1) * LENGTHS[str(answers.unit)]
    zero, at = np.zeros(n), np.full(n, float(answers.at_mm or 0.0))
    places = {place: at if place == f"{axis.lower()}_mm" else zero for place in PLACES}
    t = (np.arange(n) + 0.5 * (block - 1) / block) * block / trace.rate_hz
    return {"t_s": t, **places, "feed_mm_min": zero, "direction": zero + 1.0, "deviation_mm": mean - mean[0]}, axis


def _run(campaign: str, number: int, machine: Doc, axis: str, columns: Mapping[str, F1]) -> Run:
    """Return a run that starts at the lowest and ends at the highest target, so that deviations count along + of the axis."""
    unit, at, parsed = np.eye(3)[AXES.index(axis)], columns[f"{axis.lower()}_mm"], Columns.from_document(dict(columns))
    setup = {
        "setup_id": f"L{number}",
        "t_set_s": float(parsed.t_s[0]),
        "axis": axis,
        "start_mm": (unit * at.min()).tolist(),
        "end_mm": (unit * at.max()).tolist(),
        "nominal_beam": unit.tolist(),
    }
    return Run(
        campaign=campaign, run_id=f"r{number:02d}", test="laser_linear", role="identify", machine=machine,
        setup=parsed_setup("laser_linear", setup), columns=parsed,
    )  # fmt: skip


def _origin(content: Content, test: AxisReadings | None, machine: Doc | None) -> SourceFile:
    unknown = [] if test is None else unknown_of(test)
    if machine is None:
        unknown.append(
            f"chain and strokes of the machine: {ASSUMED_CHAIN} and the measured length are assumed (--machine FILE states them)"
        )
    return SourceFile(file=content.name, format=content.form, sha256=content.sha256, said=dict(content.said), unknown=unknown)


def _beside(contents: Sequence[Content], tests: Sequence[AxisReadings | None]) -> Doc:
    """Return readings that no run holds, and stated figures; empty if there are none."""
    readings = [
        {
            "kind": "angle" if test.quantity == "angle" else "mean",
            "file": content.name,
            "setup_id": f"A{number}",
            "axis": test.axis,
            "position_mm": test.position_mm.tolist(),
            "direction": test.direction.astype(int).tolist(),
            "deviation": test.deviation.tolist(),
            "resolution": test.resolution,
        }
        for number, (content, test) in enumerate(zip(contents, tests, strict=True), start=1)
        if test is not None and not _is_run(test)
    ]
    stated = [one.model_dump() for content in contents for one in content.stated]
    return {key: value for key, value in (("readings", readings), ("stated", stated)) if value}
