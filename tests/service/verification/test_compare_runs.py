"""Differences of runs: a known one is found where it is, noise alone is not beyond its uncertainty, and unlike runs are refused."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from abbe.service.rendering.document import ReportFigure
from abbe.service.runs.observations import run_data
from abbe.service.verification.compare_runs import LoadedRun, curve, difference, figure_rows, incomparable_reason, remarks
from tests.run_documents import run_of

RADIUS = 100.0


def circle(seed: int, bump_um: float = 0.0, *, reverse: bool = False, **setup: Any) -> LoadedRun:
    angle = np.linspace(0.0, 2 * np.pi, 400, endpoint=False)[:: -1 if reverse else 1]
    axes = np.column_stack([RADIUS * np.cos(angle), RADIUS * np.sin(angle), np.zeros(400)])
    rng = np.random.default_rng(seed)
    deviation = 1e-3 * (bump_um * np.cos(4 * angle) + rng.normal(0.0, 0.1, 400)) + 0.02 + 0.01 * np.cos(angle)
    columns = {f"{c}_mm": axes[:, k].tolist() for k, c in enumerate("xyz")}
    columns |= {"t_s": np.arange(400.0).tolist(), "deviation_mm": deviation.tolist()}
    known = {"setup_id": "A", "centre_mm": [0.0, 0.0, 0.0], "radius_mm": RADIUS, "plane": "XY"} | setup
    run = run_of({"run_id": f"c{seed}", "test": "ballbar_circle", "setup": known, "columns": columns})
    return LoadedRun(f"june/c{seed}", "mill-7", run, run_data(run), ())


def test_a_known_difference_is_found_where_it_is_whatever_the_sense() -> None:
    for reverse in (False, True):
        apart = difference(curve(circle(1)), curve(circle(2, 2.0, reverse=reverse)))
        assert apart is not None
        wanted = 2.0 * np.cos(4 * np.radians(apart.x))
        assert np.abs(apart.difference_um - wanted).max() < 0.7
        # of each run: noise of 0.1 µm, and 0.1 µm for mounting the bar anew
        assert apart.u_um == pytest.approx(np.full(apart.x.size, 2 * 0.1), rel=0.2)
        assert apart.beyond > 0.7


def test_noise_alone_is_no_difference() -> None:
    """Two runs of the same machine: mounting and length differ and are fitted away; about 5 % of readings lie beyond k = 2."""
    apart = difference(curve(circle(3)), curve(circle(4)))
    assert apart is not None
    assert apart.beyond < 0.1


def test_what_cannot_be_compared_says_why() -> None:
    one = circle(1)
    assert incomparable_reason(one, circle(2)) == ""
    other_plane = replace(one.run, setup=replace(one.run.bar, plane="YZ"))
    assert "plane of june/c2 is YZ" in incomparable_reason(one, LoadedRun("june/c2", "mill-7", other_plane, one.data, ()))
    assert "measured on machine lathe" in incomparable_reason(one, LoadedRun("june/c2", "lathe", one.run, one.data, ()))
    helix = replace(one.run, test="ballbar_helix")
    assert "only runs of one test" in incomparable_reason(one, LoadedRun("june/c2", "mill-7", helix, one.data, ()))
    moved = circle(2, centre_mm=[5.0, 0.0, 0.0])
    assert remarks([one, moved]) == ["june/c2 was measured elsewhere than june/c1 (centre_mm): the difference includes this"]
    assert remarks([one, circle(5)]) == []


@pytest.mark.parametrize(("second", "u", "sure"), [(14.0, 1.0, True), (12.0, 1.0, False), (12.0, None, None)])
def test_a_difference_of_figures_counts_both_uncertainties(second: float, u: float | None, sure: bool | None) -> None:
    def of(value: float, own: float | None) -> LoadedRun:
        one = circle(1)
        return LoadedRun(
            one.label,
            one.machine,
            one.run,
            one.data,
            [ReportFigure("g", "G", "circular deviation", value, own, "µm"), ReportFigure("g", "n", "", 1, None, "")],
        )

    [row] = figure_rows([of(10.0, 1.0), of(second, u)])
    assert (row.symbol, row.difference, row.sure) == ("G", second - 10.0, sure)
    assert row.u == (None if u is None else pytest.approx(np.sqrt(2.0)))
