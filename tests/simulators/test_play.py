import numpy as np

from abbe.simulators.truth.machine import Play


def test_lost_motion_and_hysteresis() -> None:
    play = Play(np.array([0.004, 0.002, 0.0]), np.zeros(3))
    forth = np.linspace(0.0, 10.0, 101)
    axes = play.run(np.stack([forth, forth, forth], axis=1))
    np.testing.assert_allclose(axes[-1] - 10.0, [-0.002, -0.001, 0.0], atol=1e-12)
    # after the reversal the axis rests until the drive has taken up the whole of B
    back = 10.0 - np.array([0.001, 0.003, 0.004, 0.005, 1.0])
    axes = play.run(np.stack([back, back, back], axis=1))
    np.testing.assert_allclose(axes[:, 0], [9.998, 9.998, 9.998, 9.997, 9.002], atol=1e-12)
    np.testing.assert_allclose(axes[:, 2], back, atol=1e-12)
    # a move within the play leaves the axis where it is
    rest = play.run(np.array([[9.0021, 9.0, 9.0]]))
    np.testing.assert_allclose(rest[0, 0], 9.002, atol=1e-12)


def test_result_does_not_depend_on_batches() -> None:
    rng = np.random.default_rng(1)
    drive = np.cumsum(rng.normal(scale=0.003, size=(500, 3)), axis=0)
    whole = Play(np.full(3, 0.004), np.zeros(3)).run(drive)
    piecewise = Play(np.full(3, 0.004), np.zeros(3))
    parts = [piecewise.run(part) for part in np.array_split(drive, 37)]
    assert np.array_equal(whole, np.vstack(parts))
