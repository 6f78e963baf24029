"""What to measure next: only what is missing is offered, and what separates two suspects is found by simulation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from abbe.models.discovery.experiment.additions import offers
from abbe.models.discovery.experiment.design import SuspectEffect, propose, prospects
from abbe.models.effects.catalogue import CATALOGUE
from abbe.models.effects.path import Path
from tests.models.discovery.discovery_paths import bar, campaign, case_of_paths, circle

EFFECTS = {e.name: e for e in CATALOGUE}
INCLUDES = ("rigid6", "setup_centre_offset", "bar_length_error", "mirror_tilt")


def suspect(name: str, key: str = "") -> SuspectEffect:
    effect = EFFECTS[name]
    return SuspectEffect(effect, key, {p.name: p.typical for p in effect.shape})


def one_way() -> tuple[Path, ...]:
    """Three planes one way at one feed, and the lasers of the campaign."""
    planes = ((0, 1), (1, 2), (2, 0))
    runs = tuple(bar(f"o{k}", circle(plane), 620.0 + 90.0 * k) for k, plane in enumerate(planes))
    return (*runs, *(p for p in campaign() if p.kind == "laser"))


def test_what_is_there_is_not_offered() -> None:
    full = {o.adds for o in offers(case_of_paths(campaign(), *INCLUDES))}
    assert not full & {"second_feed", "opposite_direction", "planar_circles", "laser_diagonals", "ballbar"}
    assert {"second_radius", "single_axis_laser", "second_tool_length", "longer_session", "angular_interferometer"} <= full
    less = {o.adds for o in offers(case_of_paths(one_way(), *INCLUDES))}
    assert {"second_feed", "opposite_direction"} <= less
    lasers = {o.adds for o in offers(case_of_paths(tuple(p for p in campaign() if p.kind == "laser"), *INCLUDES))}
    assert "ballbar" in lasers
    assert "second_feed" not in lasers


def test_offers_stay_inside_the_strokes_and_take_time() -> None:
    for offer in offers(case_of_paths(one_way(), *INCLUDES)):
        assert offer.minutes > 5.0
        assert offer.why
        for run in offer.runs:
            q, stroke = run.path.at.q_mm, run.path.machine.stroke_mm
            assert (q >= stroke[:, 0]).all()
            assert (q <= stroke[:, 1]).all()
            assert (np.diff(run.path.at.t_s) > 0).all()


def test_lag_and_cosine_are_told_apart_by_a_second_feed() -> None:
    """effects.md 6: cosine 1.000 with one feed, 0.06 with two."""
    case = case_of_paths(one_way(), *INCLUDES)
    test = propose(case, suspect("contour_lag"), (suspect("laser_cosine"),))
    assert test is not None
    assert test.adds == ("second_feed",)
    assert test.expected_separation_sigma is not None
    assert test.expected_separation_sigma > 4.0
    assert test.separates == ("contour_lag", "laser_cosine")
    assert test.minutes < 30.0


def test_more_readings_never_tell_less() -> None:
    case = case_of_paths(one_way(), *INCLUDES)
    for p in prospects(case, suspect("backlash", "X"), (suspect("servo_mismatch", "X"), suspect("lateral_play", "EXY"))):
        assert (p.sigmas >= p.already - 1e-3 * (1.0 + p.already)).all()


def test_size_of_the_suspect_counts() -> None:
    case = case_of_paths(one_way(), *INCLUDES)
    small, large = suspect("contour_lag"), suspect("contour_lag")
    sizes = []
    for s, c in ((small, 1e-2), (large, 1.0)):
        found = prospects(case, replace(s, coefficients=np.array([c * s.effect.per_unit])), (suspect("laser_cosine"),))
        sizes.append(next(float(p.sigmas[0]) for p in found if p.offer.adds == "second_feed"))
    assert np.isclose(sizes[1], 100.0 * sizes[0], rtol=1e-3)


def test_nothing_to_tell_without_rivals() -> None:
    assert propose(case_of_paths(one_way(), *INCLUDES), suspect("contour_lag"), ()) is None
