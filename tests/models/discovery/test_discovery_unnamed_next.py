"""Where something has no name, what is proposed fits what it is; where nothing is missing, what could not be seen is told."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from abbe.models.discovery.answer import Localization
from abbe.models.discovery.experiment.additions import blind_spots, offers
from abbe.models.discovery.generic.unnamed_structures import generic_rivals
from abbe.models.discovery.unnamed import Structure, propose_unnamed
from abbe.models.effects.path import Path
from tests.models.discovery.discovery_paths import bar, campaign, case_of_paths, circle, laser

INCLUDES = ("rigid6", "setup_centre_offset", "bar_length_error", "mirror_tilt")


def one_way() -> tuple[Path, ...]:
    """Three planes one way at one feed with one bar."""
    return tuple(bar(f"o{k}", circle(plane), 620.0 + 90.0 * k) for k, plane in enumerate(((0, 1), (1, 2), (2, 0))))


def structure(label: str, **where: object) -> Structure:
    return Structure(label, "", 50.0, Localization(**where))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("label", "adds", "words"),
    [
        ("unnamed_step:X", "longer_session", "3 times in one undisturbed set-up"),
        ("unnamed_slip", "longer_session", "if the deviation recurs, it belongs to the machine"),
        ("unnamed_settling:Z", "longer_session", "3 times in one undisturbed set-up"),
        ("unnamed_burst", "longer_session", "3 times in one undisturbed set-up"),
        ("unnamed_bump", "second_radius", "through the same place"),
        ("unnamed_lobes:Z3", "ballbar", "another ball in the cup"),
        ("unnamed_surge:X", "second_feed", "at standstill for 410 s"),
        ("unnamed_wave:EYX", "second_feed", "in millimetres"),
        ("unnamed_smooth:EYX", "single_axis_laser", "other means"),
        ("unnamed_odd:EYX", "opposite_direction", "from the other side"),
    ],
)
def test_every_structure_has_its_own_proposal(label: str, adds: str, words: str) -> None:
    period = 41.0 if "surge" in label else None
    test = propose_unnamed(case_of_paths(one_way(), *INCLUDES), (structure(label, runs=("o1",), period_s=period),))
    assert test is not None
    assert test.adds == (adds,)
    assert words in test.why
    assert "{" not in test.why
    assert test.minutes > 10.0
    assert test.expected_separation_sigma is None  # nobody knows what it would do elsewhere
    assert len(test.separates) == 2


def test_all_structures_of_the_search_are_known() -> None:
    case = case_of_paths(campaign(), *INCLUDES)
    for name in {e.name for e in generic_rivals(case)}:
        assert propose_unnamed(case, (structure(f"{name}:X"),)) is not None
    assert propose_unnamed(case, ()) is None


def test_a_moment_names_its_run_and_a_period_asks_for_what_is_not_there_yet() -> None:
    paths = one_way()
    case = case_of_paths(paths, *INCLUDES)
    t = float(paths[1].at.t_s[5])
    step = propose_unnamed(case, (structure("unnamed_step:X", time_s=(t - 1.0, t + 1.0), runs=("o0", "o1")),))
    assert step is not None
    assert step.like == "o1"
    assert "run o1 again" in step.why
    both = case_of_paths(campaign(), *INCLUDES)  # two feeds already
    surge = propose_unnamed(both, (structure("unnamed_surge:X", period_s=41.0),))
    assert surge is not None
    assert surge.adds == ("longer_session",)
    assert "another feed" not in surge.why
    assert "at standstill for 410 s" in surge.why
    only_laser = case_of_paths(tuple(p for p in campaign() if p.kind == "laser"), *INCLUDES)
    bump = propose_unnamed(only_laser, (structure("unnamed_bump", position_mm=(1.0, 2.0, 3.0)),))
    assert bump is not None
    assert bump.adds == ("longer_session",)  # there is no sphere that could pass the place


def test_a_poor_campaign_says_what_it_could_not_have_seen() -> None:
    found = {u.adds: u for u in blind_spots(case_of_paths(one_way(), *INCLUDES))}
    assert set(found) == {"second_feed", "opposite_direction", "second_radius", "laser_diagonals", "longer_session"}
    assert "grow with the feed" in found["second_feed"].what
    assert "1 h later" in found["longer_session"].because
    lasers = case_of_paths(tuple(p for p in campaign() if p.kind == "laser"), *INCLUDES)
    assert "ballbar" in {u.adds for u in blind_spots(lasers)}


def test_what_is_measured_is_no_longer_unseen_but_only_if_it_is_fitted() -> None:
    first = one_way()[0]
    back = replace(first, label="b", direction=-first.direction, feed_mm_min=2.0 * first.feed_mm_min, radius_mm=first.radius_mm * 0.5)
    late = replace(first, label="l", at=replace(first.at, t_s=first.at.t_s + 4000.0))
    lasers = tuple(p for p in campaign() if p.kind == "laser")
    case = case_of_paths((first, back, late, *lasers), *INCLUDES)
    assert blind_spots(case) == ()
    judges = replace(case, runs=tuple(replace(r, role="identify" if r.path.label == first.label else "holdout") for r in case.runs))
    assert len(blind_spots(judges)) == 5
    early = replace(case, runs=tuple(r for r in case.runs if r.path.label != "l"))
    assert [u.adds for u in blind_spots(early)] == ["longer_session"]


def late_repeat(first: Path, again: Path) -> bool:
    """Whether a path that is run 4000 s after another one counts as the same one, run late."""
    late = replace(again, label="late", at=replace(again.at, t_s=again.at.t_s - again.at.t_s[0] + first.at.t_s[0] + 4000.0))
    return "longer_session" not in {u.adds for u in blind_spots(case_of_paths((first, late), *INCLUDES))}


def test_only_the_same_path_run_late_tells_what_comes_slowly() -> None:
    xy, yz, zx = one_way()
    assert late_repeat(xy, xy)
    assert late_repeat(xy, bar("back", circle((0, 1)), 0.0, back=True))
    assert late_repeat(xy, bar("fewer", circle((0, 1), n=50), 0.0))  # the same circle, its readings lie elsewhere
    assert not late_repeat(xy, yz)
    assert not late_repeat(xy, zx)
    assert not late_repeat(xy, bar("small", circle((0, 1), radius=100.0), 0.0))
    ppp, npp = laser("a", "ppp", 0.0), laser("b", "npp", 0.0)
    assert late_repeat(ppp, ppp)
    assert late_repeat(ppp, replace(ppp, look=-ppp.look))  # the interferometer at the other end
    assert not late_repeat(ppp, npp)
    beside = replace(ppp, at=replace(ppp.at, q_mm=ppp.at.q_mm + np.array([0.0, 15.0, 0.0])))
    assert not late_repeat(ppp, beside)


def test_what_is_proposed_and_what_is_said_to_be_unseen_agree_on_what_one_feed_is() -> None:
    first = one_way()[0]
    for factor, one in ((1.0, True), (1.29, True), (1.31, False)):
        case = case_of_paths((first, replace(first, label="f", feed_mm_min=factor * first.feed_mm_min)), *INCLUDES)
        assert ("second_feed" in {u.adds for u in blind_spots(case)}) is one
        assert ("second_feed" in {o.adds for o in offers(case)}) is one
    lengths = {u.adds: u.what for u in blind_spots(case_of_paths((first,), *INCLUDES))}
    assert lengths["laser_diagonals"].endswith("the search does not use the bar's certificate")
