"""A report such as a demo makes it: a worn machine, corrected, with all sections filled."""

from __future__ import annotations

import numpy as np
import pytest

from abbe.service.rendering.document import Document, Lines, PictureBlock, Section
from abbe.service.rendering.model import ArrowField, Contribution, ParameterRow, PolarTrace, ResidualSeries, TableCurve
from abbe.service.rendering.plots import diagonal_plot, polar_plot, table_plot, volume_pair
from abbe.service.report.blocks import (
    RunRow,
    SummaryRow,
    parameter_pictures,
    parameter_table,
    residual_picture,
    run_table,
    setup_section,
    summary_table,
)

STROKES = (600.0, 500.0, 450.0)


def _field(rng: np.random.Generator, size: float) -> ArrowField:
    grid = np.stack(np.meshgrid(*(np.linspace(0.0, s, 5) for s in STROKES), indexing="ij"), axis=-1).reshape(-1, 3)
    t = grid / np.array(STROKES) - 0.5
    shape = np.column_stack([t[:, 0] + 0.6 * t[:, 1] * t[:, 2], -0.8 * t[:, 1] + 0.3 * t[:, 0] ** 2, 0.9 * t[:, 2] - 0.7 * t[:, 0]])
    return ArrowField(grid, size * shape + 0.6 * rng.standard_normal(grid.shape))


def _diagonals(rng: np.random.Generator, size: float) -> dict[str, tuple[list[float], list[float]]]:
    s = np.concatenate([np.linspace(0.0, 870.0, 26), np.linspace(870.0, 0.0, 26)])
    back = np.repeat([0.0, 1.0], 26)
    return {
        name: (s.tolist(), (size * (k * s / 870.0 + 0.2 * np.sin(s / 90.0) - 0.15 * back) + 0.3 * rng.standard_normal(s.size)).tolist())
        for name, k in (("ppp", 1.0), ("npp", -0.6), ("pnp", 0.4), ("ppn", 0.8))
    }


def _tables(rng: np.random.Generator) -> list[TableCurve]:
    out = []
    for a, stroke in zip("XYZ", STROKES, strict=True):
        x = np.linspace(0.0, stroke, 51)
        for i in "XYZ":
            y = (18.0 if a == i else 6.0) * (rng.uniform(-1, 1) * x / stroke + 0.3 * rng.uniform(-1, 1) * np.sin(6.0 * x / stroke))
            out.append(TableCurve(a, i, x, np.round(y, 1)))
    return out


def _residuals(rng: np.random.Generator) -> list[ResidualSeries]:
    t = np.linspace(0.0, 62.0, 6200)
    s = np.linspace(0.0, 870.0, 152)
    return [
        ResidualSeries("helix r1", "time in s", t, 0.35 * rng.standard_normal(t.size) + 0.4 * np.sin(t)),
        ResidualSeries("helix r2", "time in s", t, 0.35 * rng.standard_normal(t.size)),
        ResidualSeries("diagonal ppp", "along the diagonal in mm", s, 0.2 * rng.standard_normal(s.size)),
        ResidualSeries("diagonal npp", "along the diagonal in mm", s, 0.2 * rng.standard_normal(s.size)),
    ]


PARAMETERS = [
    ParameterRow("EXX slope", -86.4, 1.2, "µm/m", "positioning of X"),
    ParameterRow("EYY slope", 41.0, 1.4, "µm/m", ""),
    ParameterRow("EZZ slope", 12.3, 2.2, "µm/m", ""),
    ParameterRow("C0Y", 21.04, 0.61, "µrad", "squareness of Y to X"),
    ParameterRow("B0Z", -14.7, 0.83, "µrad", ""),
    ParameterRow("A0Z", 0.9, 0.79, "µrad", "not different from zero"),
    ParameterRow("backlash X", 3.12, 0.11, "µm", "lost motion"),
    ParameterRow("cup B1 x", 12.1, 0.4, "µm", "set-up"),
    ParameterRow("bar length 150", -0.4, 0.12, "µm", "set-up"),
]


SUMMARY = [
    SummaryRow("Volumetric error, largest", "µm", 41.31, 6.12, 0.52, 0.48),
    SummaryRow("Volumetric error, rms", "µm", 18.204, 2.911, 0.31, 0.28),
    SummaryRow("Body-diagonal figure", "µm", 33.7, 4.2, 0.6, 0.6),
    SummaryRow("Volumetric error, largest", "µm", 40.9, 5.8, source="sealed truth of the simulator"),
]
RUNS = [
    RunRow("helix r1", "ballbar_helix", "identify", 6200, 0.47, 0.35, 3),
    RunRow("helix r2", "ballbar_helix", "holdout", 6200, 0.35, 0.35, 0),
    RunRow("diagonal ppp", "laser_diagonal", "identify", 152, 0.21, 0.2, 0),
    RunRow("diagonal npp", "laser_diagonal", "identify", 152, 0.2, 0.2, 1),
]
RANKED = [
    Contribution("EXX (positioning of X)", 25.9, 0.4),
    Contribution("C0Y (squareness)", 10.5, 0.3),
    Contribution("EYY (positioning of Y)", 10.2, 0.4),
    Contribution("backlash X", 3.1, 0.1),
    Contribution("EZZ (positioning of Z)", 5.5, 1.0),
]


@pytest.fixture
def full_report() -> Document:
    rng = np.random.default_rng(7)
    angle = np.linspace(0.0, 1080.0, 720)
    residuals, tables = _residuals(rng), _tables(rng)
    vectors = volume_pair(_field(rng, 38.0), _field(rng, 3.0))
    diagonals = diagonal_plot(_diagonals(rng, 24.0), _diagonals(rng, 3.0))
    circle = polar_plot(
        [
            PolarTrace("before", angle, 12.0 * np.sin(np.radians(2.0 * angle + 30.0)) + 0.3 * rng.standard_normal(angle.size)),
            PolarTrace("after", angle, 1.2 * np.sin(np.radians(2.0 * angle)) + 0.3 * rng.standard_normal(angle.size)),
        ]
    )
    log = ["03:38:02 lease taken", "03:38:05 bank 1 written and read back, equal", "03:38:06 activated", "03:39:51 verified"]
    before = [summary_table(SUMMARY), PictureBlock("Error vectors.", vectors), PictureBlock("Body diagonals.", [diagonals], "wide")]
    machine = [p for p in PARAMETERS if p.note != "set-up"]
    parameters = [*parameter_pictures(PARAMETERS, RANKED), PictureBlock("Circle.", [circle])]
    return Document(
        kind="cycle",
        title="Worn VMC: measured, corrected, verified",
        about={"Machine": "VMC-1", "Chain": "w-X-Y-b-Z-t", "Made": "2026-11-21 03:40:12 UTC"},
        verdict=("ok", "Accepted", "Volumetric error fell from 41.3 µm to 6.1 µm; both verification runs agree."),
        remarks=["Air temperature rose by 0.8 K during the session."],
        sections=[
            Section("Before and after", before),
            Section("Identified parameters", [*parameters, parameter_table(machine), *setup_section(PARAMETERS)]),
        ],
        not_observable=["EAZ together with tool offset: both tests use one tool length."],
        appendix=[
            Section("Compensation tables", [PictureBlock("Tables.", [table_plot(tables, lsb_um=0.1)], "wide"), Lines(log, numbered=True)]),
            Section("Residuals", residual_picture(residuals, RUNS)),
            Section("Runs", [run_table(RUNS)]),
        ],
        provenance={"Seed": "7", "abbe": "0.1.0", "numpy": "2.4.6", "active table": "0x1A2B3C4D, CRC 0x99AA17F0"},
        signatures=(),
    )


@pytest.fixture
def minimal_report() -> Document:
    return Document(kind="cycle", title="Nothing yet", verdict=("open", "Undecided", "No measurement was made."), signatures=())
