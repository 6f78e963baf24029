"""Curves that somebody measured, from ../shared/data, scaled to the strokes and sizes of a machine.

Sources (../shared/data/README.md): positions of slit axes against an external sensor and resolvers (bifrost), the temperature of a
lathe's spindle over eighteen days (thermal-lathe), a roundness trace of a nano-measuring machine (interferometer). Only their shapes are
used: without mean and slope, of unit size, turned about or upside down at random, and only a part of the longer ones.
"""

import csv
import gzip
import json
from functools import cache
from pathlib import Path

import numpy as np
from python_calamine import CalamineWorkbook

from tests.experiments.calibration.curves import Rng
from tests.experiments.calibration.kinematics import Curve, F

SHARED = Path(__file__).resolve().parents[4] / "shared" / "data" / "foreign"


def foreign(rng: Rng, length_mm: float, size: float) -> Curve:
    """One or two measured shapes added; between their points straight."""
    shapes = _shapes()
    x = np.linspace(0.0, length_mm, 400)
    y = sum(weight * _part(rng, shapes[int(rng.integers(len(shapes)))], x.size) for weight in (1.0, 0.5 * rng.integers(2)))
    return lambda at: np.interp(at, x, size * y)


def _part(rng: Rng, shape: F, n: int) -> F:
    """A part of a shape over n points, without line, of unit size; one of few points is used whole."""
    count = len(shape) if len(shape) < 40 else int(rng.integers(40, len(shape) + 1))
    first = int(rng.integers(0, len(shape) - count + 1))
    y = shape[first : first + count][:: int(rng.choice([-1, 1]))] * rng.choice([-1.0, 1.0])
    u = np.linspace(0.0, 1.0, n)
    out: F = np.interp(u, np.linspace(0.0, 1.0, count), y)
    out = out - np.polyval(np.polyfit(u, out, 1), u)
    return out / max(float(out.std()), 1e-12)


@cache
def _shapes() -> tuple[F, ...]:
    if not SHARED.is_dir():
        raise FileNotFoundError(f"{SHARED}: the family 'measured' needs the shared data; leave it out with --families")
    return (*_slits(), *_lathe(), *_roundness())


def _slits() -> list[F]:
    """Mean of both directions over the positions of the first run."""
    out = []
    for folder in sorted((SHARED / "bifrost").iterdir()):
        y = np.array(json.loads((folder / "r01.json").read_text())["columns"]["deviation_mm"])
        half = len(y) // 2
        out.append(0.5 * (y[:half] + y[: -half - 1 : -1]))
    return out


def _lathe() -> list[F]:
    """Temperature of the spindle's front, the last column of every day's sheet."""
    book = CalamineWorkbook.from_path(SHARED / "thermal-lathe" / "ACE_X.xlsx")
    return [
        np.array([row[-1] for row in book.get_sheet_by_name(name).to_python()[1:] if row[-1] != ""]) for name in sorted(book.sheet_names)
    ]


def _roundness() -> list[F]:
    """Departure from a circle, means over 1 degree."""
    out = []
    for path in sorted((SHARED / "interferometer").glob("*.csv.gz")):
        with gzip.open(path, "rt") as f:
            rows = np.array([[float(v) for v in row] for row in list(csv.reader(f))[1:]])
        degree = np.minimum(rows[:, 0].astype(int), 359)
        out.append(np.bincount(degree, rows[:, 2], 360) / np.maximum(np.bincount(degree, minlength=360), 1))
    return out
