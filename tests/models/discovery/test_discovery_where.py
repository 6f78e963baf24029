"""Where the gap lives: calibrated on noise, and pointing to what was put in."""

from __future__ import annotations

import numpy as np
import pytest

from abbe.models.arrays import F1
from abbe.models.discovery.lack import CHANCE
from abbe.models.discovery.localization import SIGNIFICANT, localize_signal, locate
from tests.models.discovery.discovery_paths import campaign, noise

PATHS = campaign()


def with_(add: list[F1], seed: int = 2) -> tuple[F1, ...]:
    return tuple(e + a for e, a in zip(noise(PATHS, seed), add, strict=True))


def test_noise_alone_is_nowhere() -> None:
    """40 campaigns of noise, every one judged at 1 % over all its tests: at most 2 may cry (binomial, 99 %)."""
    cries = sum(locate(PATHS, noise(PATHS, seed)).table[0].p < SIGNIFICANT for seed in range(40))
    assert cries <= 2


def test_one_axis_both_ways() -> None:
    where = locate(PATHS, with_([1.5 * np.sign(p.at.sign[:, 1]) * p.look[:, 1] for p in PATHS]))
    assert "Y" in where.axes
    assert set(where.axes) <= set("XYZ")
    assert where.table[0].p < 1e-6
    assert where.table[0].value.startswith("Y") or any("Y up and down" in s.value and s.p < 1e-3 for s in where.table)


def test_runs_in_one_direction_do_not_say_that_the_other_is_calm() -> None:
    """The runs back are often the holdout runs, which are not fitted: an effect of both directions was told as "only forward"."""
    ahead = tuple(p for p in PATHS if np.all(p.direction > 0))
    rest = tuple(e + 3.0 * p.look[:, 0] for e, p in zip(noise(ahead, 2), ahead, strict=True))
    where = locate(ahead, rest)
    assert "X" in where.axes
    assert where.directions == ()
    assert "direction" not in where.depends_on
    assert localize_signal(ahead, rest).directions == ()
    again = tuple(3.0 * p.look[:, 0] * (p.direction > 0) for p in PATHS)
    assert locate(PATHS, with_(list(again))).directions == (1,)
    assert localize_signal(PATHS, again).directions == (1,)


def test_one_run_in_time() -> None:
    add = [np.where(np.arange(p.n) > p.n // 2, 2.0, 0.0) * (p.label == "c11000") for p in PATHS]
    add[4] = np.where(np.arange(PATHS[4].n) > 120, 2.5, 0.0)
    where = locate(PATHS, with_(add))
    assert PATHS[4].label in where.runs
    assert any(s.value == f"{PATHS[4].label} (neighbours)" and s.p < SIGNIFICANT for s in where.table)
    assert set(where.runs) <= {p.label for p in PATHS}  # runs, not how they were tested
    assert len(set(where.runs)) == len(where.runs)
    run = PATHS[4].at.t_s
    assert where.time_s is not None
    assert where.time_s[0] >= run[0] - 30.0
    assert where.time_s[1] <= run[-1] + 30.0


@pytest.mark.parametrize(("sigma", "seen"), [(5.0, False), (9.0, True)])
def test_one_spectral_line_of_a_short_run_must_be_stronger_than_chance_gives(sigma: float, seen: bool) -> None:
    """Readings that alternate: five sigma of it come by chance in one of some hundred clean campaigns."""
    short = min((k for k, p in enumerate(PATHS) if p.n >= 40), key=lambda k: PATHS[k].n)
    n = PATHS[short].n
    line = (-1.0) ** np.arange(n) / np.sqrt(n)
    rest = list(noise(PATHS, 2))
    rest[short] += (sigma - rest[short] @ line) * line
    found = next(s for s in locate(PATHS, tuple(rest)).table if s.value == f"{PATHS[short].label} (neighbours)")
    assert (found.p < CHANCE) is seen


def test_wave_on_the_clock() -> None:
    add = [1.0 * np.sin(2 * np.pi * p.at.t_s / 37.0) * p.look[:, 2] * (p.kind == "bar") for p in PATHS]
    lines = [s for s in locate(PATHS, with_(add)).table if s.kind == "frequency" and s.value.startswith("Z")]
    assert lines[0].p < 1e-3
    assert float(lines[0].value.split()[2]) == pytest.approx(37.0, rel=0.05)


def test_signal_of_lasers_only() -> None:
    signal = tuple(np.ones(p.n) * (p.kind == "laser") for p in PATHS)
    where = localize_signal(PATHS, signal)
    assert where.tests == ("laser_diagonal",)
    assert all(r.startswith("l") for r in where.runs)


def test_signal_in_one_place() -> None:
    centre = np.array([500.0, 250.0, 200.0])
    signal = tuple(np.exp(-0.5 * np.sum((p.at.q_mm - centre) ** 2, axis=1) / 20.0**2) for p in PATHS)
    where = localize_signal(PATHS, signal)
    assert where.position_mm is not None
    assert np.linalg.norm(np.subtract(where.position_mm, centre)) < 15.0
    assert where.radius_mm is not None
    assert where.radius_mm < 60.0


def test_no_signal_lives_nowhere() -> None:
    where = localize_signal(PATHS, tuple(np.zeros(p.n) for p in PATHS))
    assert where.tests == ()
    assert where.time_s is None
    assert where.position_mm is None
