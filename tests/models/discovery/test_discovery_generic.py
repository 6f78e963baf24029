"""Structures without a name: a scan of residuals starts where each was put, and says where it lives."""

from __future__ import annotations

import numpy as np
import pytest

from abbe.models.arrays import F1
from abbe.models.discovery.generic.unnamed_structures import SIGNALS, generic_rivals, is_unnamed, location_of, place_at
from abbe.models.effects.effect import Effect
from abbe.models.effects.path import Path
from tests.models.discovery.discovery_paths import campaign, case_of_paths, noise

SIGMA = {"bar": 4e-4, "laser": 3e-4}
PATHS = campaign()
CASE = case_of_paths(PATHS, "rigid21")


def hidden(name: str, key: str, values: dict[str, float], size_um: float, column: int = 0) -> dict[str, F1]:
    """Noise with one structure in it, sigmas, by run, after the cup of every set-up and the zero of every laser run were fitted."""
    columns = SIGNALS[name](PATHS, key, values)
    rest = {p.label: e + size_um * c[:, column] / SIGMA[p.kind] for p, e, c in zip(PATHS, noise(PATHS, 5), columns, strict=True)}
    for setup in {p.setup for p in PATHS}:
        runs = [p for p in PATHS if p.setup == setup]
        free = np.concatenate([p.look if p.kind == "bar" else np.ones((p.n, 1)) * [p is q for q in runs] for p in runs])
        y = np.concatenate([rest[p.label] for p in runs])
        left = y - free @ np.linalg.lstsq(free, y, rcond=None)[0]
        rest |= dict(zip([p.label for p in runs], np.split(left, np.cumsum([p.n for p in runs])[:-1]), strict=True))
    return rest


def the(rivals: tuple[Effect, ...], name: str, key: str) -> Effect:
    return next(e for e in rivals if e.name == name and key in e.keys)


@pytest.mark.parametrize(
    ("name", "key", "values", "parameter", "near"),
    [
        ("unnamed_step", "Y", {"t0_s": 950.0}, "t0_s", 3.0),
        ("unnamed_surge", "Z", {"period_s": 41.0}, "period_s", 0.4),
        ("unnamed_surge", "laser", {"period_s": 63.0}, "period_s", 1.5),
        ("unnamed_wave", "EYX", {"pitch_mm": 13.0}, "pitch_mm", 0.4),
        ("unnamed_burst", "", {"t0_s": 1010.0, "width_s": 1.2, "frequency_hz": 0.9}, "t0_s", 1.0),
    ],
)
def test_scan_starts_where_it_is(name: str, key: str, values: dict[str, float], parameter: str, near: float) -> None:
    rivals = generic_rivals(CASE, hidden(name, key, values, 2.0), SIGMA)
    starts = next(p for p in the(rivals, name, key).shape if p.name == parameter).starts
    assert min(abs(s - values[parameter]) for s in starts) < near


def test_scan_finds_bump_by_place() -> None:
    values = {"at_s": 900.0, "width_mm": 20.0}
    centre = place_at(PATHS, 900.0)
    columns = [c @ np.array([3.0, 3.0, 3.0]) for c in SIGNALS["unnamed_bump"](PATHS, "", values)]
    rest = {p.label: e + c / SIGMA[p.kind] for p, e, c in zip(PATHS, noise(PATHS, 6), columns, strict=True)}
    effect = the(generic_rivals(CASE, rest, SIGMA), "unnamed_bump", "")
    assert np.linalg.norm(place_at(PATHS, effect.shape[0].starts[0]) - centre) < 20.0
    where = location_of(effect, "", values, CASE)
    assert where.position_mm is not None
    assert np.linalg.norm(np.subtract(where.position_mm, centre)) < 1e-6
    assert where.radius_mm == 40.0


def test_where_says_time_period_lobes() -> None:
    rivals = generic_rivals(CASE)
    step = location_of(the(rivals, "unnamed_step", "X"), "X", {"t0_s": 950.0}, CASE)
    assert step.time_s is not None
    assert step.time_s[0] < 950.0 < step.time_s[1]
    assert step.axes == ("X",)
    surge = location_of(the(rivals, "unnamed_surge", "Z"), "Z", {"period_s": 41.0}, CASE)
    assert surge.period_s == 41.0
    assert surge.depends_on == ("time",)
    lobes = location_of(the(rivals, "unnamed_lobes", "Z4"), "Z4", {}, CASE)
    assert lobes.angular_lobes == 4
    assert set(lobes.tests) == {"ballbar_circle", "ballbar_helix"}


def test_all_are_unnamed_and_few() -> None:
    for rivals in (generic_rivals(CASE), generic_rivals(CASE, {p.label: e for p, e in zip(PATHS, noise(PATHS, 1), strict=True)}, SIGMA)):
        assert all(is_unnamed(e.name) for e in rivals)
        starts = sum(len(e.keys) * int(np.prod([len(p.starts) for p in e.shape])) for e in rivals)
        assert starts <= 1400
        assert all(p.low <= s <= p.high for e in rivals for p in e.shape for s in p.starts)
    scanned = sum(len(e.keys) * int(np.prod([len(p.starts) for p in e.shape])) for e in rivals)
    assert scanned <= 250


def test_signals_have_one_width_and_are_blind_where_they_must() -> None:
    for effect in generic_rivals(CASE):
        values = {p.name: p.starts[0] for p in effect.shape}
        for key in effect.keys:
            columns = effect.signal(PATHS, key, values)
            assert {c.shape[1] for c in columns} == {columns[0].shape[1]}
            assert all(c.shape[0] == p.n and np.isfinite(c).all() for p, c in zip(PATHS, columns, strict=True))
            if effect.name in ("unnamed_lobes", "unnamed_burst"):
                assert all(np.all(c == 0.0) for p, c in zip(PATHS, columns, strict=True) if p.kind == "laser")


def test_step_moves_only_the_setup_that_saw_it() -> None:
    columns = SIGNALS["unnamed_step"](PATHS, "X", {"t0_s": 950.0})
    moved = [p.label for p, c in zip(PATHS, columns, strict=True) if np.any(c != 0.0)]
    assert moved
    assert all(by(label).setup == "A" for label in moved)


def by(label: str) -> Path:
    return next(p for p in PATHS if p.label == label)
