"""Cyclic error of an interferometer: known ellipses and waves with noise, outliers and a memory; and a nano-measuring machine's signals."""

import numpy as np
import pytest

from abbe.models.evaluation.cyclic_interferometer import from_linear_run, from_quadrature

TURN = 2.0 * np.pi


def signals(phase, offset_x=4.0, offset_y=-3.0, gain=1.02, quadrature=0.015, radius=500.0):
    """Counts of a detector: cosine with an offset, sine of another gain and not quite in quadrature."""
    return offset_x + radius * np.cos(phase), offset_y + radius / gain * np.sin(phase - quadrature)


def test_the_ellipse_and_both_orders_are_found_exactly():
    x, y = signals(np.linspace(0.0, 40.0, 3000))
    found = from_quadrature(x, y, TURN)
    e = found.ellipse
    assert (e.offset_x, e.offset_y, e.gain, e.quadrature_rad, e.radius) == pytest.approx((4.0, -3.0, 1.02, 0.015, 500.0), rel=1e-9)
    phase = np.linspace(-3.0, 3.0, 50)
    assert e.phase(*signals(phase)) == pytest.approx(phase, abs=1e-12)
    assert found.orders[0].amplitude == pytest.approx(5.0 / 500.0, rel=0.02)  # offsets over the amplitude, to first order
    assert found.orders[1].amplitude == pytest.approx(0.5 * np.hypot(0.02, 0.015), rel=0.03)


def test_amplitude_and_phase_say_what_the_uncorrected_phase_does():
    true = np.linspace(0.0, 40.0, 3000)
    x, y = signals(true)
    error = np.angle(np.exp(1j * (np.arctan2(y, x) - true)))
    said = sum(o.amplitude * np.sin(o.order * true + o.start_rad) for o in from_quadrature(x, y, TURN).orders)
    assert np.std(error - said) < 0.03 * np.std(error)


def test_outliers_do_not_count_and_u_holds_the_truth():
    rng = np.random.default_rng(11)
    truth = [o.amplitude for o in from_quadrature(*signals(np.linspace(0.0, 60.0, 4000)), TURN).orders]
    off = []
    for _ in range(16):
        x, y = signals(np.linspace(0.0, 60.0, 2000))
        x = x + np.convolve(rng.normal(size=2004), np.full(5, 5.0**-0.5), "valid")  # noise with a memory
        y = y + rng.normal(size=2000)
        x[rng.integers(0, 2000, 20)] += 100.0
        found = from_quadrature(x, y, TURN)
        assert 0.005 < found.outliers < 0.03
        off += [(o.amplitude - t) / o.u_amplitude for o, t in zip(found.orders, truth, strict=True)]
    assert 0.88 < np.mean(np.abs(off) < 2.0) <= 1.0
    assert np.std(off) > 0.6  # nor is U much too wide


def test_clean_signals_have_no_cyclic_error():
    rng = np.random.default_rng(4)
    x, y = signals(np.linspace(0.0, 60.0, 2000), 0.0, 0.0, 1.0, 0.0)
    found = from_quadrature(x + rng.normal(size=2000), y + rng.normal(size=2000), TURN)
    assert min(o.p for o in found.orders) > 0.01


def test_a_slow_linear_run_shows_both_orders_beside_its_drift():
    rng = np.random.default_rng(8)
    fringe = 316.4  # nm
    true = np.linspace(0.0, 4000.0, 1500)
    error = 2.0 * np.sin(TURN * true / fringe + 0.5) + 0.8 * np.sin(2.0 * TURN * true / fringe - 1.0)
    deviation = error + 3e-3 * true + rng.normal(0.0, 0.5, true.size)
    found = from_linear_run(true + deviation, deviation, fringe)
    for one, (size, start) in zip(found.orders, ((2.0, 0.5), (0.8, -1.0)), strict=True):
        assert abs(one.amplitude - size) < 3.0 * one.u_amplitude < 0.3
        assert abs(one.start_rad - start) < 0.3
        assert one.p < 1e-6
    assert found.u_reading == pytest.approx(np.sqrt(0.5 * (2.0**2 + 0.8**2)), rel=0.05)


def test_half_a_fringe_few_samples_and_no_ellipse_are_refused():
    with pytest.raises(ValueError, match=r"in \d of 12 parts of a fringe"):
        from_quadrature(*signals(np.linspace(0.0, 3.0, 500)), TURN)
    with pytest.raises(ValueError, match="50 samples, expected 96 or more"):
        from_quadrature(*signals(np.linspace(0.0, 10.0, 50)), TURN)
    with pytest.raises(ValueError, match="do not change"):
        from_quadrature(np.ones(200), np.ones(200), TURN)
    t = np.linspace(-2.0, 2.0, 200)
    with pytest.raises(ValueError, match="no ellipse"):
        from_quadrature(np.cosh(t), np.sinh(t), TURN)  # a hyperbola: of a parabola rounding decides


def test_a_nano_measuring_machine_against_two_corrections(shared):
    """Odd rows, which nobody saw while this was written. The corrections (alike in phase, not in radius) are the truth."""
    folder = shared / "data" / "foreign" / "interferometer"
    files = {name: folder / f"test01_XYZ_f_quad_X_{name}.csv.gz" for name in ("raw", "Heydemann", "MatusDai")}
    missing = [path.name for path in files.values() if not path.is_file()]
    if missing:
        pytest.skip(f"no {', '.join(missing)} in ../shared")
    raw, *corrected = (np.loadtxt(path, delimiter=",", skiprows=1)[1::2] for path in files.values())
    phase = np.radians(raw[:, 0])
    found = from_quadrature(raw[:, 1] * np.cos(phase), raw[:, 1] * np.sin(phase), 360.0)
    for other in corrected:
        true = np.radians(other[:, 0])
        columns = np.column_stack([np.ones(true.size), *(wave(k * true) for k in (1, 2) for wave in (np.sin, np.cos))])
        c = np.linalg.lstsq(columns, raw[:, 0] - other[:, 0], rcond=None)[0]
        for k, one in enumerate(found.orders):
            assert one.amplitude == pytest.approx(np.hypot(*c[1 + 2 * k : 3 + 2 * k]), rel=0.03)  # degrees
            assert one.start_rad == pytest.approx(np.arctan2(c[2 + 2 * k], c[1 + 2 * k]), abs=0.05)
            assert one.p < 0.01
