"""What is shown of a running path: all of it while somebody fetches it, bounded when nobody does, and never at the cost of the recorder."""

from __future__ import annotations

import numpy as np
import pytest

from abbe.drivers.api import BarBatch, BarSample
from abbe.models.machine import Machine
from abbe.service.capture.live import ANGLES, LONGEST, MOST_BATCHES, LiveFeed, angles_along
from abbe.service.channel.messages import LARGEST_B, encode
from abbe.service.clock import SystemClock
from abbe.service.core.web_process import _message
from abbe.service.domain.run import BarSetup
from abbe.service.sequences.recipes.campaigns import hemisphere
from abbe.service.sequences.recipes.recipe import Circle, Helix
from abbe.service.sequences.steps import RecordPath

SYNC, OUT = 0b1000, 0b0001
SETUP = BarSetup(setup_id="A", centre_mm=np.zeros(3), radius_mm=100.0, axis="Z", document={})
QUARTER = [(100.0 * float(np.cos(a)), 100.0 * float(np.sin(a)), 0.0) for a in np.linspace(0.0, np.pi / 2, 91)]


def batch(first: int, readings_nm: list[int], status: int = SYNC, host_s: float = 1.0) -> BarBatch:
    return BarBatch(host_s, tuple(BarSample((first + k) % 2**32, 1000 * (first + k), nm, status) for k, nm in enumerate(readings_nm)))


@pytest.fixture
def feed() -> LiveFeed:
    made = LiveFeed()
    made.begin("helix1", "ballbar_helix", SETUP, (QUARTER, 6000.0, 1000))
    return made


def test_samples_are_counted_from_the_path_s_beginning(feed: LiveFeed) -> None:
    feed.take(batch(2**32 - 3, [0, 0], status=0))  # before the path
    feed.take(batch(2**32 - 1, [1000, -2500], host_s=7.0))
    (part,) = feed.stretches()
    assert (part.path, part.first, part.host_s, part.values_um.tolist()) == (1, 0, 7.0, [1.0, -2.5])
    feed.take(batch(1, [500]))
    assert [(p.first, p.values_um.tolist()) for p in feed.stretches()] == [(2, [0.5])]
    assert feed.stretches() == []


def test_a_gap_makes_two_stretches_and_an_invalid_reading_none(feed: LiveFeed) -> None:
    feed.take(batch(10, [1000, 2000]))
    feed.take(batch(15, [3000], status=SYNC | OUT))
    one, two = feed.stretches()
    assert (one.first, one.values_um.tolist()) == (0, [1.0, 2.0])
    assert two.first == 5
    assert np.isnan(two.values_um).all()


def test_what_nobody_fetches_is_bounded_and_the_numbers_stay_right(feed: LiveFeed) -> None:
    for k in range(MOST_BATCHES + 100):
        feed.take(batch(k, [k]))
    (part,) = feed.stretches()
    assert (part.first, len(part.values_um)) == (100, MOST_BATCHES)


def test_what_came_while_nobody_looked_on_fits_into_messages(feed: LiveFeed) -> None:
    for k in range(MOST_BATCHES):
        feed.take(batch(20 * k, list(range(20 * k, 20 * k + 20))))
    parts = feed.stretches()
    assert [part.first for part in parts] == list(range(0, 20 * MOST_BATCHES, LONGEST))
    assert np.concatenate([part.values_um for part in parts]) == pytest.approx(np.arange(20 * MOST_BATCHES) / 1e3)
    assert max(len(encode(_message(part, SystemClock()))) for part in parts) < LARGEST_B // 2


def test_a_new_path_begins_at_nought(feed: LiveFeed) -> None:
    feed.take(batch(10, [1000]))
    feed.end()
    assert (feed.path, feed.stretches(), feed.active.is_set()) == (None, [], False)
    feed.begin("helix2", "ballbar_helix", SETUP, (QUARTER, 6000.0, 1000))
    feed.take(batch(90, [4000]))
    assert [(p.path, p.first) for p in feed.stretches()] == [(2, 0)]
    path = feed.path
    assert path is not None
    assert path.duration_s == pytest.approx(0.5 * np.pi, rel=1e-3)
    assert (path.angle_deg[0], path.angle_deg[-1], len(path.angle_deg)) == (0.0, 90.0, ANGLES)
    assert path.angle_deg[ANGLES // 2] == pytest.approx(45.0, abs=0.2)


def test_angles_go_as_often_round_as_the_recipe_s() -> None:
    machine = Machine("w-Y-X-b-Z-t", np.array([[0.0, 600.0], [0.0, 500.0], [0.0, 450.0]]), np.zeros((3, 3)), np.zeros(3))
    centre, radius = hemisphere(machine, (0.5, 0.5, 0.3), 0.85)
    for recipe, turned in (
        (Helix("h", "B", "identify", centre, radius, turns=4), 4 * 360.0),
        (Circle("c", "B", "identify", centre, 60.0, plane="XY"), 720.0),  # with half a turn before and after it
        (Circle("z", "B", "identify", centre, 60.0, plane="ZX", direction=-1), -224.0),
    ):
        test = recipe.plan(machine)
        (path,) = (step for step in test.steps if isinstance(step, RecordPath))
        angles, _ = angles_along(path.points_mm, test.bar)
        assert angles[-1] - angles[0] == pytest.approx(turned, abs=3.0)
