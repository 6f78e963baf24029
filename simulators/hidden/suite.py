"""``python -m abbe.simulators hidden-suite``: many sealed cases in the exchange format."""

import argparse
import json
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from abbe.simulators.arrays import F
from abbe.simulators.hidden.cases import Case, make_case
from abbe.simulators.hidden.draws import KINDS
from abbe.simulators.hidden.effect import Hidden
from abbe.simulators.hidden.instrument import DEAD_PATH_MM, air_rise
from abbe.simulators.hidden.plans import Run
from abbe.simulators.hidden.thermal import rise, warmth
from abbe.simulators.scenario import DEFAULT_PATH, Scenario, load

STREAM_PICK = 61


def packaged() -> list[Path]:
    """Return the paths of the packaged ``hidden-*`` scenarios (one of them without a hidden effect), sorted by name."""
    return sorted(DEFAULT_PATH.parent.glob("hidden-*.toml"))


def picked(seed: int) -> Scenario:
    """Return the packaged scenario that a seed picks (see `winner`), with its machine drawn from the same seed.

    A new scenario changes only the picks of the seeds that pick it.

    Raises
    ------
    ScenarioError
        The seed is negative.
    """
    return replace(load(winner(seed, packaged())), seed=seed)


def winner(seed: int, paths: list[Path]) -> Path:
    """Return the file that a seed picks: each file draws a random number, and the highest wins."""

    def lot(path: Path) -> float:
        return float(np.random.default_rng([STREAM_PICK, abs(seed), zlib.crc32(path.name.encode())]).random())

    return max(paths, key=lot)


ROOM_C = 20.0
SENSORS = ("x", "y", "z", "spindle", "air")


def temperatures(effects: tuple[Hidden, ...], seed: int, t_s: F) -> dict[str, F]:
    """Return the true temperatures (n,), degree C, at the sensors of axes, spindle and air; all vary, even without a thermal effect."""
    rng = np.random.default_rng([44, seed])
    out: dict[str, F] = {}
    for i, name in enumerate(SENSORS[:4]):
        size = rng.uniform(2.0, 12.0) if name == "spindle" else rng.uniform(0.5, 4.0)
        tau = rng.uniform(1200.0, 7200.0)
        guilty = next((e for e in effects if e.name == "axis_thermal_growth" and e.axis == i), None)
        idle = size * warmth(t_s, tau)
        out[name] = ROOM_C + (idle if guilty is None else guilty["strength"] * rise(guilty, t_s) + 0.15 * idle)
    swing, period, phase = rng.uniform(0.2, 1.5), rng.uniform(5000.0, 14000.0), rng.uniform(0.0, 2.0 * np.pi)
    air = next((e for e in effects if e.name == "air_refraction"), None)
    out["air"] = ROOM_C + (swing * np.sin(2.0 * np.pi * t_s / period + phase) if air is None else air_rise(air, t_s))
    return out


SENSOR_NOISE_C = 0.03


def kinds_of(count: int, kinds: Sequence[str], first: int) -> list[str]:
    """Return the kinds of the cases of a suite, in the proportions of `KINDS`, in random order by the seed ``first``."""
    shares = np.array([KINDS[k] for k in kinds], dtype=np.float64)
    wanted = count * shares / shares.sum()
    numbers = np.floor(wanted).astype(int)
    for i in np.argsort(numbers - wanted, kind="stable")[: count - int(numbers.sum())]:
        numbers[i] += 1
    out = [k for k, n in zip(kinds, numbers, strict=True) for _ in range(n)]
    np.random.default_rng([52, first]).shuffle(out)
    return out


def make_suite(first: int, count: int, kinds: Sequence[str] = tuple(KINDS), *, wild: bool = True) -> Iterator[Case]:
    """Yield cases with the seeds ``first``, ``first + 1``, ..."""
    for i, kind in enumerate(kinds_of(count, kinds, first)):
        yield make_case(f"case{i:04d}", first + i, kind, wild=wild)


def write_case(case: Case, folder: Path) -> None:
    """Write ``public/<case>/`` (campaign and runs) and ``sealed/<case>.json``."""
    public = folder / "public" / case.name
    public.mkdir(parents=True, exist_ok=True)
    (folder / "sealed").mkdir(exist_ok=True)
    readings = {r.run_id: case.setting.noise.put(case.clean_mm[r.run_id], r, case.setting.seed) for r in case.runs}
    _write(public / "campaign.json", campaign(case))
    for run in case.runs:
        _write(public / f"{run.run_id}.json", run_file(case, run, readings[run.run_id]))
    _write(folder / "sealed" / f"{case.name}.json", sealed(case, readings))


def _write(path: Path, data: dict[str, object]) -> None:
    path.write_text(json.dumps(data), encoding="utf-8")


def campaign(case: Case) -> dict[str, object]:
    """Return the ``abbe-campaign/1`` object of a case."""
    setups = {r.track.setup: {"kind": "ballbar" if r.track.kind == "bar" else "laser", "t_set_s": r.track.set_s} for r in case.runs}
    noise = case.setting.noise
    return {
        "format": "abbe-campaign/1", "campaign": case.name, "machine": case.setting.document,
        "current_model": {"includes": sorted([case.setting.model.level, *case.setting.model.terms])},
        "instruments": {
            "ballbar": {"resolution_mm": noise.bar_step_mm}, "laser": {"resolution_mm": noise.laser_step_mm, "dead_path_mm": DEAD_PATH_MM},
        },
        "setups": setups, "temperature_sensors": case.setting.sensors,
        "runs": [{"run_id": r.run_id, "test": r.test, "role": r.role, "file": f"{r.run_id}.json"} for r in case.runs],
    }  # fmt: skip


def run_file(case: Case, run: Run, reading_mm: F) -> dict[str, object]:
    """Return the ``abbe-run/1`` object of one run."""
    track = run.track
    columns: dict[str, object] = {"t_s": _short(track.t_s, 4)}
    for a, name in enumerate(("x_mm", "y_mm", "z_mm")):
        columns[name] = _short(track.q_mm[:, a], 5)
    columns["feed_mm_min"] = [run.feed] * track.n
    columns["direction"] = [int(d) for d in run.direction]
    columns["deviation_mm"] = None if run.role == "sealed" else _short(reading_mm, 6)
    if case.setting.sensors:
        rng = np.random.default_rng([53, case.setting.seed, track.number])
        for name, true_c in temperatures(case.effects, case.setting.seed, track.t_s).items():
            columns[f"temp_{name}_C"] = _short(true_c + rng.normal(scale=SENSOR_NOISE_C, size=track.n), 2)
    return {
        "format": "abbe-run/1", "campaign": case.name, "run_id": run.run_id, "test": run.test, "role": run.role, "setup": run.setup,
        "machine": case.setting.document, "columns": columns,
    }  # fmt: skip


def _short(values: F, digits: int) -> list[float]:
    return [round(v, digits) for v in values.tolist()]


def sealed(case: Case, readings: dict[str, F]) -> dict[str, object]:
    """Return the truth of a case, by which an answer is judged."""
    noise = case.setting.noise
    seen = {r.track.setup for r in case.runs if r.role == "identify"}
    runs = {}
    for run in (r for r in case.runs if r.role == "sealed"):
        sigma = noise.bar_mm if run.track.kind == "bar" else noise.laser_mm
        runs[run.run_id] = {
            "test": run.test, "setup_id": run.track.setup, "sigma_um": 1e3 * sigma, "deviation_mm": _short(readings[run.run_id], 6),
            "clean_mm": _short(case.clean_mm[run.run_id], 7), "without_effect_mm": _short(case.without_mm[run.run_id], 7),
            "xyz_mm": [_short(q, 4) for q in run.track.q_mm], "setup_seen": run.track.setup in seen,
            "info": {k: v for k, v in run.setup.items() if k not in ("setup_id", "t_set_s")},
        }  # fmt: skip
    verdict = {"null": "none", "unknown": "unknown"}.get(case.setting.kind, "named")
    return {
        "format": "blind-truth/1", "case": case.name, "kind": case.setting.kind, "forms": "wild" if _wild(case.effects) else "textbook",
        "plan": case.setting.plan, "level": case.setting.model.level, "verdict": verdict, "effects": case.facts,
        "noise": {"sigma_bar_um": 1e3 * noise.bar_mm, "sigma_laser_um": 1e3 * noise.laser_mm},
        "known_setup": [{"label": e.label, "parameters": dict(e.parameters)} for e in case.setting.setup],
        "gap": {"identify_effect_rms_um": case.gap_um}, "sealed_runs": runs,
    }  # fmt: skip


def _wild(effects: tuple[Hidden, ...]) -> bool:
    return not effects or any(e.wild for e in effects)


def main(argv: Sequence[str]) -> int:
    """Run the command line and return its exit code."""
    parser = argparse.ArgumentParser(
        prog="simulators hidden-suite", description="Write sealed cases: campaigns with hidden effects, and the truth about them."
    )
    parser.add_argument("--first", type=int, required=True, help="seed of the first case")
    parser.add_argument("--cases", type=int, required=True, help="number of cases")
    parser.add_argument("--kinds", default=",".join(KINDS), help="kinds of cases, separated by commas (default: %(default)s)")
    parser.add_argument("--textbook", action="store_true", help="let effects follow the textbook form exactly")
    parser.add_argument("--out", type=Path, required=True, help="directory to write public/ and sealed/ into")
    options = parser.parse_args(argv)
    kinds = options.kinds.split(",")
    wrong = [k for k in kinds if k not in KINDS]
    if wrong or options.cases < 1 or options.first < 0:
        parser.error(f"unknown kind {wrong[0]!r}" if wrong else "--cases must be at least 1 and --first not negative")
    for case in make_suite(options.first, options.cases, kinds, wild=not options.textbook):
        write_case(case, options.out)
    return 0
