"""What bar and laser read, against the geometry written out here."""

import numpy as np
import pytest

from abbe.simulators.laser.device import LaserResult
from abbe.simulators.scenario import Scenario
from abbe.simulators.world import World

TOOL = np.array([0.0, 0.0, -120.0])


def go(world: World, target, feed: float = 6000.0) -> None:
    world.controller.move(np.array(target, dtype=float), feed)
    world.advance(world.time_s + 30.0)
    assert world.controller.in_position


def read_bar(world: World, seconds: float = 0.1):
    world.ballbar.start(100, world.time_s)
    world.advance(world.time_s + seconds)
    world.ballbar.stop()
    return world.ballbar.take()


def test_bar_of_a_perfect_machine_reads_zero_on_the_sphere(quiet_world) -> None:
    world = quiet_world()
    world.ballbar.mount(100.0, world.tool_position(), world.time_s)
    go(world, (300 + 60, 250 + 80, 225))
    assert np.abs(read_bar(world).reading_nm).max() == 0
    go(world, (300, 250 + 100.5, 225))
    assert set(read_bar(world).reading_nm.tolist()) == {500_000}


def test_bar_reads_length_error_cup_and_noise(quiet_world) -> None:
    world = quiet_world(bar_length_sd_um=1.5, cup_offset_um=[20, 20], bar_noise_um=[0.5, 0.5])
    readings = []
    for _ in range(2):
        go(world, (300, 250, 225))
        world.ballbar.mount(100.0, world.tool_position(), world.time_s)
        for direction in np.vstack([np.eye(3), -np.eye(3)]):
            go(world, np.array([300, 250, 225]) + 100.0 * direction)
            readings.append(read_bar(world, 20.0).reading_nm / 1000.0)
    means = np.array([r.mean() for r in readings]).reshape(2, 2, 3)
    length_um = 1000.0 * world.draws.bar_length_error_mm
    np.testing.assert_allclose(means.mean(axis=1), length_um, atol=0.1)
    cups = 0.5 * (means[:, 1] - means[:, 0])
    np.testing.assert_allclose(np.linalg.norm(cups, axis=1), 20.0, atol=0.1)
    assert np.linalg.norm(cups[0] - cups[1]) > 1.0, "a new mount, a new direction"
    assert np.mean([r.std() for r in readings]) == pytest.approx(0.5, rel=0.05)


def test_bar_beyond_its_stroke_and_no_bar(quiet_world) -> None:
    world = quiet_world()
    world.ballbar.mount(100.0, world.tool_position(), world.time_s)
    go(world, (300 + 102, 250, 225))
    out = read_bar(world)
    assert set(out.status.tolist()) == {1}
    assert set(out.reading_nm.tolist()) == {1_000_000}
    world.ballbar.unmount()
    gone = read_bar(world)
    assert set(gone.status.tolist()) == {16}
    assert not gone.reading_nm.any()


def test_sync_level_aligns_samples_with_the_path(quiet_world) -> None:
    world = quiet_world()
    world.ballbar.mount(100.0, world.tool_position(), world.time_s)
    go(world, (400, 250, 225))
    world.ballbar.start(1000, world.time_s)
    world.advance(world.time_s + 0.0503)
    angle = np.linspace(0.0, 1.0, 400)[1:]
    world.controller.fifo_push(np.stack([300 + 100 * np.cos(angle), 250 + 100 * np.sin(angle), np.full(399, 225.0)], axis=1))
    begin_s = world.time_s
    world.controller.path_start(6000.0)
    for _ in range(300):
        world.advance(world.time_s + 0.0047)
    end_s = world.controller.path_end_s
    assert end_s - begin_s == pytest.approx(1.0, abs=1e-4)
    got = world.ballbar.take()
    on = np.flatnonzero(got.status & 8)
    assert np.array_equal(on, np.arange(on[0], on[-1] + 1))
    instants = (got.time_us - world.ballbar.offset_us) * 1e-6
    assert 0.0 <= instants[on[0]] - begin_s < 0.001
    assert 0.0 < end_s - instants[on[-1]] <= 0.001
    chord_mm = 100.0 * (1.0 - np.cos(0.5 / 399))
    assert np.abs(got.reading_nm).max() <= 1e6 * chord_mm + 1


def test_readings_do_not_depend_on_how_time_is_cut() -> None:
    def run(cuts: np.ndarray) -> tuple[list[int], list[int]]:
        world = World(Scenario(seed=9))
        world.ballbar.mount(100.0, world.tool_position(), world.time_s)
        world.ballbar.start(500, 0.0)
        world.controller.move(np.array([300.5, 250.4, 225.3]), 50.0)
        readings: list[int] = []
        for t in cuts:
            world.advance(t)
            readings += world.ballbar.take().reading_nm.tolist()
        return readings, world.tool_position().tolist()

    coarse, end = run(np.array([0.7, 2.0]))
    fine, fine_end = run(np.append(np.sort(np.random.default_rng(0).uniform(0, 2, 300)), 2.0))
    assert coarse == fine
    assert end == fine_end


def zeroed(world: World, beam) -> None:
    world.laser.mount(np.array(beam, dtype=float), world.tool_position())
    world.laser.compensate(1)
    assert world.laser.zero(world.tool_position()) == LaserResult.OK
    world.advance(world.time_s + 0.06)


def test_laser_measures_along_the_beam(quiet_world) -> None:
    world = quiet_world()
    beam = np.array([0.6, 0.0, 0.8])
    zeroed(world, beam)
    go(world, (350, 280, 235))
    assert world.laser.output().displacement_mm == pytest.approx(50 * 0.6 + 10 * 0.8, abs=1e-9)


def test_laser_with_tilted_mirror_and_misaligned_beam(quiet_world) -> None:
    """Six moves tell m / (m.l); its parts have the sizes of the scenario, and a new mount draws anew."""
    world = quiet_world(mirror_tilt_urad=[200, 200], beam_misalignment_urad=[300, 300])
    gradients = []
    for _ in range(2):
        go(world, (300, 250, 225))
        zeroed(world, (1, 0, 0))
        readings = []
        for step in 100.0 * np.eye(3):
            go(world, np.array([300, 250, 225]) + step)
            readings.append(world.laser.output().displacement_mm / 100.0)
        gradients.append(readings)
    for gradient in np.array(gradients):
        assert np.hypot(gradient[1], gradient[2]) == pytest.approx(200e-6, rel=1e-3)
        cosine = gradient[0] - 1.0  # 1 / (m.l) - 1: second order only
        assert abs(cosine) < (200e-6 + 300e-6) ** 2
    assert not np.allclose(*gradients, atol=1e-6)


def test_laser_air_compensation(quiet_world) -> None:
    world = quiet_world()
    zeroed(world, (1, 0, 0))
    go(world, (400, 250, 225))
    assert world.laser.output().displacement_mm == pytest.approx(100.0, abs=1e-9)
    assert world.laser.compensate(0) == LaserResult.OK
    assert world.laser.compensate(2) == LaserResult.BAD_ARGUMENT
    world.advance(world.time_s + 0.06)
    out = world.laser.output()
    assert out.displacement_mm == pytest.approx(100.0 * (1.0 + out.air.refractivity), abs=1e-9)
    assert 2.5e-4 < out.air.refractivity < 2.9e-4
    assert out.status & 8 == 0


def test_air_changes_slowly(quiet_world) -> None:
    world = quiet_world()
    states = []
    for _ in range(60):
        world.advance(world.time_s + 60.0)
        states.append(world.laser.output().air)
    temperature = np.array([s.temperature_c for s in states])
    assert 0.1 < np.ptp(temperature) < 1.0
    assert np.abs(np.diff(temperature)).max() < 0.2


def test_blocked_beam_loses_counts_until_cleared_and_zeroed(quiet_world) -> None:
    world = quiet_world()
    zeroed(world, (1, 0, 0))
    go(world, (310, 250, 225))
    world.laser.block(blocked=True)
    go(world, (320, 250, 225))
    out = world.laser.output()
    assert (out.status & 0b10111, out.signal_permille) == (0b00011, 0)
    assert out.displacement_mm == pytest.approx(10.0), "holds its last value"
    assert world.laser.zero(world.tool_position()) == LaserResult.BLOCKED
    assert world.laser.clear() == LaserResult.BLOCKED
    world.laser.block(blocked=False)
    world.advance(world.time_s + 1.0)
    assert world.laser.output().status & 0b10111 == 1, "the loss is latched"
    assert world.laser.zero(world.tool_position()) == LaserResult.BLOCKED
    assert world.laser.clear() == LaserResult.OK
    assert world.laser.zero(world.tool_position()) == LaserResult.OK
    world.advance(world.time_s + 1.0)
    out = world.laser.output()
    assert (out.status & 0b10111, out.displacement_mm) == (0b00100, pytest.approx(0.0, abs=1e-9))


def test_laser_sample_is_frozen_between_ticks(quiet_world) -> None:
    world = quiet_world()
    world.laser.mount(np.array([1.0, 0.0, 0.0]), world.tool_position())
    world.advance(1.0)
    before = world.laser.output()
    world.laser.compensate(1)
    world.laser.zero(world.tool_position())
    world.advance(1.04)
    assert world.laser.output() == before
    world.advance(1.06)
    after = world.laser.output()
    assert (after.count, after.time_s) == (before.count + 1, pytest.approx(1.05))
    assert after.status & 0b1100 == 0b1100


def test_laser_noise_belongs_to_the_sample_not_to_the_reader(quiet_world) -> None:
    worlds = [quiet_world(bar_noise_um=[0.5, 0.5]) for _ in range(2)]
    for world in worlds:
        zeroed(world, (0, 1, 0))
    values = []
    for k in range(2, 3000):
        worlds[0].advance(k * 0.05 + 0.01)
        values.append(worlds[0].laser.output().displacement_mm)
    worlds[1].advance(worlds[0].time_s)
    assert worlds[1].laser.output().displacement_mm == values[-1]
    assert np.std(values) == pytest.approx(0.3e-3, rel=0.06)
